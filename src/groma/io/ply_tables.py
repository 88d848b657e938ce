# SPDX-License-Identifier: BSD-3-Clause
"""PLY files as tables: every element with its columns, from text and from both binary forms."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray
from groma.bounded.content import read_content
from groma.bounded.names import existing
from groma.errors import FileFormatError
from groma.io.geometry import Geometry
from groma.io.reading import reading

#: PLY's names of numbers.
_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


def read_ply_points(path: str | os.PathLike[str]) -> tuple[FloatArray, FloatArray]:
    """Return the vertices of a PLY file and their colours, both (P, 3); black where there are none.

    Raises
    ------
    FileFormatError
        If it is damaged.
    """
    place = existing(path)
    with reading(place, "PLY file"):
        table = next((table for name, table in ply_tables(place) if name == "vertex"), None)
        if table is None:
            raise FileFormatError("it has no vertices")
        xyz, color = (
            np.column_stack([np.asarray(table[name], float) for name in names])
            if all(name in table for name in names)
            else np.zeros((len(table["x"]), 3))
            for names in (("x", "y", "z"), ("red", "green", "blue"))
        )
        return Geometry(points=xyz).points, np.nan_to_num(color)


def ply_tables(place: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the elements of a PLY file: name, and columns by name."""
    content = read_content(place)
    header, found, body = content.partition(b"end_header")
    if not content.startswith(b"ply") or not found:
        raise FileFormatError("it has no PLY header")
    body = body.partition(b"\n")[2]
    form, layout = _ply_layout(header.decode("ascii", "replace"))
    source = _PlyText(body) if form == "ascii" else _PlyBytes(body, "<" if form == "binary_little_endian" else ">")
    for name, count, properties in layout:
        yield name, source.element(count, properties)


_Properties = list[tuple[str, str, str]]


def _ply_layout(header: str) -> tuple[str, list[tuple[str, int, _Properties]]]:
    """Return the form and the elements: name, count and (name, type, type of the length of a list or empty)."""
    form, layout = "", []
    for words in map(str.split, header.splitlines()):
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["element"]:
            layout.append((words[1], int(words[2]), []))
        elif words[:2] == ["property", "list"]:
            layout[-1][2].append((words[4], _PLY_TYPES[words[3]], _PLY_TYPES[words[2]]))
        elif words[:1] == ["property"]:
            layout[-1][2].append((words[2], _PLY_TYPES[words[1]], ""))
    if form not in ("ascii", "binary_little_endian", "binary_big_endian") or any(row[1] < 0 for row in layout):
        raise FileFormatError(f"it has the PLY format {form!r}")
    return form, layout


class _PlyText:
    def __init__(self, body: bytes) -> None:
        self.words, self.at = body.split(), 0

    def take(self, count: int) -> list[bytes]:
        words = self.words[self.at : self.at + count]
        if count < 0 or len(words) < count:
            raise FileFormatError("it ends too early")
        self.at += count
        return words

    def element(self, count: int, properties: _Properties) -> dict[str, list[Any]]:
        table: dict[str, list[Any]] = {name: [] for name, _, _ in properties}
        if not properties or count * len(properties) > len(self.words) - self.at:
            raise FileFormatError("it ends too early")
        for _ in range(count):
            for name, _, length in properties:
                if length:
                    table[name].append([float(word) for word in self.take(int(self.take(1)[0]))])
                else:
                    table[name].append(float(self.take(1)[0]))
        return table


class _PlyBytes:
    def __init__(self, body: bytes, order: str) -> None:
        self.body, self.order, self.at = body, order, 0

    def array(self, dtype: np.dtype[Any], count: int) -> npt.NDArray[Any]:
        if count < 0 or count * dtype.itemsize > len(self.body) - self.at:
            raise FileFormatError("it ends too early")
        array = np.frombuffer(self.body, dtype, count, self.at)
        self.at += array.nbytes
        return array

    def element(self, count: int, properties: _Properties) -> dict[str, Any]:
        if not any(length for _, _, length in properties):
            dtype = np.dtype([(name, self.order + kind) for name, kind, _ in properties])
            rows = self.array(dtype, count)
            return {name: rows[name] for name, _, _ in properties}
        table: dict[str, Any] = {name: [] for name, _, _ in properties}
        if count * len(properties) > len(self.body) - self.at:
            raise FileFormatError("it ends too early")
        if len(properties) == 1 and count:  # as in nearly every mesh: triangles and nothing else
            name, kind, length = properties[0]
            dtype = np.dtype([("length", self.order + length), ("index", self.order + kind, 3)])
            if count * dtype.itemsize <= len(self.body) - self.at:
                rows = np.frombuffer(self.body, dtype, count, self.at)
                if (rows["length"] == 3).all():
                    self.at += rows.nbytes
                    return {name: rows["index"]}
        for _ in range(count):
            for name, kind, length in properties:
                size = int(self.array(np.dtype(self.order + length), 1)[0]) if length else 1
                values = self.array(np.dtype(self.order + kind), size)
                table[name].append(values.tolist() if length else values[0])
        return table
