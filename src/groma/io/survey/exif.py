# SPDX-License-Identifier: BSD-3-Clause
"""What cameras wrote into their photographs: positions, the GPS part of EXIF, of JPEG and TIFF files; orientations.

Only what is asked for is read, at the head of a JPEG file and anywhere in a TIFF file, whose directories usually follow
the pixels; damaged entries count as missing. How accurate they are, telephones write into EXIF, and receivers with
corrections into XMP: DJI as standard deviations of each coordinate, others in the words of Pix4D.

Reference: CIPA DC-008, *Exchangeable image file format*, sections 4.5 and 4.6.6.
"""

from __future__ import annotations

import mmap
import os
import re
import struct
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from groma._counted import counted
from groma.errors import InputError
from groma.io.survey.coordinates import CoordinateSystem, Places

#: Bytes of a JPEG file that are read: EXIF stands in one of the first segments, of 64 kB at most (cost: time only).
_HEAD = 1 << 18
#: Bytes in which the first directory of EXIF ends, far beyond what cameras write (cost: time only).
_FIRST = 1 << 14
#: Tags of the format.
_GPS, _XMP, _RATIONAL, _ORIENTATION = 0x8825, 700, 5, 0x0112
#: Quarter turns to the right of the orientations that cameras write; mirrored ones are not turned.
_TURNS = {3: 2, 6: 1, 8: 3}
#: The tag of the horizontal error, metres, in the GPS part.
_ERROR = 31
#: Names of XMP for the standard deviations of east, north and height, metres.
_STATED = ((b"RtkStdLon", b"RtkStdLat", b"RtkStdHgt"), (b"GPSXYAccuracy", b"GPSXYAccuracy", b"GPSZAccuracy"))
#: First bytes of a TIFF file.
_TIFF = (b"II*\0", b"MM\0*")
#: Standard deviations of receivers in cameras and phones, metres: east, north, height (convention: of receivers without
#: corrections).
EXIF_SIGMA = (5.0, 5.0, 10.0)
#: Of heights to those of east and north, where the horizontal one alone is written (convention: the same).
_HEIGHTS = EXIF_SIGMA[2] / EXIF_SIGMA[0]


def read_exif_positions(folder: str | os.PathLike[str], names: Sequence[str]) -> Places:
    """Read the positions in the EXIF of photographs, with the accuracy that is written there, if any is.

    Parameters
    ----------
    folder : path
        Folder of the photographs.
    names : sequence of str
        Their names in it.

    Raises
    ------
    InputError
        If none has a position.
    """
    found = {name: place for name in names if (place := _position_of(Path(folder) / name)) is not None}
    if not found:
        raise InputError(
            f"None of the {len(names)} photographs in {folder} has a position in its EXIF. Give a file: --positions "
            "FILE."
        )
    table, sigma = np.array(list(found.values()), float).reshape(-1, 2, 3).swapaxes(0, 1).copy()
    notes = []
    if missing := len(names) - len(found):
        notes.append(f"{counted(missing, 'photographs')} without a position in the EXIF.")
    flat = np.isnan(table[:, 2])
    if flat.any():
        table[flat, 2] = np.median(table[~flat, 2]) if not flat.all() else 0.0
        sigma[flat, 2] = 1e4
        notes.append(f"{counted(int(flat.sum()), 'photographs')} without a height in the EXIF.")
    return Places(tuple(found), table, sigma, CoordinateSystem("EPSG:4326"), "EXIF", tuple(notes), EXIF_SIGMA)


def quarter_turns(path: str | os.PathLike[str]) -> int:
    """Return the quarter turns to the right (0 to 3) that show a JPEG file upright; 0 where nothing is written."""
    with suppress(OSError, struct.error), Path(path).open("rb") as file:
        block = _exif_of(file.read(_FIRST))
        if block is not None:
            order = "<" if block[:2] == b"II" else ">"
            entry = _entries(block, order, struct.unpack_from(order + "I", block, 4)[0]).get(_ORIENTATION)
            return 0 if entry is None else _TURNS.get(struct.unpack_from(order + "H", block, entry[2])[0], 0)
    return 0


def _position_of(path: Path) -> list[float] | None:
    """Return longitude, latitude (degrees) and height, and their standard deviations in metres; NaN: not written."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
            if head[:4] in _TIFF:
                with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as whole:
                    return _position(whole)
        block = _exif_of(head)
        return None if block is None else _position(block, head)
    except (OSError, struct.error, ValueError, ZeroDivisionError):
        return None


def _exif_of(head: bytes) -> bytes | None:
    """Return the TIFF structure in which a JPEG file holds its EXIF."""
    if head[:2] != b"\xff\xd8":
        return None
    at = 2
    while at + 4 <= len(head) and head[at] == 0xFF and head[at + 1] != 0xDA:
        size = struct.unpack_from(">H", head, at + 2)[0]
        if head[at + 1] == 0xE1 and head[at + 4 : at + 10] == b"Exif\0\0":
            return head[at + 10 : at + 2 + size]
        at += 2 + max(size, 2)
    return None


def _position(block: bytes | mmap.mmap, xmp: bytes = b"") -> list[float] | None:
    order = "<" if block[:2] == b"II" else ">"
    main = _entries(block, order, struct.unpack_from(order + "I", block, 4)[0])
    if _GPS not in main:
        return None
    gps = _entries(block, order, struct.unpack_from(order + "I", block, main[_GPS][2])[0])
    if not {2, 4} <= gps.keys():
        return None
    degrees = []
    for tag, negative in ((4, b"W"), (2, b"S")):
        whole, *parts = _rationals(block, order, gps[tag], 3)
        minutes, seconds = np.nan_to_num(parts)  # 0/0: unknown, the part before it has decimals
        value = whole + minutes / 60.0 + seconds / 3600.0
        reference = block[gps[tag - 1][2] : gps[tag - 1][2] + 1] if tag - 1 in gps else b""
        degrees.append(-value if reference.upper() == negative else value)
    if not (abs(degrees[0]) <= 180.0 and abs(degrees[1]) <= 90.0) or degrees == [0.0, 0.0]:
        return None
    height = float("nan")
    if 6 in gps:
        below = 5 in gps and block[gps[5][2]] == 1
        height = _rationals(block, order, gps[6], 1)[0] * (-1.0 if below else 1.0)
    sigma = [float("nan")] * 3
    with suppress(struct.error, ValueError, ZeroDivisionError):
        if _XMP in main:
            start = struct.unpack_from(order + "I", block, main[_XMP][2])[0]
            xmp = block[start : start + min(main[_XMP][1], _HEAD)]
        error = _rationals(block, order, gps[_ERROR], 1)[0] if _ERROR in gps else float("nan")
        sigma = _stated_in_xmp(xmp) or ([error, error, error * _HEIGHTS] if error > 0.0 else sigma)
    return [*degrees, height, *sigma]


def _stated_in_xmp(xmp: bytes) -> list[float]:
    """Return the standard deviations of east, north and height that XMP states, metres; none where it states none."""
    for names in _STATED:
        found = [re.search(rb":%b\s*(?:=\s*[\"']|>)\s*\+?([0-9.eE/-]{1,24})\s*[\"'<]" % name, xmp) for name in names]
        parts = [one[1].split(b"/") for one in found if one is not None]
        sigma = [float(above) / float(below[0]) if below else float(above) for above, *below in parts]
        if len(sigma) == 3 and all(0.0 < one < float("inf") for one in sigma):
            return sigma
    return []


def _entries(block: bytes | mmap.mmap, order: str, offset: int) -> dict[int, tuple[int, int, int]]:
    """Return type, count and place of the value of the entries of a directory, by tag."""
    count = min(struct.unpack_from(order + "H", block, offset)[0], 512)
    found = {}
    for k in range(count):
        tag, kind, number = struct.unpack_from(order + "HHI", block, offset + 2 + 12 * k)
        found[tag] = kind, number, offset + 10 + 12 * k
    return found


def _rationals(block: bytes | mmap.mmap, order: str, entry: tuple[int, int, int], count: int) -> list[float]:
    kind, number, place = entry
    if kind != _RATIONAL or number < count:
        raise ValueError(f"expected {count} rationals")
    start = struct.unpack_from(order + "I", block, place)[0]
    parts = struct.unpack_from(f"{order}{2 * count}I", block, start)
    return [above / below if below else float("nan") for above, below in zip(parts[::2], parts[1::2], strict=True)]
