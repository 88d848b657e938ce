# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks and observations in a page, limited in number so that it opens within a second.

Observations are kept by landmark: a line picked in the scene is highlighted in every photograph that observes it, so
all of its segments are in the page; if there are too many, fewer lines have segments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, IntArray
from groma.scene import Scene
from groma.scene.line_intervals import line_pieces
from groma.viz.pack import thin

#: More points, and more pieces of lines, than this are thinned out evenly.
MAX_POINTS = 200_000
MAX_LINES = 40_000
#: More observations of points, and of lines, than this are left out, landmark by landmark.
MAX_POINT_ROWS = 80_000
MAX_SEGMENT_ROWS = 60_000


@dataclass(frozen=True)
class Kept:
    """Landmarks and observations that the page holds, as rows of the scene, ascending."""

    points: IntArray
    lines: IntArray
    point_observations: IntArray
    line_observations: IntArray

    def meeting(self, scene: Scene) -> IntArray:
        """(J, 2) lines that meet, both in the page."""
        pairs = scene.relations.lines_meeting
        return pairs[_member(self.lines, scene.num_lines)[pairs].all(axis=1)]


def kept(scene: Scene) -> Kept:
    """Choose the parts of a scene that the page holds."""
    points = thin(scene.num_points, MAX_POINTS)
    pieces = len(line_pieces(scene)[1])
    lines = thin(scene.num_lines, max(1, MAX_LINES * scene.num_lines // max(pieces, 1)))
    return Kept(
        points,
        lines,
        _observations(scene.point_observations.point_idx, _member(points, scene.num_points), MAX_POINT_ROWS),
        _observations(scene.line_observations.line_idx, _member(lines, scene.num_lines), MAX_SEGMENT_ROWS),
    )


def _member(rows: IntArray, count: int) -> BoolArray:
    found = np.zeros(count, bool)
    found[rows] = True
    return found


def _observations(owner: IntArray, wanted: BoolArray, limit: int) -> IntArray:
    """Return the observations of the given landmarks, or of a random choice of them within the limit."""
    count = np.where(wanted, np.bincount(owner, minlength=len(wanted)), 0)
    if count.sum() > limit:
        order = np.random.default_rng(0).permutation(len(wanted))
        wanted = wanted.copy()
        wanted[order] &= np.cumsum(count[order]) <= limit
    return np.flatnonzero(wanted[owner])
