# SPDX-License-Identifier: BSD-3-Clause
"""Relations between landmarks that the data support.

A line lies on a plane of depth images if both its ends do and the plane was seen there. Such planes whose normals are
nearly parallel or perpendicular are taken to be so; a robust loss lets go of those that are not. What lies on planes of
the map's own points and lines is found with them (:mod:`groma.tracking.map.landmark_planes`).
"""

from __future__ import annotations

import math

import numpy as np

from groma._typing import IntArray
from groma.scene import Relations
from groma.tracking.map.track_map import TrackMap

#: Distance of a line's ends from its plane: gate, and standard deviation, scene units (of depth cameras: metres).
ON_PLANE, ON_PLANE_SIGMA = 0.03, 0.01
#: The plane was seen within this distance of the line, scene units.
NEAR = 0.25
#: Angles between planes: gate, and standard deviation.
SQUARE, SQUARE_SIGMA = math.radians(4.0), math.radians(0.7)


def find_lines_on_planes(track_map: TrackMap) -> None:
    """Note for each line the plane of depth images that it lies on, or -1; those on planes of landmarks stay there."""
    lines, planes = track_map.lines, track_map.planes
    loose = ~np.isin(lines.plane, np.flatnonzero(planes.of_landmarks))
    lines.plane[loose] = -1
    rows, alive = np.flatnonzero(lines.alive & loose), np.flatnonzero(planes.alive & ~planes.of_landmarks)
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
            near = rows[of[gap < NEAR]]
            lines.plane[near], lines.plane_sigma[near] = plane, ON_PLANE_SIGMA


def plane_pairs(track_map: TrackMap, rows: IntArray) -> tuple[IntArray, IntArray]:
    """Pairs (n, 2) of positions in ``rows`` of planes of depth images: nearly parallel, and nearly perpendicular."""
    seen = np.flatnonzero(~track_map.planes.of_landmarks[rows])
    normals = track_map.planes.hesse[rows, :3]
    pairs = seen[np.column_stack(np.triu_indices(len(seen), 1))]
    cosine = np.abs((normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1))
    return pairs[cosine > math.cos(SQUARE)], pairs[cosine < math.sin(SQUARE)]


def find_relations(track_map: TrackMap, points: IntArray, lines: IntArray, planes: IntArray) -> Relations:
    """Return the relations among the given landmarks; they count in ``points``, ``lines`` and ``planes``."""
    if not len(planes):
        return Relations()
    place = np.full(len(track_map.planes) + 1, -1)
    place[planes] = np.arange(len(planes))
    # Landmarks without a plane have the number -1, which is the last place.
    of_point, of_line = place[track_map.points.plane[points]], place[track_map.lines.plane[lines]]
    on, along = np.flatnonzero(of_point >= 0), np.flatnonzero(of_line >= 0)
    parallel, perpendicular = plane_pairs(track_map, planes)
    return Relations(
        point_on_plane=np.column_stack([on, of_point[on]]),
        point_on_plane_sigma=track_map.points.plane_sigma[points[on]],
        line_on_plane=np.column_stack([along, of_line[along]]),
        line_on_plane_sigma=track_map.lines.plane_sigma[lines[along]],
        parallel_planes=parallel,
        parallel_planes_sigma=np.full(len(parallel), SQUARE_SIGMA),
        perpendicular_planes=perpendicular,
        perpendicular_planes_sigma=np.full(len(perpendicular), SQUARE_SIGMA),
    )
