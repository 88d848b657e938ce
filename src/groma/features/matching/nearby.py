# SPDX-License-Identifier: BSD-3-Clause
"""Which points lie near which segments: the support that point matches lend to line matches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._numba import loop
from groma._rows import pointers_of
from groma._typing import FloatArray, IntArray
from groma.errors import ShapeError, check_kind
from groma.features.segments import Segments
from groma.geometry.algebra import numbers


@dataclass(frozen=True)
class NearbyPoints:
    """Points near each segment of one image, as a compressed table with ascending identifiers in every row."""

    #: (N + 1,) row n is begin[n] to begin[n + 1].
    begin: npt.NDArray[np.int64]
    #: (E,) identifiers, shared with the other images.
    point_id: npt.NDArray[np.int64]
    #: (E,) signed distance from the segment's line in pixels, positive on the right.
    distance: FloatArray

    def common_with(self, other: NearbyPoints) -> NearbyPoints:
        """Without the points that are near no segment of the other image: not seen there, or far from all lines."""
        keep = np.isin(self.point_id, other.point_id)
        return NearbyPoints(pointers_of(keep)[self.begin], self.point_id[keep], self.distance[keep])


@loop
def _near_all(ends, points, reach, beyond, fill, begin, column, distance):
    """Points in a box around each segment; counts into `begin` first, then fills."""
    at = 0
    for n in range(ends.shape[0]):
        u, v = ends[n, 0], ends[n, 1]
        du, dv = ends[n, 2] - u, ends[n, 3] - v
        length = max(np.sqrt(du * du + dv * dv), 1e-9)
        du, dv = du / length, dv / length
        low, high = -beyond * reach, length + beyond * reach
        for k in range(points.shape[0]):
            x, y = points[k, 0] - u, points[k, 1] - v
            across = y * du - x * dv
            if across > reach or across < -reach:
                continue
            along = x * du + y * dv
            if along < low or along > high:
                continue
            if fill:
                column[at], distance[at] = k, across
            at += 1
        begin[n + 1] = at


def nearby_points(segments: Segments, points: FloatArray, point_ids: IntArray, reach: float = 40.0) -> NearbyPoints:
    """Points within `reach` of each segment.

    Parameters
    ----------
    segments : Segments
        N segments of one image.
    points : (P, 2) float64
        Points seen in that image, pixels.
    point_ids : (P,) int
        What identifies a point across images: row of the match, or of the 3D point.
    reach : float
        Half width of the box on either side, pixels; it reaches half as far beyond the end points.
    """
    check_kind(segments, Segments, "segments", "Detect them: groma.features.LsdDetector().detect(image).")
    points, point_ids = np.ascontiguousarray(numbers(points, "points")), np.asarray(point_ids, dtype=np.int64)
    if points.ndim != 2 or points.shape[1] != 2 or point_ids.shape != (len(points),):
        raise ShapeError(f"points must have shape (P, 2) and point_ids (P,); got {points.shape} and {point_ids.shape}.")
    order = np.argsort(point_ids, kind="stable")
    order = order[np.isfinite(points[order]).all(axis=1)]
    points, point_ids = points[order], point_ids[order]
    begin = np.zeros(len(segments) + 1, dtype=np.int64)
    column, distance = np.zeros(0, dtype=np.int64), np.zeros(0)
    _near_all(segments.ends, points, reach, 0.5, False, begin, column, distance)
    column, distance = np.zeros(begin[-1], dtype=np.int64), np.zeros(begin[-1])
    _near_all(segments.ends, points, reach, 0.5, True, begin, column, distance)
    return NearbyPoints(begin, point_ids[column], distance)
