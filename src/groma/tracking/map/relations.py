# SPDX-License-Identifier: BSD-3-Clause
"""Relations between landmarks that the data support, and their factors.

A line lies on a plane if both its ends do and the plane was seen there. Planes whose normals are nearly parallel or
perpendicular are taken to be so; a robust loss lets go of those that are not.
"""

from __future__ import annotations

import math

import numpy as np

from groma._typing import IntArray
from groma.factors.contract import Factor, Ref
from groma.factors.losses import Cauchy
from groma.factors.relations.line_on_plane import SegmentOnPlane
from groma.factors.relations.orthogonal import OrthogonalPlanes
from groma.factors.relations.parallel import ParallelPlanes
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


def structure_factors(track_map: TrackMap, lines: IntArray, planes: IntArray) -> list[Factor]:
    """Return the factors of relations among the given landmarks; they count in ``lines`` and ``planes``."""
    factors: list[Factor] = []
    if not len(planes):
        return factors
    place = np.full(len(track_map.planes), -1)
    place[planes] = np.arange(len(planes))
    if len(lines):
        plane = track_map.lines.plane[lines]
        rows = np.flatnonzero((plane >= 0) & (place[plane] >= 0))
        if len(rows):
            factors.append(
                SegmentOnPlane(
                    line=Ref("lines", rows), plane=Ref("planes", place[plane[rows]]),
                    ends=track_map.lines.segment[lines[rows]], sqrt_information=1.0 / ON_PLANE_SIGMA, loss=Cauchy(1.0),
                )
            )  # fmt: skip
    for kind, pairs in zip((ParallelPlanes, OrthogonalPlanes), plane_pairs(track_map, planes), strict=True):
        if len(pairs):
            factors.append(
                kind(
                    first=Ref("planes", pairs[:, 0]), second=Ref("planes", pairs[:, 1]),
                    sqrt_information=1.0 / SQUARE_SIGMA, loss=Cauchy(1.0),
                )
            )  # fmt: skip
    return factors


__all__ = ["find_lines_on_planes", "plane_pairs", "structure_factors"]
