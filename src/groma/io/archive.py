# SPDX-License-Identifier: BSD-3-Clause
"""The groma archive: a whole scene in one ``.npz`` file, exact, without pickle.

Every column of every table is one array named ``table.column``; ``format`` and ``version`` say what the file is.
``numpy.load`` opens it too. Writing the same scene twice gives the same bytes, on every machine, because nothing is
compressed: measurements hardly shrink, and pycolmap's wheel (4.2), when it is imported before Python's zlib, breaks
zlib's compression for the whole process (it exports functions of the same names). Compressed archives are read too.

A reader must survive files made to harm: each array's header is compared with what the scene's tables declare, and
with the size of its zip member, before memory is taken for it.
"""

from __future__ import annotations

import math
import os
import zipfile
from dataclasses import Field, fields
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from groma.errors import FileFormatError
from groma.io.atomic import atomic_output
from groma.io.reading import existing, reading
from groma.io.registry import SceneFormat, register_format
from groma.scene import Scene

FORMAT, VERSION = "groma scene", 1
_KIND = "groma archive"
#: Members may unpack to this many bytes plus a multiple of the file's size; more is a bomb. Deflate gives at most 1032.
_FREE_BYTES, _MAX_RATIO = 64 << 20, 300
_HEADER_LIMIT = 4096


def write_archive(scene: Scene, path: str | os.PathLike[str], force: bool = False) -> None:
    """Write a scene as a groma archive."""
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
                    continue  # as if left out; readers that do not know the column can read the file
                array = np.array(value, dtype="<U1" if not value else None) if isinstance(value, tuple) else value
                _write_array(file, f"{table.name}.{item.name}", array)


def read_archive(path: str | os.PathLike[str]) -> Scene:
    """Read a groma archive.

    Raises
    ------
    FileFormatError
        If a member is missing, has another type or shape than a scene's, or the scene is not valid.
    """
    place = existing(path)
    with reading(place, _KIND), zipfile.ZipFile(place) as file:
        members = {info.filename: info for info in file.infolist()}
        limit = _FREE_BYTES + _MAX_RATIO * place.stat().st_size
        if (total := sum(info.file_size for info in members.values())) > limit:
            raise FileFormatError(f"{place} would unpack to {total} bytes, far more than an archive of its size holds.")
        if "format.npy" not in members or str(_read_array(file, members["format.npy"], ())) != FORMAT:
            raise FileFormatError(
                f"{place} is not a groma archive: its format is not '{FORMAT}'. It is an .npz file of another program; "
                "pass a scene."
            )
        version = int(_read_array(file, members["version.npy"], ())) if "version.npy" in members else 0
        if not 1 <= version <= VERSION:
            raise FileFormatError(f"{place} has version {version}; this groma reads up to {VERSION}. Update groma.")
        tables = {}
        for table in fields(Scene):
            kind: Any = table.default_factory
            columns = {
                item.name: _read_column(file, members, f"{table.name}.{item.name}", item, _may_lack(kind, item))
                for item in fields(kind)
            }
            tables[table.name] = kind(**columns)
        return Scene(**tables)


def _may_lack(kind: Any, item: Field[Any]) -> bool:
    """Whether a file may lack a column: those of tables that came later, and that few scenes have."""
    return bool(getattr(kind, "optional", False) or item.metadata.get("optional"))


def _read_column(
    file: zipfile.ZipFile, members: dict[str, zipfile.ZipInfo], name: str, item: Field[Any], may_lack: bool
) -> Any:
    info = members.get(f"{name}.npy")
    if info is None and (may_lack or item.metadata.get("fill") is not None):
        return np.zeros((0, *item.metadata["row"]), item.metadata["dtype"])
    if info is None:
        raise FileFormatError(f"Array {name} is missing. The file is incomplete or of another program.")
    dtype = item.metadata["dtype"]
    array = _read_array(file, info, (None, *item.metadata["row"]))
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


def _read_array(file: zipfile.ZipFile, info: zipfile.ZipInfo, shape: tuple[int | None, ...]) -> npt.NDArray[Any]:
    """Read one member after its header has been found to be the expected and to fit the member's size."""
    with file.open(info) as stream:
        got_shape, fortran, dtype, header_size = _read_header(stream, info.filename)
        if len(got_shape) != len(shape) or any(
            size is not None and size != got for size, got in zip(shape, got_shape, strict=True)
        ):
            raise FileFormatError(f"Array {info.filename} must have shape {shape} (None: any); got {got_shape}.")
        if dtype.kind not in "iufU" or (fortran and len(got_shape) > 1):
            raise FileFormatError(f"Array {info.filename} must hold numbers or text in C order; got dtype {dtype}.")
        size = math.prod(got_shape) * dtype.itemsize
        if size != info.file_size - header_size:
            raise FileFormatError(
                f"Array {info.filename} needs {size} bytes but {info.file_size - header_size} follow."
            )
        content = stream.read(size + 1)  # one more, so that the checksum at the end is verified
        if len(content) != size:
            raise FileFormatError(f"Array {info.filename} ends after {len(content)} of {size} bytes.")
    if dtype.itemsize == 0:
        return np.zeros(got_shape, dtype)
    return np.frombuffer(content, dtype).reshape(got_shape).copy()


def _read_header(stream: IO[bytes], name: str) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise FileFormatError(f"Array {name} has npy version {version}; an archive uses (1, 0).")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream, max_header_size=_HEADER_LIMIT)
    if any(size < 0 for size in shape):
        raise FileFormatError(f"Array {name} has the negative shape {shape}.")
    return shape, fortran, dtype, stream.tell()


def looks_like_archive(head: bytes) -> bool:
    """Tell from the first bytes of a file whether it is a zip file, as archives are."""
    return head[:4] in (b"PK\x03\x04", b"PK\x05\x06")


def is_archive_name(path: str | os.PathLike[str]) -> bool:
    """Tell from its name whether a file is meant to be an archive."""
    return Path(path).suffix.lower() == ".npz"


register_format(
    SceneFormat(
        "archive",
        source="a groma archive (.npz)",
        target=".npz for an archive",
        endings=(".npz",),
        recognise=lambda place, head: looks_like_archive(head) or (is_archive_name(place) and place.is_file()),
        read=read_archive,
        write=write_archive,
    )
)

__all__ = ["is_archive_name", "looks_like_archive", "read_archive", "write_archive"]
