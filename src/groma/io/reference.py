# SPDX-License-Identifier: BSD-3-Clause
"""References to compare lines and planes with: edge graphs, line sets, meshes and points from many kinds of files.

==============================  =====================================================================================
``.npz``                        ``points`` and ``edges`` (a graph), ``lines`` or ``segments`` ((R, 6) or (R, 2, 3)),
                                ``vertices`` and ``faces``, or ``points`` alone; or a groma archive (its segments)
``.npy``                        (R, 6) or (R, 2, 3) segments, (P, 3) points
``.ply``, ``.obj``              faces (cut into triangles), else edges, else points
``.txt``                        Line3D++ style (below), or rows of six numbers
folder                          COLMAP model with structures: its segments
==============================  =====================================================================================

A Line3D++ style row is ``X1 Y1 Z1 X2 Y2 Z2 N`` and N times ``image u1 v1 u2 v2``.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.errors import FileFormatError
from groma.io.geometry import Geometry
from groma.io.reading import existing, reading

_KIND = "reference"
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


@dataclass(frozen=True, eq=False)
class ReferenceLines:
    """Lines with the 2D segments that support them."""

    #: (R, 2, 3) end points.
    segments: FloatArray
    #: Names of images.
    image_names: tuple[str, ...]
    #: (N,) line of each observation.
    line_idx: IntArray
    #: (N,) image of each observation, in ``image_names``.
    image_idx: IntArray
    #: (N, 4) 2D segments, pixels.
    observations: FloatArray


def read_reference(path: str | os.PathLike[str]) -> Geometry:
    """Read something to compare with; see the module for the kinds of files.

    Raises
    ------
    FileFormatError
        If the file is none of these, or damaged.
    """
    place = existing(path)
    suffix = place.suffix.lower()
    if place.is_dir():
        return _of_scene(place)
    readers = {".npz": _read_npz, ".npy": _read_npy, ".ply": _read_ply, ".obj": _read_obj, ".txt": _read_text}
    if suffix not in readers:
        raise FileFormatError(f"{place} is not a known reference. Use one of {', '.join(readers)} or a COLMAP folder.")
    with reading(place, _KIND):
        try:
            return readers[suffix](place)
        except FileFormatError as error:
            raise FileFormatError(f"{place} is not a usable {_KIND}: {error}") from error


def holds_scene(path: str | os.PathLike[str]) -> bool:
    """Tell whether there is a whole scene at a path (COLMAP model or groma archive), not only geometry."""
    place = existing(path)
    if place.is_dir() or place.suffix.lower() != ".npz":
        return place.is_dir()
    with reading(place, _KIND), place.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        return "format" in file.files


def read_line3dpp(path: str | os.PathLike[str]) -> ReferenceLines:
    """Read lines with their 2D segments in the style of Line3D++; see the module."""
    place = existing(path)
    with reading(place, "file of reference lines"):
        ends, names, lines, images, seen = [], {}, [], [], []
        for number, words in _rows(place):
            count = int(words[6]) if len(words) > 6 else -1
            if count < 0 or len(words) != 7 + 5 * count:
                raise FileFormatError(
                    f"Line {number}: expected 6 coordinates, N and 5 N words; got {len(words)} words."
                )
            for at in range(7, len(words), 5):
                lines.append(len(ends))
                images.append(names.setdefault(words[at], len(names)))
                seen.append([float(word) for word in words[at + 1 : at + 5]])
            ends.append([float(word) for word in words[:6]])
        segments = Geometry(segments=np.array(ends, float).reshape(-1, 2, 3)).segments
    return ReferenceLines(
        segments, tuple(names), np.array(lines, np.int64), np.array(images, np.int64), np.reshape(seen, (-1, 4))
    )


def _rows(place: Path) -> list[tuple[int, list[str]]]:
    text = place.read_text(encoding="utf-8").splitlines()
    rows = [(number, line.partition("#")[0].split()) for number, line in enumerate(text, 1)]
    return [(number, words) for number, words in rows if words]


def _of_scene(place: Path) -> Geometry:
    from groma.io import read_scene

    return Geometry(segments=read_scene(place).lines.segments)


def _read_text(place: Path) -> Geometry:
    rows = _rows(place)
    if rows and all(len(words) == 6 for _, words in rows):
        return Geometry(segments=np.array([[float(w) for w in words] for _, words in rows]).reshape(-1, 2, 3))
    return Geometry(segments=read_line3dpp(place).segments)


def _read_npy(place: Path) -> Geometry:
    with place.open("rb") as stream:
        return _of_array(np.load(stream, allow_pickle=False))


def _of_array(array: npt.NDArray[Any]) -> Geometry:
    if array.dtype.kind in "iuf" and array.ndim == 2 and array.shape[1] == 3:
        return Geometry(points=array)
    if array.dtype.kind in "iuf" and array.shape[1:] in ((6,), (2, 3)):
        return Geometry(segments=array.reshape(-1, 2, 3))
    raise FileFormatError(f"Expected an array (R, 6), (R, 2, 3) or (P, 3); got {array.dtype} {array.shape}.")


def _read_npz(place: Path) -> Geometry:
    with place.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        names = set(file.files)
        if "format" in names:
            return _of_scene(place)
        for name in ("lines", "segments"):
            if name in names:
                return _of_array(file[name])
        for vertices, elements in (("points", "edges"), ("vertices", "edges"), ("vertices", "faces")):
            if {vertices, elements} <= names:
                return _of_elements(file[vertices], list(file[elements]))
        if "points" in names:
            return _of_array(file["points"])
    raise FileFormatError(f"Expected lines, segments, points and edges, or vertices and faces; got {sorted(names)}.")


def _of_elements(vertices: npt.NDArray[Any], elements: list[Any]) -> Geometry:
    """Return the segments of pairs of vertices and the triangles of polygons (fans around their first corner)."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "iuf":
        raise FileFormatError(f"Vertices must have shape (P, 3); got {vertices.dtype} {vertices.shape}.")
    pairs = np.array([e for e in elements if len(e) == 2], dtype=np.int64).reshape(-1, 2)
    three = np.array([e for e in elements if len(e) == 3], dtype=np.int64).reshape(-1, 3)
    fans = [[e[0], e[k], e[k + 1]] for e in elements if len(e) > 3 for k in range(1, len(e) - 1)]
    corners = np.concatenate([three, np.array(fans, np.int64).reshape(-1, 3)])
    for index in (pairs, corners):
        if len(index) and (index.min() < 0 or index.max() >= len(vertices)):
            raise FileFormatError(f"An edge or face refers to vertex {index.max()}; there are {len(vertices)}.")
    if len(corners):
        return Geometry(triangles=vertices[corners])
    return Geometry(segments=vertices[pairs]) if len(pairs) else Geometry(points=vertices)


def _read_obj(place: Path) -> Geometry:
    vertices: list[list[float]] = []
    elements: list[list[int]] = []
    for number, words in _rows(place):
        if words[0] == "v":
            if len(words) < 4:
                raise FileFormatError(f"Line {number}: a vertex has three coordinates.")
            vertices.append([float(word) for word in words[1:4]])
        elif words[0] in ("f", "l"):
            index = [int(word.split("/")[0]) for word in words[1:]]
            index = [i - 1 if i > 0 else len(vertices) + i for i in index]
            elements += [index] if words[0] == "f" else [list(pair) for pair in pairwise(index)]
    return _of_elements(np.array(vertices, float).reshape(-1, 3), elements)


# PLY


def _read_ply(place: Path) -> Geometry:
    content = place.read_bytes()
    header, found, body = content.partition(b"end_header")
    if not content.startswith(b"ply") or not found:
        raise FileFormatError("it has no PLY header")
    body = body.partition(b"\n")[2]
    form, layout = _ply_layout(header.decode("ascii", "replace"))
    source = _PlyText(body) if form == "ascii" else _PlyBytes(body, "<" if form == "binary_little_endian" else ">")
    vertices, elements = np.zeros((0, 3)), []
    for name, count, properties in layout:
        table = source.element(count, properties)
        if name == "vertex":
            vertices = np.column_stack([np.asarray(table[axis], float) for axis in "xyz"])
        elif name == "edge":
            elements += np.column_stack([table["vertex1"], table["vertex2"]]).tolist()
        elif name == "face":
            column = "vertex_indices" if "vertex_indices" in table else "vertex_index"
            elements += [list(map(int, row)) for row in table[column]]
    return _of_elements(vertices, elements)


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
        if count > len(self.body):
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


__all__ = ["ReferenceLines", "holds_scene", "read_line3dpp", "read_reference"]
