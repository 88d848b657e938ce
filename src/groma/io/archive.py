# SPDX-License-Identifier: BSD-3-Clause
"""The groma archive: a whole scene in one ``.npz`` file, exact, without pickle.

Every column of every table is one array named ``table.column``; ``format`` and ``version`` identify the file.
``numpy.load`` opens it too. Writing the same scene twice gives the same bytes, on every machine, because nothing is
compressed: measurements hardly shrink, and pycolmap's wheel (4.2), when it is imported before Python's zlib, breaks
zlib's compression for the whole process (it exports functions of the same names). Compressed archives are read too.

A reader must survive files made to harm: each array's header is compared with what the scene's tables declare, and
with the size of its zip member, before memory is taken for it (:mod:`groma.bounded.arrays`).
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from dataclasses import Field, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from groma.bounded.arrays import ArrayMembers, Header, opened_arrays
from groma.bounded.names import existing
from groma.bounded.text import shown
from groma.errors import FileFormatError
from groma.io.atomic import atomic_output
from groma.io.colmap.files import is_model
from groma.io.reading import reading
from groma.io.registry import SceneFormat, register_format
from groma.scene import Distances, Scene
from groma.scene.checks import check_scene_given
from groma.scene.survey import Kind

FORMAT, VERSION = "groma scene", 1
_KIND = "groma archive"
#: Tables that archives held before all distances were in one: of what their distances are.
_OF_DISTANCES = {"camera_distances": Kind.IMAGE, "point_distances": Kind.CONTROL_POINT}
_COLUMNS_OF_DISTANCES = ("first_idx", "second_idx", "distance", "sigma")


def archive_in(folder: Path) -> Path | None:
    """Return ``scene.npz`` of a result of groma, which holds more than the COLMAP model there; None of other folders.

    In a folder with a model, ``summary.json`` tells that it is one.
    """
    archive = folder / "scene.npz"
    return archive if archive.is_file() and ((folder / "summary.json").is_file() or not is_model(folder)) else None


def write_archive(scene: Scene, path: str | os.PathLike[str], force: bool = False) -> None:
    """Write a scene as a groma archive."""
    check_scene_given(scene)
    with atomic_output(path, force) as draft, zipfile.ZipFile(draft, "w") as file:
        _write_array(file, "format", np.array(FORMAT))
        _write_array(file, "version", np.array(VERSION))
        for table in fields(scene):
            for item in fields(getattr(scene, table.name)):
                value = getattr(getattr(scene, table.name), item.name)
                if len(value) == 0 and _may_lack(type(getattr(scene, table.name)), item):
                    continue
                fill = item.metadata.get("fill")
                if fill is not None and not isinstance(value, tuple) and (value == fill).all():
                    continue  # left out, so that readers without this column can read the file
                array = np.array(value, dtype="<U1" if not value else None) if isinstance(value, tuple) else value
                _write_array(file, f"{table.name}.{item.name}", array)


def read_archive(path: str | os.PathLike[str]) -> Scene:
    """Read a groma archive.

    Raises
    ------
    FileFormatError
        If a member is missing, has another type or shape than a scene's or is none of a scene, or the scene is not
        valid.
    """
    place = existing(path)
    with reading(place, _KIND), opened_arrays(place) as members:
        if "format" not in members or str(_read_array(members, "format", ())) != FORMAT:
            raise FileFormatError(
                f"{place} is not a groma archive: its format is not '{FORMAT}'. It is an .npz file of another program; "
                "pass a scene."
            )
        version = int(_read_array(members, "version", ())) if "version" in members else 0
        if not 1 <= version <= VERSION:
            raise FileFormatError(f"{place} has version {version}; this groma reads up to {VERSION}. Update groma.")
        tables = {}
        for table in fields(Scene):
            kind: Any = table.default_factory
            columns = {
                item.name: _read_column(members, f"{table.name}.{item.name}", item, _may_lack(kind, item))
                for item in fields(kind)
            }
            tables[table.name] = kind(**columns)
        tables["distances"] = _with_earlier_distances(members, tables["distances"])
        _refuse_unknown(members, tables, place)
        return Scene(**tables)


def _with_earlier_distances(members: ArrayMembers, table: Distances) -> Distances:
    """Return the distances with those that an archive holds in two tables, by what they are between."""
    parts = [table]
    for name, kind in _OF_DISTANCES.items():
        if f"{name}.first_idx" in members:
            columns = [_read_array(members, f"{name}.{column}", (None,)) for column in _COLUMNS_OF_DISTANCES]
            parts.append(Distances.between(kind, *columns))
    return Distances(*(np.concatenate([getattr(part, item.name) for part in parts]) for item in fields(table)))


def _refuse_unknown(members: ArrayMembers, tables: Mapping[str, Any], place: Path) -> None:
    """Raise if an archive holds what a scene cannot represent: it would be lost where the scene is written again."""
    known = {"format", "version"} | {f"{name}.{item.name}" for name, kind in tables.items() for item in fields(kind)}
    known |= {f"{name}.{column}" for name in _OF_DISTANCES for column in _COLUMNS_OF_DISTANCES}
    if unknown := [name for name in members.names if name not in known]:
        raise FileFormatError(
            f"{place} holds {shown(unknown[0])}, which this groma does not know and would lose. It was written by a "
            "newer one, or added to: update groma, or take it out."
        )


def _may_lack(kind: Any, item: Field[Any]) -> bool:
    """Whether a file may lack a column: those of tables that came later, and that few scenes have."""
    return bool(getattr(kind, "optional", False) or item.metadata.get("optional"))


def _read_column(members: ArrayMembers, name: str, item: Field[Any], may_lack: bool) -> Any:
    if name not in members and (may_lack or item.metadata.get("fill") is not None):
        return np.zeros((0, *item.metadata["row"]), item.metadata["dtype"])
    dtype = item.metadata["dtype"]
    array = _read_array(members, name, (None, *item.metadata["row"]))
    if dtype is None:
        if array.dtype.kind != "U":
            raise FileFormatError(f"Array {name} must hold text; got dtype {array.dtype}.")
        return tuple(array.tolist())
    if array.dtype != dtype:
        raise FileFormatError(f"Array {name} must have dtype {dtype}; got {array.dtype}.")
    return array


def _write_array(file: zipfile.ZipFile, name: str, array: npt.NDArray[Any]) -> None:
    # A fixed date makes the bytes depend on the content only.
    info = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
    info.compress_type = zipfile.ZIP_STORED
    info.external_attr = 0o644 << 16
    little = array.astype(array.dtype.newbyteorder("<"), copy=False)
    with file.open(info, "w", force_zip64=True) as stream:
        np.lib.format.write_array(stream, np.asanyarray(little, order="C"), version=(1, 0), allow_pickle=False)


def _read_array(members: ArrayMembers, name: str, shape: tuple[int | None, ...]) -> npt.NDArray[Any]:
    """Read one member after its header has been found to be the expected."""

    def check(header: Header) -> None:
        fits = len(header.shape) == len(shape) and all(
            size in (None, got) for size, got in zip(shape, header.shape, strict=True)
        )
        if not fits:
            raise FileFormatError(f"Array {name} must have shape {shape} (None: any); got {header.shape}.")
        if header.dtype.kind not in "biufU" or (header.fortran and len(shape) > 1):
            raise FileFormatError(f"Array {name} must hold numbers or text in C order; got dtype {header.dtype}.")

    if name not in members:
        raise FileFormatError(f"Array {name} is missing. The file is incomplete or of another program.")
    return members.read(name, check)


register_format(
    SceneFormat(
        "archive",
        source="a groma archive (.npz), or a result with scene.npz in it",
        target=".npz for an archive",
        endings=(".npz",),
        # zip files, damaged ones by name, and results
        recognise=lambda place, head: (
            head[:4] in (b"PK\x03\x04", b"PK\x05\x06")
            or (place.suffix.lower() == ".npz" and place.is_file())
            or archive_in(place) is not None
        ),
        read=lambda place: read_archive(archive_in(place) or place),
        write=write_archive,
    )
)
