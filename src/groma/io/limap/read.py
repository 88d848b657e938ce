# SPDX-License-Identifier: BSD-3-Clause
"""Reading the files of :mod:`groma.io.limap.files`: no count is trusted before the file is known to hold as much."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from groma.errors import FileFormatError
from groma.io.limap.files import (
    EDGE_2D,
    EDGE_3D,
    LINE_2D,
    MEMBER_2D,
    MEMBER_3D,
    NAMES,
    NONE,
    NUM_PARAMS,
    NUMBER,
    SUFFIX,
    TRACK,
    Form,
    Group2d,
    Group3d,
    Lines3d,
    Records,
    Structure2d,
    Structures,
    columns_of,
)

_LINE_2D_TEXT = np.dtype([("ends", "<f8", 4), ("score", "<f8")])


def read_files(folder: Path, form: Form) -> Structures:
    """Read the four files; whatever is wrong with them is raised by name."""
    parts: list[Any] = []
    for name, parse in zip(NAMES, (_images, _lines, _groups, _wireframe), strict=True):
        path = folder / (name + SUFFIX[form])
        content = path.read_bytes()
        try:
            source = _Words(content) if form == "text" else _Bytes(content)
            parts.append(parse(source))
            source.finish()
        except (FileFormatError, struct.error, ValueError, OverflowError) as error:
            raise FileFormatError(f"{path} is incomplete or damaged: {error}. Fetch or export it again.") from error
    images, lines, groups, wireframe = parts
    if form == "text":
        images = _with_line_ids(images, lines)
    return Structures(images, lines, groups, wireframe)


class _Bytes:
    """A binary file, read from front to back."""

    text = False

    def __init__(self, content: bytes) -> None:
        self.content, self.at = content, 0

    def one(self, code: str) -> Any:
        value = struct.unpack_from("<" + code, self.content, self.at)[0]
        self.at += struct.calcsize("<" + code)
        return value

    def count(self, least: int = 1) -> int:
        """Return a count of rows of at least ``least`` numbers; refused if the file is too short for them."""
        return self.fits(self.one("Q"), 4 * least)

    def fits(self, count: int, size: int) -> int:
        if count * size > len(self.content) - self.at:
            raise FileFormatError(f"it promises {count} entries, {len(self.content) - self.at} bytes are left")
        return count

    def rows(self, count: int, dtype: np.dtype[Any]) -> Any:
        array = np.frombuffer(self.content, dtype, self.fits(count, dtype.itemsize), self.at).copy()
        self.at += array.nbytes
        return array

    def finish(self) -> None:
        if self.at != len(self.content):
            raise FileFormatError(f"{len(self.content) - self.at} bytes are left over")


class _Words:
    """A text file, read word by word."""

    text = True

    def __init__(self, content: bytes) -> None:
        self.words, self.at = content.decode("ascii").split(), 0

    def one(self, code: str) -> Any:
        if self.at == len(self.words):
            raise FileFormatError("it ends too early")
        word = self.words[self.at]
        self.at += 1
        if code == "d":
            return float(word)
        value = int(word)
        struct.pack("<" + code, value)  # raises where it does not fit
        return value

    def count(self, least: int = 1) -> int:
        return self.fits(self.one("Q"), least)

    def fits(self, count: int, size: int) -> int:
        if count * size > len(self.words) - self.at:
            raise FileFormatError(f"it promises {count} entries, {len(self.words) - self.at} numbers are left")
        return count

    def rows(self, count: int, dtype: np.dtype[Any]) -> Any:
        columns = columns_of(dtype)
        self.fits(count, len(columns))
        array = np.zeros(count, dtype)
        end = self.at + count * len(columns)
        for place, (name, entry, kind) in enumerate(columns):
            words = self.words[self.at + place : end : len(columns)]
            values = np.array([(float if kind.kind == "f" else int)(word) for word in words], kind)
            target = array[name] if name else array
            (target if entry is None else target[:, entry])[...] = values
        self.at = end
        return array

    def finish(self) -> None:
        if self.at != len(self.words):
            raise FileFormatError(f"{len(self.words) - self.at} words are left over")


_Source = _Bytes | _Words


def _images(source: _Source) -> tuple[Structure2d, ...]:
    return tuple(_structure(source) for _ in range(source.count(4)))


def _structure(source: _Source) -> Structure2d:
    image_id, num_points = source.one("I"), source.one("I")
    if source.text:
        num_lines, num_groups, _ = (source.count(0) for _ in range(3))
        lines = np.zeros(source.fits(num_lines, 5), LINE_2D)
        for name, values in zip(("ends", "score"), _fields(source.rows(num_lines, _LINE_2D_TEXT)), strict=True):
            lines[name] = values
        lines["line_id"] = NONE
        groups = tuple(_group_2d_text(source) for _ in range(source.fits(num_groups, 4)))
    else:
        lines = source.rows(source.count(), LINE_2D)
        groups = tuple(_group_2d(source) for _ in range(source.count(7)))
    return Structure2d(image_id, num_points, lines, groups, source.rows(source.count(), EDGE_2D))


def _fields(array: Records) -> list[npt.NDArray[Any]]:
    return [array[name] for name in array.dtype.names or ()]


def _group_2d(source: _Source) -> Group2d:
    kind = source.one("i")
    points = source.rows(source.count(), MEMBER_2D)
    lines = source.rows(source.count(), MEMBER_2D)
    return Group2d(kind, points, lines, source.one("Q"))


def _group_2d_text(source: _Source) -> Group2d:
    kind, num_points, num_lines, group_id = source.one("i"), source.count(), source.count(), source.one("Q")
    return Group2d(kind, source.rows(num_points, MEMBER_2D), source.rows(num_lines, MEMBER_2D), group_id)


def _lines(source: _Source) -> Lines3d:
    ids, ends, tracks, uncertainty = [], [], [np.zeros(0, TRACK)], []
    for _ in range(source.count(9)):
        ids.append(source.one("Q"))
        ends.append(source.rows(6, NUMBER))
        tracks.append(source.rows(source.count(), TRACK))
        uncertainty.append(source.one("d"))
    return Lines3d(
        np.array(ids, "<u8"),
        np.array(ends, float).reshape(-1, 2, 3),
        np.array(uncertainty, float),
        np.cumsum([len(track) for track in tracks]),
        np.concatenate(tracks),
    )


def _groups(source: _Source) -> tuple[Group3d, ...]:
    groups = []
    for _ in range(source.count(6)):
        number, kind = source.one("Q"), source.one("i")
        if source.text:
            num_points, num_lines = source.count(), source.count()
            points, lines = source.rows(num_points, MEMBER_3D), source.rows(num_lines, MEMBER_3D)
        else:
            points, lines = (source.rows(source.count(), MEMBER_3D) for _ in range(2))
        track = source.rows(source.count(), TRACK)
        params = source.rows(source.count(), NUMBER)
        if NUM_PARAMS.get(kind) != len(params):
            raise FileFormatError(f"group {number} is of kind {kind} and has {len(params)} parameters")
        groups.append(Group3d(number, kind, params, points, lines, track))
    return tuple(groups)


def _wireframe(source: _Source) -> Records:
    return source.rows(source.count(), EDGE_3D)


def _with_line_ids(images: tuple[Structure2d, ...], lines: Lines3d) -> tuple[Structure2d, ...]:
    """Fill in the 3D line of every 2D line, which text files leave out, from the tracks."""
    row = {image.image_id: row for row, image in enumerate(images)}
    tables = [image.lines.copy() for image in images]
    owners = np.repeat(lines.ids, np.diff(lines.start))
    for (image_id, idx), owner in zip(lines.track.tolist(), owners.tolist(), strict=True):
        if image_id in row and idx < len(tables[row[image_id]]):
            tables[row[image_id]]["line_id"][idx] = owner
    return tuple(replace(image, lines=table) for image, table in zip(images, tables, strict=True))
