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
from array import array
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from groma._counted import counted
from groma._typing import FloatArray, IntArray
from groma.bounded.arrays import opened_arrays, read_array
from groma.bounded.names import existing
from groma.bounded.text import finite, read_words, whole
from groma.errors import FileFormatError
from groma.io.geometry import Geometry
from groma.io.ply_tables import ply_tables
from groma.io.reading import reading

_KIND = "reference"
#: Pairs of vertices, and triangles.
_Elements = tuple[Any, Any]


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
    with reading(place, _KIND), opened_arrays(place) as file:
        return "format" in file


def read_line3dpp(path: str | os.PathLike[str]) -> ReferenceLines:
    """Read lines with their 2D segments in the style of Line3D++; see the module."""
    place = existing(path)
    with reading(place, "file of reference lines"):
        ends, names, lines, images, seen = [], {}, [], [], []
        for number, words in read_words(place):
            count = whole(words[6], f"Line {number}", "N, how many images see the line") if len(words) > 6 else -1
            if count < 0 or len(words) != 7 + 5 * count:
                raise FileFormatError(
                    f"Line {number}: expected X1 Y1 Z1 X2 Y2 Z2 in every line, or these, N and N times "
                    f"image u1 v1 u2 v2; got {counted(len(words), 'words')}."
                )
            for at in range(7, len(words), 5):
                lines.append(len(ends))
                images.append(names.setdefault(words[at], len(names)))
                seen.append(finite(words[at + 1 : at + 5], f"Line {number}", "the ends of a segment"))
            ends.append(finite(words[:6], f"Line {number}", "six finite coordinates"))
        segments = Geometry(segments=np.array(ends, float).reshape(-1, 2, 3)).segments
    return ReferenceLines(
        segments, tuple(names), np.array(lines, np.int64), np.array(images, np.int64), np.reshape(seen, (-1, 4))
    )


def _of_scene(place: Path) -> Geometry:
    from groma.io import read_scene
    from groma.scene.line_intervals import line_pieces

    return Geometry(segments=line_pieces(read_scene(place))[0])


def _read_text(place: Path) -> Geometry:
    if len(next(read_words(place), (0, []))[1]) != 6:
        return Geometry(segments=read_line3dpp(place).segments)
    table = array("d")
    for number, words in read_words(place):
        if len(words) != 6:
            raise FileFormatError(f"Line {number}: expected six coordinates, as in the first; got {len(words)} words.")
        table.extend(finite(words, f"Line {number}", "six finite coordinates"))
    return Geometry(segments=np.array(table).reshape(-1, 2, 3))


def _read_npy(place: Path) -> Geometry:
    return _of_array(read_array(place))


def _of_array(places: npt.NDArray[Any]) -> Geometry:
    if places.dtype.kind in "iuf" and places.ndim == 2 and places.shape[1] == 3:
        return Geometry(points=places)
    if places.dtype.kind in "iuf" and places.shape[1:] in ((6,), (2, 3)):
        return Geometry(segments=places.reshape(-1, 2, 3))
    raise FileFormatError(f"Expected an array (R, 6), (R, 2, 3) or (P, 3); got {places.dtype} {places.shape}.")


def _read_npz(place: Path) -> Geometry:
    with opened_arrays(place) as file:
        names = set(file.names)
        if "format" in names:
            return _of_scene(place)
        for name in ("lines", "segments"):
            if name in names:
                return _of_array(file.read(name))
        for vertices, elements in (("points", "edges"), ("vertices", "edges"), ("vertices", "faces")):
            if {vertices, elements} <= names:
                return _of_elements(file.read(vertices), _polygons(file.read(elements)))
        if "points" in names:
            return _of_array(file.read("points"))
    raise FileFormatError(f"Expected lines, segments, points and edges, or vertices and faces; got {sorted(names)}.")


def _polygons(elements: npt.NDArray[Any]) -> _Elements:
    """Return polygons of equal size as pairs, or cut into triangles."""
    if elements.ndim != 2 or elements.dtype.kind not in "iu":
        raise FileFormatError(f"Edges and faces must be whole numbers (M, n); got {elements.dtype} {elements.shape}.")
    count = elements.shape[1]
    if count <= 2:
        return elements if count == 2 else [], []
    return [], np.concatenate([elements[:, [0, k, k + 1]] for k in range(1, count - 1)])


def _fans(elements: list[Any]) -> _Elements:
    """Return those of two corners, and the triangles of all others (fans around their first corner)."""
    three = [e for e in elements if len(e) == 3]
    fans = [[e[0], e[k], e[k + 1]] for e in elements if len(e) > 3 for k in range(1, len(e) - 1)]
    return [e for e in elements if len(e) == 2], three + fans


def _of_elements(vertices: npt.NDArray[Any], elements: _Elements) -> Geometry:
    """Return the triangles between vertices, else the segments, else the vertices."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "iuf":
        raise FileFormatError(f"Vertices must have shape (P, 3); got {vertices.dtype} {vertices.shape}.")
    pairs, corners = (np.reshape(np.asarray(e, np.int64), (-1, n)) for e, n in zip(elements, (2, 3), strict=True))
    for index in (pairs, corners):
        if len(index) and (index.min() < 0 or index.max() >= len(vertices)):
            raise FileFormatError(f"An edge or face refers to vertex {index.max()}; there are {len(vertices)}.")
    if len(corners):
        return Geometry(triangles=vertices[corners])
    return Geometry(segments=vertices[pairs]) if len(pairs) else Geometry(points=vertices)


def _read_obj(place: Path) -> Geometry:
    vertices: list[list[float]] = []
    elements: list[list[int]] = []
    for number, words in read_words(place):
        if words[0] == "v":
            if len(words) < 4:
                raise FileFormatError(f"Line {number}: a vertex has three coordinates.")
            vertices.append(finite(words[1:4], f"Line {number}", "three finite coordinates"))
        elif words[0] in ("f", "l"):
            index = [whole(word.split("/")[0], f"Line {number}", "the number of a vertex") for word in words[1:]]
            index = [i - 1 if i > 0 else len(vertices) + i for i in index]
            elements += [index] if words[0] == "f" else [list(pair) for pair in pairwise(index)]
    return _of_elements(np.array(vertices, float).reshape(-1, 3), _fans(elements))


def _read_ply(place: Path) -> Geometry:
    vertices, elements = np.zeros((0, 3)), []
    for name, table in ply_tables(place):
        if name == "vertex":
            vertices = np.column_stack([np.asarray(table[axis], float) for axis in "xyz"])
        elif name == "edge":
            elements += np.column_stack([table["vertex1"], table["vertex2"]]).tolist()
        elif name == "face":
            column = "vertex_indices" if "vertex_indices" in table else "vertex_index"
            elements += [list(map(int, row)) for row in table[column]]
    return _of_elements(vertices, _fans(elements))
