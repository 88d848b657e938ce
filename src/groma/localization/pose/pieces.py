# SPDX-License-Identifier: BSD-3-Clause
"""Pieces of a photograph that show the map, but not where a pose says: matches that disagree with it all alike.

Wrong matches disagree at random. Where neighbouring ones are off by the same way in the image, what they show is there,
in another place than the pose puts it: the photograph repeats the scene, or is put together of pieces.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from groma._typing import BoolArray, FloatArray
from groma.localization.pose.gates import VERDICT
from groma.localization.pose.matches import Matches
from groma.localization.pose.refinement import Refined, cells_of


def cells_elsewhere(
    refined: Refined, matches: Matches, beyond: float, there: FloatArray, some: BoolArray | None = None
) -> int:
    """Return how many cells of an image show the map elsewhere than a pose says, each like a cell beside it.

    Parameters
    ----------
    refined, matches
        The pose, and all that may be seen.
    beyond
        Matches that are off by less, pixels, do not disagree for sure.
    there : (n, 2)
        Pixels that show the place, whatever else looks like it.
    some : (N,), optional
        The matches of points that count, beside any others; by default all.
    """
    camera = refined.camera
    both = cells_of(np.concatenate([matches.points2d, there]), camera, VERDICT.cells)
    cell, shown = both[: matches.num_points], both[matches.num_points :]
    expected = camera.project(refined.pose, matches.points3d)
    off = matches.points2d - expected
    agreeing = np.concatenate([cell[refined.point_inliers], shown])
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero((np.linalg.norm(off, axis=1) > beyond) & ~np.isin(cell, agreeing))
    if len(rows) < 2:
        return 0
    side = max(camera.width, camera.height)
    pixels, cell, off = matches.points2d[rows], cell[rows], off[rows]
    first, second = KDTree(pixels).query_pairs(VERDICT.beside * side, output_type="ndarray").T
    alike = (cell[first] != cell[second]) & (
        _length(off[first] - off[second]) <= VERDICT.bend * _length(pixels[first] - pixels[second])
    )
    found = np.concatenate([first[alike], second[alike]])
    return len(np.unique(cell[found if some is None else found[some[rows[found]]]]))


def _length(vectors: FloatArray) -> FloatArray:
    return np.linalg.norm(vectors, axis=1)
