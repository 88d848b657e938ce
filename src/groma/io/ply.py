# SPDX-License-Identifier: BSD-3-Clause
"""PLY and OBJ files of the geometry of a scene, for viewers and modellers: points, lines, pieces of planes.

Both files hold vertices with colours first: points, then the ends of the segments (one for every interval that
images support), then the corners of the planes. The
pieces of planes are the convex hulls of what lies on them (:mod:`groma.scene.patches`). Programs differ in what they
read: all of them read vertices and faces with the colours of vertices; edges of PLY are read by MeshLab and
Blender, ``l`` of OBJ by Blender, MeshLab and CloudCompare. Faces are triangles, because CloudCompare and Open3D read no
others. In OBJ every plane is an object, which a program can move.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from groma._rows import pointers_of
from groma._typing import FloatArray, IntArray
from groma.io.atomic import atomic_output
from groma.io.drawn import PARTS, Part, drawn
from groma.io.registry import SceneFormat, register_format
from groma.scene import Scene
from groma.scene.checks import check_scene_given
from groma.scene.patches import triangle_fans


@dataclass(frozen=True)
class _Geometry:
    """Vertices with colours, and what joins them."""

    places: FloatArray
    colours: npt.NDArray[np.uint8]
    num_points: int
    #: (L, 2) rows of vertices.
    edges: IntArray
    #: Convex polygons, and the same cut into triangles (t, 3): rows of vertices; and the planes they lie in.
    polygons: list[IntArray]
    triangles: IntArray
    plane_ids: list[int]


def write_ply(scene: Scene, path: str | os.PathLike[str], force: bool = False, parts: Collection[Part] = PARTS) -> None:
    """Write points, line segments (as edges) and pieces of planes (as triangles) as a binary PLY file.

    Parameters
    ----------
    scene : Scene
        What to write.
    path : path
        The file.
    force : bool
        Replace an existing file.
    parts : collection of str
        Any of ``points``, ``lines`` and ``planes``.
    """
    check_scene_given(scene)
    geometry = _geometry(scene, parts)
    vertices = np.zeros(len(geometry.places), [("xyz", "<f8", 3), ("color", "u1", 3)])
    vertices["xyz"], vertices["color"] = geometry.places, geometry.colours
    faces = np.zeros(len(geometry.triangles), [("count", "u1"), ("rows", "<i4", 3)])
    faces["count"], faces["rows"] = 3, geometry.triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {', then '.join(part for part in PARTS if part in parts)}",
        f"element vertex {len(vertices)}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {color}" for color in ("red", "green", "blue")),
    ]
    if len(faces):
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += [f"element edge {len(geometry.edges)}", "property int vertex1", "property int vertex2", "end_header", ""]
    with atomic_output(path, force) as draft:
        draft.write_bytes(
            "\n".join(header).encode() + vertices.tobytes() + faces.tobytes() + geometry.edges.astype("<i4").tobytes()
        )


def write_obj(scene: Scene, path: str | os.PathLike[str], force: bool = False, parts: Collection[Part] = PARTS) -> None:
    """Write points (``p``), line segments (``l``) and pieces of planes (``f``) as an OBJ file; see :func:`write_ply`.

    Colours stand behind the coordinates, as most programs expect them. Points, lines and every plane are objects.
    """
    check_scene_given(scene)
    geometry = _geometry(scene, parts)
    shares = np.round(geometry.colours / 255.0, 4).tolist()
    rows = [
        f"v {x!r} {y!r} {z!r} {red:g} {green:g} {blue:g}"
        for (x, y, z), (red, green, blue) in zip(geometry.places.tolist(), shares, strict=True)
    ]
    if geometry.num_points:
        rows += ["o points", *(f"p {row + 1}" for row in range(geometry.num_points))]
    if len(geometry.edges):
        rows += ["o lines", *(f"l {first} {second}" for first, second in (geometry.edges + 1).tolist())]
    for number, corners in zip(geometry.plane_ids, geometry.polygons, strict=True):
        first, *others = (corners + 1).tolist()
        rows += [f"o plane_{number}", *(f"f {first} {second} {third}" for second, third in pairwise(others))]
    with atomic_output(path, force) as draft:
        draft.write_text("\n".join(rows) + "\n", encoding="ascii")


def write_geometry(scene: Scene, folder: str | os.PathLike[str]) -> tuple[str, ...]:
    """Write ``lines.ply``, ``lines.obj`` and ``planes.ply`` into a folder, those of which there is something.

    Parameters
    ----------
    scene : Scene
        What to write.
    folder : path
        Where; the files must not be there yet.

    Returns
    -------
    tuple of str
        The names of the files.
    """
    names = []
    if scene.num_lines:
        write_ply(scene, Path(folder) / "lines.ply", parts=("lines",))
        write_obj(scene, Path(folder) / "lines.obj", parts=("lines",))
        names += ["lines.ply", "lines.obj"]
    if scene.num_planes:
        write_ply(scene, Path(folder) / "planes.ply", parts=("planes",))
        names.append("planes.ply")
    return tuple(names)


def _geometry(scene: Scene, parts: Collection[Part]) -> _Geometry:
    shown = drawn(scene, parts)
    num_points, num_lines = len(shown.points), len(shown.pieces)
    begin = num_points + 2 * num_lines + pointers_of([len(corners) for corners in shown.polygons])
    return _Geometry(
        places=shown.places,
        colours=shown.colours,
        num_points=num_points,
        edges=num_points + np.arange(2 * num_lines).reshape(-1, 2),
        polygons=[first + np.arange(len(corners)) for first, corners in zip(begin, shown.polygons, strict=False)],
        triangles=begin[0] + triangle_fans(shown.polygons)[1],
        plane_ids=shown.plane_ids,
    )


register_format(SceneFormat("ply", target=".ply", endings=(".ply",), write=write_ply))
register_format(SceneFormat("obj", target=".obj", endings=(".obj",), write=write_obj))

__all__ = ["PARTS", "Part", "write_geometry", "write_obj", "write_ply"]
