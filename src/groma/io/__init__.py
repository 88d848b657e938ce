# SPDX-License-Identifier: BSD-3-Clause
"""Files: one format per module. :func:`read_scene` and :func:`write_scene` choose the module."""

from __future__ import annotations

import bz2
import gzip
import os
from pathlib import Path
from typing import Literal

from groma.errors import FileFormatError, InputError
from groma.io.archive import is_archive_name, looks_like_archive, read_archive, write_archive
from groma.io.atomic import atomic_output
from groma.io.bal import check_bal, looks_like_bal, read_bal, write_bal
from groma.io.colmap.model import check_colmap, from_pycolmap, read_colmap, to_pycolmap, write_colmap
from groma.io.g2o import read_g2o, write_g2o
from groma.io.limap.structures import Structures, structures_of
from groma.io.ply import write_geometry, write_obj, write_ply
from groma.io.reading import existing, reading
from groma.io.trajectories import Trajectory, read_trajectory, read_tum, write_trajectory, write_tum
from groma.scene import Scene

Format = Literal["auto", "colmap", "colmap_text", "archive", "bal", "ply", "obj"]

#: Formats by the ending of a name.
_ENDINGS: dict[str, Format] = {
    ".npz": "archive",
    ".txt": "bal",
    ".bz2": "bal",
    ".gz": "bal",
    ".ply": "ply",
    ".obj": "obj",
    "": "colmap",
}


def read_scene(path: str | os.PathLike[str]) -> Scene:
    """Read a scene: the folder of a COLMAP model, a BAL file or a groma archive, told apart by content.

    Parameters
    ----------
    path : path
        A folder (with the model in it, in ``sparse`` or in ``sparse/0``) or a file.

    Returns
    -------
    Scene
        What the files hold; LIMAP's structures beside a COLMAP model too.

    Raises
    ------
    InputError
        If there is nothing at ``path``.
    FileFormatError
        If it is none of these, or damaged.
    """
    place = existing(path)
    if place.is_dir():
        return read_colmap(place)
    if not place.is_file():
        raise InputError(f"{place} is neither a file nor a folder. Pass a COLMAP model, a BAL file or a groma archive.")
    with reading(place, "file"), place.open("rb") as file:
        head = file.read(256)
    if looks_like_archive(head) or is_archive_name(place):
        return read_archive(place)
    if looks_like_bal(_unpacked_head(place, head)):
        return read_bal(place)
    if place.suffix in (".bin", ".txt") and place.stem in ("cameras", "images", "points3D", "rigs", "frames"):
        return read_colmap(place.parent)
    raise FileFormatError(
        f"{place} is not a scene: expected the folder of a COLMAP model, a BAL file (three counts in its first line) "
        f"or a groma archive (.npz); it begins with {head[:20]!r}."
    )


def write_scene(
    scene: Scene,
    path: str | os.PathLike[str],
    format: Format = "auto",
    force: bool = False,
    like: Structures | None = None,
) -> None:
    """Write a scene, whole or not at all.

    Parameters
    ----------
    scene : Scene
        What to write.
    path : path
        Where. With ``format="auto"`` the name says the format: ``.npz`` archive, ``.txt``, ``.bz2`` or ``.gz`` BAL,
        ``.ply`` and ``.obj`` geometry only (points, lines, pieces of planes), no suffix a COLMAP model in a new folder.
    format : str
        ``colmap``, ``colmap_text``, ``archive``, ``bal``, ``ply`` or ``obj``, to override the name.
    force : bool
        Replace what is there.
    like : Structures, optional
        For COLMAP models: the LIMAP structures that the scene came from
        (:func:`groma.io.limap.structures.structures_of`), to keep what a scene cannot hold.

    Raises
    ------
    InputError
        If the format is unknown or cannot hold the scene.
    OutputError
        If something is there already or the file system refuses.
    """
    chosen = check_target(scene, path, format)
    if chosen == "archive":
        write_archive(scene, path, force)
    elif chosen == "bal":
        write_bal(scene, path, force)
    elif chosen == "colmap":
        write_colmap(scene, path, "binary", force, like)
    elif chosen == "colmap_text":
        write_colmap(scene, path, "text", force, like)
    elif chosen == "ply":
        write_ply(scene, path, force)
    else:
        write_obj(scene, path, force)


def check_target(scene: Scene, path: str | os.PathLike[str], format: Format = "auto") -> Format:
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
    if not isinstance(scene, Scene):
        raise InputError(f"What is written must be a groma.Scene; got {type(scene).__name__}. Pass result.scene.")
    suffix = Path(path).suffix.lower()
    chosen = _ENDINGS.get(suffix, "colmap" if Path(path).is_dir() else None) if format == "auto" else format
    if chosen == "bal":
        check_bal(scene)
    elif chosen in ("colmap", "colmap_text"):
        check_colmap(scene, "binary" if chosen == "colmap" else "text")
    elif chosen not in ("archive", "ply", "obj"):
        known = "a folder name for COLMAP, .npz for an archive, .txt, .bz2 or .gz for BAL, .ply or .obj"
        what = f"format {format!r}" if format != "auto" else f"the ending {suffix!r}"
        raise InputError(f"Cannot tell the format from {what} of {path}. Use {known}.")
    return chosen


def _unpacked_head(path: Path, head: bytes) -> bytes:
    """Return the beginning of the text in a file that may be compressed; empty when it cannot be unpacked."""
    try:
        if head[:3] == b"BZh":
            with bz2.open(path) as stream:
                return stream.read(256)
        if head[:2] == b"\x1f\x8b":
            with gzip.open(path) as stream:
                return stream.read(256)
    except Exception as error:  # OSError, EOFError, ValueError, and zlib.error, which derives from none of them
        raise FileFormatError(f"{path} cannot be decompressed: {error}. Fetch it again.") from error
    return head


__all__ = [
    "Structures",
    "Trajectory",
    "atomic_output",
    "check_target",
    "from_pycolmap",
    "read_archive",
    "read_bal",
    "read_colmap",
    "read_g2o",
    "read_scene",
    "read_trajectory",
    "read_tum",
    "structures_of",
    "to_pycolmap",
    "write_archive",
    "write_bal",
    "write_colmap",
    "write_g2o",
    "write_geometry",
    "write_obj",
    "write_ply",
    "write_scene",
    "write_trajectory",
    "write_tum",
]
