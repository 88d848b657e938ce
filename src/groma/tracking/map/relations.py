# SPDX-License-Identifier: BSD-3-Clause
"""Relations between landmarks that the data support.

A line lies on a plane if both its ends do and the plane was seen there. Planes whose normals are nearly parallel or
perpendicular are taken to be so; a robust loss lets go of those that are not.
"""

from __future__ import annotations

import math

import numpy as np

from groma._typing import IntArray
from groma.scene import Relations
from groma.tracking.map.track_map import TrackMap

#: Distance of a line's ends from its plane: gate, and standard deviation, scene units.
ON_PLANE, ON_PLANE_SIGMA = 0.03, 0.01
#: The plane was seen within this distance of the line, scene units.
NEAR = 0.25
#: Angles between planes: gate, and standard deviation.
SQUARE, SQUARE_SIGMA = math.radians(4.0), math.radians(0.7)


def find_lines_on_planes(track_map: TrackMap) -> None:
    """Note for each line the plane it lies on, or -1."""
    lines, planes = track_map.lines, track_map.planes
    lines.plane[:] = -1
    rows, alive = np.flatnonzero(lines.alive), np.flatnonzero(planes.alive)
    if not len(rows) or not len(alive):
        return
    ends = lines.segment[rows]
    hesse = planes.hesse[alive]
    away = np.abs(ends @ hesse[:, :3].T + hesse[:, 3]).max(axis=1)
    best = away.argmin(axis=1)
    for k, plane in enumerate(alive):
        of = np.flatnonzero((best == k) & (away[:, k] < ON_PLANE))
        if len(of):
            samples = planes.samples[plane]
            samples = samples[np.isfinite(samples[:, 0])]
            middle = ends[of].mean(axis=1)
            gap = np.linalg.norm(middle[:, None] - samples[None], axis=2).min(axis=1)
            lines.plane[rows[of[gap < NEAR]]] = plane


def plane_pairs(track_map: TrackMap, rows: IntArray) -> tuple[IntArray, IntArray]:
    """Pairs (n, 2) of positions in ``rows`` of planes that are nearly parallel, and nearly perpendicular."""
    normals = track_map.planes.hesse[rows, :3]
    first, second = np.triu_indices(len(rows), 1)
    cosine = np.abs((normals[first] * normals[second]).sum(axis=1))
    pairs = np.column_stack([first, second])
    return pairs[cosine > math.cos(SQUARE)], pairs[cosine < math.sin(SQUARE)]


def find_relations(track_map: TrackMap, lines: IntArray, planes: IntArray) -> Relations:
    """Return the relations among the given landmarks; they count in ``lines`` and ``planes``."""
    if not len(planes):
        return Relations()
    place = np.full(len(track_map.planes), -1)
    place[planes] = np.arange(len(planes))
    plane = track_map.lines.plane[lines]
    rows = np.flatnonzero((plane >= 0) & (place[plane] >= 0))
    parallel, perpendicular = plane_pairs(track_map, planes)
    return Relations(
        line_on_plane=np.column_stack([rows, place[plane[rows]]]),
        line_on_plane_sigma=np.full(len(rows), ON_PLANE_SIGMA),
        parallel_planes=parallel,
        parallel_planes_sigma=np.full(len(parallel), SQUARE_SIGMA),
        perpendicular_planes=perpendicular,
        perpendicular_planes_sigma=np.full(len(perpendicular), SQUARE_SIGMA),
    )


__all__ = ["find_lines_on_planes", "find_relations", "plane_pairs"]
