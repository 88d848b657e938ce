# SPDX-License-Identifier: BSD-3-Clause
"""PLY and OBJ files of the geometry of a scene, for viewers and modellers: points, lines, pieces of planes.

Both files hold vertices with colours first: points, then the ends of the segments (one for every interval that
images support), then the corners of the planes. The
pieces of planes are the convex hulls of what lies on them (:mod:`groma.scene.patches`). Programs differ in what they
read: all of them read vertices and faces with the colours of vertices; edges of PLY are read by MeshLab and
Blender, ``l`` of OBJ by Blender, MeshLab and CloudCompare. Faces are triangles in PLY, because CloudCompare reads no
others, and whole polygons in OBJ, where a program can then move a plane as one object.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.errors import InputError
from groma.io.atomic import atomic_output
from groma.io.registry import SceneFormat, register_format
from groma.scene import Scene
from groma.scene.line_intervals import line_pieces
from groma.scene.patches import PALETTE, patch_groups, plane_patches, triangle_fans

Part = Literal["points", "lines", "planes"]
PARTS: tuple[Part, ...] = ("points", "lines", "planes")
#: Points whose colours are not known; lines that share their direction with no others.
_POINT_GREY = 128
_LINE_COLOUR = (220, 60, 40)


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
        rows += [f"o plane_{number}", "f " + " ".join(str(row + 1) for row in corners.tolist())]
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
    unknown = set(parts) - set(PARTS)
    if isinstance(parts, str) or unknown or not parts:
        raise InputError(f"parts must be some of {', '.join(PARTS)}; got {parts!r}.")
    num_points = scene.num_points if "points" in parts else 0
    pieces, line = line_pieces(scene) if "lines" in parts else (np.zeros((0, 2, 3)), np.zeros(0, np.int64))
    num_lines = len(line)
    polygons, members = plane_patches(scene) if "planes" in parts else ([], np.zeros(0, np.int64))
    begin = num_points + 2 * num_lines + np.cumsum([0, *(len(corners) for corners in polygons)])
    points = scene.points.color[:num_points]
    return _Geometry(
        places=np.concatenate([scene.points.xyz[:num_points], pieces.reshape(-1, 3), *polygons]),
        colours=np.concatenate(
            [
                points if points.any() else np.full_like(points, _POINT_GREY),
                np.repeat(_line_colours(scene)[line], 2, axis=0),
                np.repeat(PALETTE[patch_groups(members)], [len(corners) for corners in polygons], axis=0),
            ]
        ),
        num_points=num_points,
        edges=num_points + np.arange(2 * num_lines).reshape(-1, 2),
        polygons=[first + np.arange(len(corners)) for first, corners in zip(begin, polygons, strict=False)],
        triangles=begin[0] + triangle_fans(polygons)[1],
        plane_ids=scene.planes.ids.tolist()[: len(polygons)],
    )


def _line_colours(scene: Scene) -> npt.NDArray[np.uint8]:
    """One colour per shared direction."""
    colours = np.tile(np.array(_LINE_COLOUR, np.uint8), (scene.num_lines, 1))
    line, direction = scene.relations.line_along_direction.T
    colours[line] = PALETTE[direction % len(PALETTE)]
    return colours


register_format(SceneFormat("ply", target=".ply", endings=(".ply",), write=write_ply))
register_format(SceneFormat("obj", target=".obj", endings=(".obj",), write=write_obj))

__all__ = ["PARTS", "Part", "write_geometry", "write_obj", "write_ply"]
