# SPDX-License-Identifier: BSD-3-Clause
"""PLY and OBJ files of the geometry of a scene, for viewers: points with colour, lines as edges."""

from __future__ import annotations

import os

import numpy as np

from groma.io._atomic import atomic_output
from groma.scene import Scene


def write_ply(scene: Scene, path: str | os.PathLike[str], force: bool = False) -> None:
    """Write points and line segments as a binary PLY file; vertices are first the points, then the segments' ends."""
    vertices = np.zeros(
        scene.num_points + 2 * scene.num_lines,
        [("xyz", "<f8", 3), ("color", "u1", 3)],
    )
    vertices["xyz"] = np.concatenate([scene.points.xyz, scene.lines.segments.reshape(-1, 3)])
    vertices["color"][: scene.num_points] = scene.points.color
    vertices["color"][scene.num_points :] = (220, 60, 40)
    edges = scene.num_points + np.arange(2 * scene.num_lines, dtype="<i4").reshape(-1, 2)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment points, then end points of line segments",
        f"element vertex {len(vertices)}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {color}" for color in ("red", "green", "blue")),
        f"element edge {len(edges)}",
        "property int vertex1",
        "property int vertex2",
        "end_header",
        "",
    ]
    with atomic_output(path, force) as draft:
        draft.write_bytes("\n".join(header).encode() + vertices.tobytes() + edges.astype("<i4").tobytes())


def write_obj(scene: Scene, path: str | os.PathLike[str], force: bool = False) -> None:
    """Write points and line segments as an OBJ file (``v``, ``p`` and ``l`` records)."""
    vertices = np.concatenate([scene.points.xyz, scene.lines.segments.reshape(-1, 3)])
    rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    rows += [f"p {row + 1}" for row in range(scene.num_points)]
    start = scene.num_points
    rows += [f"l {start + 2 * row + 1} {start + 2 * row + 2}" for row in range(scene.num_lines)]
    with atomic_output(path, force) as draft:
        draft.write_text("\n".join(rows) + "\n")


__all__ = ["write_obj", "write_ply"]
