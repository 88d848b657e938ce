# SPDX-License-Identifier: BSD-3-Clause
"""The bytes of a file, expanded where it is compressed, within a bound that follows from its size."""

from __future__ import annotations

import bz2
import gzip
import io
import os
import stat
from dataclasses import dataclass
from pathlib import Path

from groma.errors import FileFormatError
from groma.gates import gate


@dataclass(frozen=True)
class ReadingGates:
    """What a file may ask for. Beyond these it is taken for one that was made to harm."""

    free: int = gate(32 << 20, "bytes", "to which any compressed file may expand", "cost: memory")
    ratio: int = gate(40, "1", "and so many times its size", "cost: memory; text shrinks by 3 to 6, arrays by 16")
    pipe: int = gate(256 << 20, "bytes", "largest content of what is no regular file, such as a pipe", "cost: memory")
    line: int = gate(1 << 20, "characters", "longest line of a text file of numbers", "cost: memory and time")
    pixels: int = gate(1 << 24, "px", "largest image of any file", "cost: memory")
    pixel_ratio: int = gate(100, "px", "and so many for each byte of its file", "cost: memory; photographs: 2 to 20")


#: The numbers in use.
READING = ReadingGates()


def expanded_limit(size: int) -> int:
    """Return to how many bytes a compressed file of ``size`` bytes may expand."""
    return READING.free + READING.ratio * size


def read_content(path: str | os.PathLike[str]) -> bytes:
    """Return the bytes of a file; gzip and bzip2, recognised by content, are decompressed.

    Raises
    ------
    FileFormatError
        If it expands beyond :func:`expanded_limit`, or is a device that never ends.
    """
    raw = _raw(Path(path))
    if raw[:2] == b"\x1f\x8b":
        stream: io.BufferedIOBase = gzip.GzipFile(fileobj=io.BytesIO(raw))
    elif raw[:3] == b"BZh":
        stream = bz2.BZ2File(io.BytesIO(raw))
    else:
        return raw
    limit = expanded_limit(len(raw))
    with stream:
        content = stream.read(limit + 1)  # reads in pieces, and no further
    if len(content) > limit:
        raise FileFormatError(
            f"{path} grows beyond {limit} bytes when decompressed ({READING.free} and {READING.ratio} times its size), "
            "which no file of numbers does. Decompress it yourself if you trust it."
        )
    return content


def _raw(path: Path) -> bytes:
    with path.open("rb") as file:
        if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            return file.read()
        content = file.read(READING.pipe + 1)
    if len(content) > READING.pipe:
        raise FileFormatError(f"{path} is no file and gives more than {READING.pipe} bytes. Pass a file.")
    return content
