# SPDX-License-Identifier: BSD-3-Clause
"""The registry of scene formats, and reading and writing by it.

A format is one :class:`SceneFormat`: how its files are recognised, how they are read, written, and what a scene must
be like for that. Each format's module registers its own; other packages add theirs with :func:`register_format`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from groma.bounded.names import existing
from groma.errors import FileFormatError, GromaError, InputError, check_kind
from groma.io.g2o import looks_like_g2o
from groma.io.reading import reading
from groma.io.trajectories import read_trajectory
from groma.scene import Scene
from groma.scene.checks import check_scene_given

if TYPE_CHECKING:
    from groma.io.limap.structures import Structures

#: Bytes that :attr:`SceneFormat.recognise` is given (cost: time only).
HEAD_BYTES = 256


@dataclass(frozen=True)
class SceneFormat:
    """A scene file format. Operations that it does not support are None."""

    #: As ``format=`` spells it.
    name: str
    #: What a reader may pass, for messages: ``a BAL file (three counts in its first line)``. Empty: it is not read.
    source: str = ""
    #: How a name chooses the format when writing, for messages: ``.npz for an archive``. Empty: no name does.
    target: str = ""
    #: Endings of names that choose the format when writing, in lower case with the dot; ``""`` is a new folder.
    endings: tuple[str, ...] = ()
    #: Given the path of a file and its first bytes, or of a folder and none: whether it is of this format.
    recognise: Callable[[Path, bytes], bool] | None = None
    #: Reads a path that was recognised; raises FileFormatError if it is damaged.
    read: Callable[[Path], Scene] | None = None
    #: Writes a scene to a path atomically (:func:`groma.io.atomic.atomic_output`), replacing an existing one only
    #: if the third argument is true. Where ``keeps_structures``, a fourth is what :func:`write_scene` calls like.
    write: Callable[..., None] | None = None
    #: Raises InputError if the format cannot hold a scene.
    check: Callable[[Scene], object] | None = None
    #: Whether ``write`` takes the LIMAP structures that the scene came from.
    keeps_structures: bool = False


_FORMATS: dict[str, SceneFormat] = {}


def register_format(scene_format: SceneFormat) -> SceneFormat:
    """Make a format known to :func:`read_scene`, :func:`write_scene` and the command line; return it.

    Formats are tried in the order of their registration.

    Raises
    ------
    InputError
        If the name belongs to another format.
    """
    check_kind(scene_format, SceneFormat, "scene_format", "Make one: SceneFormat(...).")
    known = _FORMATS.setdefault(scene_format.name, scene_format)
    if known is not scene_format and _home(known) != _home(scene_format):
        raise InputError(
            f"A format named {known.name!r} is registered already, by {_home(known)}. Choose another name."
        )
    _FORMATS[scene_format.name] = scene_format
    return scene_format


def _home(scene_format: SceneFormat) -> str:
    return str(getattr(scene_format.read or scene_format.write, "__module__", ""))


def formats() -> tuple[SceneFormat, ...]:
    """All formats, in the order in which they are tried."""
    return tuple(_FORMATS.values())


def read_scene(path: str | os.PathLike[str]) -> Scene:
    """Read a scene: a COLMAP model, a groma archive, a BAL file or a file of another program, recognised by content.

    Parameters
    ----------
    path : path
        A folder (with the model in it, in ``sparse`` or in ``sparse/0``; or a result of groma, which is read by its
        ``scene.npz``) or a file; see the page *File formats*.

    Returns
    -------
    Scene
        What the files hold; LIMAP's structures beside a COLMAP model too.

    Raises
    ------
    InputError
        If ``path`` does not exist.
    FileFormatError
        If it is none of these, or damaged.
    """
    place = existing(path)
    readable = [one for one in _FORMATS.values() if one.recognise is not None and one.read is not None]
    head = b""
    if place.is_file():
        with reading(place, "file"), place.open("rb") as file:
            head = file.read(HEAD_BYTES)
    elif not place.is_dir():
        raise InputError(f"{place} is neither a file nor a folder. Pass {_sources(readable)}.")
    for one in readable:
        if one.recognise is not None and one.read is not None and one.recognise(place, head):
            return one.read(place)
    if place.is_dir() and (colmap := _FORMATS["colmap"].read) is not None:
        return colmap(place)  # its error names the missing files
    if looks_like_g2o(head):
        raise FileFormatError(f"{place} is a pose graph, not a scene. Optimise it with groma adjust.")
    if _is_trajectory(place):
        raise FileFormatError(
            f"{place} is a trajectory, not a scene. Compare it with another by groma evaluate trajectory, or take its "
            "poses for photographs with groma map --poses."
        )
    begin = f"begins with {head[:20].decode(errors='backslashreplace')!r}" if head else "is empty"
    raise FileFormatError(f"{place} is not a scene: expected {_sources(readable)}; it {begin}.")


def _is_trajectory(place: Path) -> bool:
    try:
        read_trajectory(place)
    except GromaError:
        return False
    return True


def write_scene(
    scene: Scene,
    path: str | os.PathLike[str],
    format: str = "auto",
    force: bool = False,
    like: Structures | None = None,
) -> None:
    """Write a scene atomically.

    Parameters
    ----------
    scene : Scene
        What to write.
    path : path
        Destination. With ``format="auto"`` the name determines the format: ``.npz`` archive, ``.txt``, ``.bz2`` or
        ``.gz`` BAL, ``.json`` cameras, poses and points for nerfstudio, ``.ply`` and ``.obj`` geometry only (points,
        lines, pieces of planes), ``.glb``, ``.gltf``, ``.dxf`` and ``.rrd`` geometry and cameras, no suffix a COLMAP
        model in a new folder.
    format : str
        ``colmap``, ``colmap_text``, ``archive``, ``bal``, ``transforms``, ``ply``, ``obj``, ``gltf``, ``dxf``,
        ``rerun`` or a registered one, to override the name.
    force : bool
        Replace an existing file.
    like : Structures, optional
        For COLMAP models: the LIMAP structures that the scene came from
        (:func:`groma.io.limap.structures.structures_of`), to keep what a scene cannot hold.

    Raises
    ------
    InputError
        If the format is unknown or cannot hold the scene.
    OutputError
        If ``path`` exists already or cannot be written.
    """
    chosen = _FORMATS[check_target(scene, path, format)]
    assert chosen.write is not None
    chosen.write(scene, path, force, *([like] if chosen.keeps_structures else []))


def check_target(scene: Scene, path: str | os.PathLike[str], format: str = "auto") -> str:
    """Return the format that :func:`write_scene` chooses; ask before long work whether it can hold the scene.

    Parameters
    ----------
    scene : Scene
        What is to be written, or will be adjusted first.
    path : path
        Where.
    format : str
        As in :func:`write_scene`.

    Raises
    ------
    InputError
        If the format is unknown or cannot hold the scene.
    """
    check_scene_given(scene)
    suffix = Path(path).suffix.lower()
    writable = [one for one in _FORMATS.values() if one.write is not None]
    if format == "auto":
        chosen = next((one for one in writable if suffix in one.endings), None)
        if chosen is None and Path(path).is_dir():
            chosen = _FORMATS["colmap"]
    else:
        chosen = next((one for one in writable if one.name == format), None)
    if chosen is None:
        known = "; ".join(one.target for one in writable if one.target)
        what = f"format {format!r}" if format != "auto" else f"the ending {suffix!r}"
        raise InputError(f"Cannot tell the format from {what} of {path}. Use {known}.")
    if chosen.check is not None:
        chosen.check(scene)
    return chosen.name


def _sources(readable: list[SceneFormat]) -> str:
    return _listed([one.source for one in readable if one.source])


def _listed(words: list[str]) -> str:
    return f"{', '.join(words[:-1])} or {words[-1]}"
