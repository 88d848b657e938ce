# SPDX-License-Identifier: BSD-3-Clause
"""Arrays of NumPy's ``.npz`` and ``.npy`` files: each header is compared with the size of what follows it.

``numpy.load`` takes memory as the headers ask for it, expands whatever is in the archive, and lets through errors of
Python's tokenizer. Here nothing is expanded before it is known how large it becomes: all members together, counted as
double precision at least, to which they are converted.
"""

from __future__ import annotations

import math
import os
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from groma.bounded.content import READING, expanded_limit
from groma.bounded.text import shown
from groma.errors import FileFormatError

Array = npt.NDArray[Any]

_ENDING = ".npy"
#: Bytes of a header: the format's own limit is 64 kB, no array of numbers needs as much.
_HEADER_LIMIT = 4096
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
#: Kinds of numbers and text; nothing that Python would have to unpickle.
_KINDS = "biufcSU"


@dataclass(frozen=True)
class Header:
    """The header of an array."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    #: Whether the first index runs fastest.
    fortran: bool

    @property
    def nbytes(self) -> int:
        """Bytes that follow the header."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def nbytes_as_doubles(self) -> int:
        """Bytes that it becomes in double precision."""
        return math.prod(self.shape) * max(self.dtype.itemsize, 8)


#: Raises FileFormatError if an array is not of the expected form, before it is read.
Check = Callable[[Header], None]


class ArrayMembers:
    """The arrays of an open ``.npz`` file."""

    def __init__(self, file: zipfile.ZipFile, place: object, size: int) -> None:
        self._file, self._place = file, place
        self._left = expanded_limit(size)
        self._members = {
            info.filename.removesuffix(_ENDING): info for info in file.infolist() if not info.filename.endswith("/")
        }
        total = sum(info.file_size for info in self._members.values())
        if total > self._left:
            raise self._too_large(total)

    @property
    def names(self) -> list[str]:
        """Names of the arrays, without ``.npy``."""
        return list(self._members)

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def read(self, name: str, check: Check | None = None) -> Array:
        """Return an array of numbers or text, after ``check`` has seen its header.

        Raises
        ------
        FileFormatError
            If it holds anything else, or its header does not fit what follows.
        """
        info = self._members[name]
        where = f"array {shown(name)}"
        if info.compress_type not in _METHODS:
            raise FileFormatError(f"{where} is compressed by method {info.compress_type}; expected none, or deflate.")
        try:
            with self._file.open(info) as stream:
                header = _header(stream, where)
                if check is not None:
                    check(header)
                if info.compress_type != zipfile.ZIP_STORED:
                    self._left -= header.nbytes_as_doubles
                    if self._left < 0:
                        raise self._too_large(header.nbytes_as_doubles)
                return _content(stream, header, info.file_size - stream.tell(), where)
        except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError) as error:
            raise FileFormatError(
                f"it is damaged: {shown(name)} in it cannot be read ({error}). Write the file again."
            ) from error

    def _too_large(self, total: int) -> FileFormatError:
        return FileFormatError(
            f"{self._place} would unpack to {total} bytes, far more than an archive of its size holds "
            f"({READING.free} and {READING.ratio} times its size). Save it uncompressed if you trust it."
        )


def form(kinds: str, *shape: int | None) -> Check:
    """Return a check that an array is of one of some kinds of NumPy (``f``, ``iu``) and of a shape; None: any size."""

    def check(header: Header) -> None:
        sizes = zip(shape, header.shape, strict=False)
        fits = len(header.shape) == len(shape) and all(size in (None, got) for size, got in sizes)
        if header.dtype.kind not in kinds or not fits:
            expected = f"({', '.join('n' if size is None else str(size) for size in shape)})"
            raise FileFormatError(f"expected {kinds} of the shape {expected}; got {header.dtype} {header.shape}.")

    return check


@contextmanager
def opened_arrays(path: str | os.PathLike[str]) -> Iterator[ArrayMembers]:
    """Open an ``.npz`` file; :class:`zipfile.BadZipFile` if the zip file itself is damaged."""
    try:
        opened = zipfile.ZipFile(path)
    except (NotImplementedError, struct.error) as error:  # a version of the format that Python does not read
        raise zipfile.BadZipFile(str(error)) from error
    with opened as file:
        yield ArrayMembers(file, path, os.stat(path).st_size)


def read_array(path: str | os.PathLike[str], check: Check | None = None) -> Array:
    """Read an ``.npy`` file of numbers, after ``check`` has seen its header.

    Raises
    ------
    FileFormatError
        If it holds anything else, or its header does not fit the size of the file.
    """
    with open(path, "rb") as stream:
        header = _header(stream, str(path))
        if check is not None:
            check(header)
        return _content(stream, header, os.fstat(stream.fileno()).st_size - stream.tell(), str(path))


def _header(stream: IO[bytes], where: str) -> Header:
    try:
        version = np.lib.format.read_magic(stream)
        shape, fortran, dtype = _HEADERS[version](stream, max_header_size=_HEADER_LIMIT)
    except Exception as error:  # of NumPy, of Python's tokenizer and parser, of zlib, and KeyError for other versions
        raise FileFormatError(
            f"{where} has no header of an array, or a damaged one. Save it with numpy.savez."
        ) from error
    if dtype.kind not in _KINDS or any(size < 0 for size in shape):
        raise FileFormatError(
            f"{where} holds Python objects or is damaged ({dtype} {shape}); only arrays of numbers or text are read. "
            "Convert it to numbers before it is saved."
        )
    return Header(tuple(int(size) for size in shape), dtype, bool(fortran))


def _content(stream: IO[bytes], header: Header, size: int, where: str) -> Array:
    if header.nbytes != size:
        raise FileFormatError(f"{where} needs {header.nbytes} bytes but {size} follow.")
    content = stream.read(size + 1)  # one more, so that the checksum at the end is verified
    if len(content) != size:
        raise FileFormatError(f"{where} ends after {len(content)} of {size} bytes.")
    if header.dtype.itemsize == 0 or size == 0:
        return np.zeros(header.shape, header.dtype)
    flat = np.frombuffer(content, header.dtype)
    if header.dtype.kind == "U" and np.frombuffer(content, header.dtype.byteorder + "u4").max() > sys.maxunicode:
        raise FileFormatError(f"{where} holds text that is none. Save it with numpy.savez.")
    return flat.reshape(header.shape, order="F" if header.fortran else "C").copy()
