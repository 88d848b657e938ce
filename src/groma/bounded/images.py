# SPDX-License-Identifier: BSD-3-Clause
"""Images: the size in the header is checked before a decoder allocates memory.

PNG, JPEG, BMP, WebP, PNM and TIFF are known, which are the endings that groma takes for images; a decoder never sees
any other kind, regardless of the name of the file.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from groma.bounded.content import READING
from groma.errors import FileFormatError

#: Markers of JPEG that hold the size: all starts of frames, of which C4, C8 and CC are none.
_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
#: Tags of TIFF: width and height of the image and of its tiles, and samples of a pixel (file format).
_TIFF_WIDTHS, _TIFF_HEIGHTS, _TIFF_SAMPLES = (256, 322), (257, 323), 277
_TIFF_TYPES: Mapping[int, str] = {1: "B", 3: "H", 4: "I", 16: "Q"}
#: Channels of a pixel of the formats.
_COLOURS = 4


def decoded(content: bytes, flags: int) -> npt.NDArray[Any] | None:
    """Decode an image as OpenCV does, silently; None if it is damaged, or of a kind that is not known.

    Raises
    ------
    FileFormatError
        If its header promises more pixels than a file of its size holds.
    """
    import cv2

    size = image_size(content)
    if size is None:
        return None
    width, height = size
    if width * height > READING.pixels + READING.pixel_ratio * len(content):
        raise FileFormatError(
            f"its header promises {width}x{height} pixels in {len(content)} bytes; expected at most {READING.pixels} "
            f"and {READING.pixel_ratio} for each byte. Make it smaller, or save it again."
        )
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        return None
    finally:
        cv2.utils.logging.setLogLevel(level)


def image_size(content: bytes) -> tuple[int, int] | None:
    """Return width and height in the header of an image; None for unknown formats."""
    for magic, read in _KINDS.items():
        if content.startswith(magic):
            try:
                return read(content)
            except (struct.error, IndexError, ValueError, KeyError):
                return None
    return None


def _png(content: bytes) -> tuple[int, int] | None:
    """Return the size; None if a chunk is longer than the file, for which the decoder would take memory first."""
    at = 8
    while at < len(content):
        length, kind = struct.unpack_from(">I4s", content, at)
        if length > len(content) - at - 12:
            return None
        if kind == b"IEND":
            break
        at += 12 + length
    return struct.unpack_from(">II", content, 16)


def _bmp(content: bytes) -> tuple[int, int]:
    if struct.unpack_from("<I", content, 14)[0] == 12:
        return struct.unpack_from("<HH", content, 18)
    width, height = struct.unpack_from("<ii", content, 18)
    return abs(width), abs(height)


def _webp(content: bytes) -> tuple[int, int] | None:
    """Return the larger of the canvas and the picture in it."""
    found = []
    at, size = 12, struct.unpack_from("<I", content, 4)[0] + 8
    while at + 18 < min(len(content), size):
        kind, length = content[at : at + 4], struct.unpack_from("<I", content, at + 4)[0]
        body = content[at + 8 : at + 18]
        if kind == b"VP8X":
            found.append((1 + int.from_bytes(body[4:7], "little"), 1 + int.from_bytes(body[7:10], "little")))
        elif kind == b"VP8L":
            bits = int.from_bytes(body[1:5], "little")
            found.append((1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)))
        elif kind == b"VP8 ":
            width, height = struct.unpack_from("<HH", body, 6)
            found.append((width & 0x3FFF, height & 0x3FFF))
        at += 8 + length + length % 2
    return (max(width for width, _ in found), max(height for _, height in found)) if found else None


def _jpeg(content: bytes) -> tuple[int, int] | None:
    sizes = [struct.unpack_from(">HH", content, at + 5) for marker, at in _segments(content) if marker in _FRAMES]
    return (max(width for _, width in sizes), max(height for height, _ in sizes)) if sizes else None


def _segments(content: bytes) -> Iterator[tuple[int, int]]:
    """Yield the segments of a JPEG up to its pixels: marker, and where the marker stands."""
    at = 2
    while (at := content.find(b"\xff", at)) >= 0 and at + 9 < len(content):
        marker = content[at + 1]
        if marker in (0xFF, 0x00) or 0xD0 <= marker <= 0xD8:
            at += 1
            continue
        yield marker, at
        if marker in (0xD9, 0xDA):
            return
        at += 2 + max(struct.unpack_from(">H", content, at + 2)[0], 2)


def _pnm(content: bytes) -> tuple[int, int]:
    if content[:2] == b"P7":
        lines = dict(line.split()[:2] for line in content[:1000].split(b"\n") if len(line.split()) == 2)
        return int(lines[b"WIDTH"]), int(lines[b"HEIGHT"])
    lines = (line.partition(b"#")[0] for line in content[2:4000].split(b"\n"))
    words = b" ".join(lines).split()
    width, height = words[:2]
    return int(width[:20]), int(height[:20])


def _tiff(content: bytes) -> tuple[int, int] | None:
    order = "<" if content[:2] == b"II" else ">"
    if struct.unpack_from(order + "H", content, 2)[0] == 43:  # BigTIFF
        at, count, entry, size = struct.unpack_from(order + "Q", content, 8)[0], "Q", "HHQ", 20
    else:
        at, count, entry, size = struct.unpack_from(order + "I", content, 4)[0], "H", "HHI", 12
    number = struct.unpack_from(order + count, content, at)[0]
    at += struct.calcsize(count)
    if number * size > len(content):
        return None
    values: dict[int, int] = {}
    for _ in range(number):
        tag, kind, _ = struct.unpack_from(order + entry, content, at)
        place = at + struct.calcsize("=" + entry)
        if tag in (*_TIFF_WIDTHS, *_TIFF_HEIGHTS, _TIFF_SAMPLES):
            values[tag] = max(values.get(tag, 0), struct.unpack_from(order + _TIFF_TYPES[kind], content, place)[0])
        at += size
    width, height = (max(values.get(tag, 0) for tag in tags) for tags in (_TIFF_WIDTHS, _TIFF_HEIGHTS))
    return width, height * max(values.get(_TIFF_SAMPLES, 1), _COLOURS) // _COLOURS


_KINDS: Mapping[bytes, Callable[[bytes], tuple[int, int] | None]] = {
    b"\x89PNG\r\n\x1a\n": _png,
    b"\xff\xd8": _jpeg,
    b"BM": _bmp,
    b"RIFF": _webp,
    **{b"P%d" % number: _pnm for number in range(1, 8)},
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), _tiff),
}
