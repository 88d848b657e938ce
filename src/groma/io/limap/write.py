# SPDX-License-Identifier: BSD-3-Clause
"""Writing the files of :mod:`groma.io.limap.files`, text with every digit."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from groma.io.limap.files import NAMES, SUFFIX, Form, Group2d, Group3d, Structures, columns_of


def write_files(structures: Structures, folder: Path, form: Form) -> None:
    """Write the four files into an existing folder."""
    writers = (_put_images, _put_lines, _put_groups, _put_wireframe)
    for name, put in zip(NAMES, writers, strict=True):
        target: _Target = _TextTarget() if form == "text" else _BinaryTarget()
        put(structures, target)
        (folder / (name + SUFFIX[form])).write_bytes(target.content())


class _BinaryTarget:
    text = False

    def __init__(self) -> None:
        self.parts: list[bytes] = []

    def put(self, codes: str, *values: float) -> None:
        self.parts.append(struct.pack("<" + codes, *values))

    def rows(self, array: npt.NDArray[Any]) -> None:
        self.parts.append(np.ascontiguousarray(array).tobytes())

    def content(self) -> bytes:
        return b"".join(self.parts)


class _TextTarget:
    text = True

    def __init__(self) -> None:
        self.parts: list[str] = []

    def put(self, codes: str, *values: float) -> None:
        self.parts.append(" ".join(map(_word, values)))

    def rows(self, array: npt.NDArray[Any]) -> None:
        columns = [
            (array[name] if place is None else array[name][:, place]).tolist()
            for name, place, _ in columns_of(array.dtype)
        ]
        self.parts += [" ".join(map(_word, row)) for row in zip(*columns, strict=True)]

    def content(self) -> bytes:
        return ("\n".join(self.parts) + "\n").encode("ascii")


def _word(value: float) -> str:
    """Return every digit of a number, and no more."""
    return repr(value).removesuffix(".0")


_Target = _BinaryTarget | _TextTarget


def _put_images(structures: Structures, target: _Target) -> None:
    target.put("Q", len(structures.images))
    for image in structures.images:
        if target.text:
            target.put("I", image.image_id)
            target.put("IQQQ", image.num_points, len(image.lines), len(image.groups), len(image.wireframe))
            target.rows(image.lines[["ends", "score"]])
        else:
            target.put("IIQ", image.image_id, image.num_points, len(image.lines))
            target.rows(image.lines)
            target.put("Q", len(image.groups))
        for group in image.groups:
            _put_group_2d(group, target)
        target.put("Q", len(image.wireframe))
        target.rows(image.wireframe)


def _put_group_2d(group: Group2d, target: _Target) -> None:
    if target.text:
        target.put("iQQQ", group.kind, len(group.points), len(group.lines), group.group_id)
        target.rows(group.points)
        target.rows(group.lines)
    else:
        _put_members(group, target)
        target.put("Q", group.group_id)


def _put_members(group: Group2d | Group3d, target: _Target) -> None:
    """Put kind, points and lines as binary files have them: each count before its rows."""
    target.put("iQ", group.kind, len(group.points))
    target.rows(group.points)
    target.put("Q", len(group.lines))
    target.rows(group.lines)


def _put_lines(structures: Structures, target: _Target) -> None:
    lines = structures.lines
    target.put("Q", len(lines.ids))
    starts = lines.start.tolist()
    uncertainty = lines.uncertainty.tolist()
    for row, (number, ends) in enumerate(zip(lines.ids.tolist(), lines.segments.reshape(-1, 6).tolist(), strict=True)):
        track = lines.track[starts[row] : starts[row + 1]]
        target.put("Q", number)
        target.put("6d", *ends)
        target.put("Q", len(track))
        target.rows(track)
        target.put("d", uncertainty[row])


def _put_groups(structures: Structures, target: _Target) -> None:
    target.put("Q", len(structures.groups))
    for group in structures.groups:
        target.put("Q", group.id)
        if target.text:
            target.put("iQQ", group.kind, len(group.points), len(group.lines))
            target.rows(group.points)
            target.rows(group.lines)
        else:
            _put_members(group, target)
        target.put("Q", len(group.track))
        target.rows(group.track)
        target.put(f"Q{len(group.params)}d", len(group.params), *group.params.tolist())


def _put_wireframe(structures: Structures, target: _Target) -> None:
    target.put("Q", len(structures.wireframe))
    target.rows(structures.wireframe)
