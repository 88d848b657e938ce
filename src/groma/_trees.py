# SPDX-License-Identifier: BSD-3-Clause
"""Trees of points, by SciPy. Its import takes a quarter of a second, and goes on beside other work where that is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.execution import map_ranges

if TYPE_CHECKING:
    from scipy.spatial import KDTree

#: Points that one piece of work looks up (cost: time only).
_POINTS_AT_ONCE = 1024


def kd_tree(points: FloatArray, **options: Any) -> KDTree:
    """Return the tree of points (N, d)."""
    from scipy.spatial import KDTree

    return KDTree(points, **options)


def nearest(tree: KDTree, places: FloatArray, number: int, within: float = np.inf) -> tuple[FloatArray, IntArray]:
    """Return distances (M, n) to the nearest points of a tree and which they are; infinite and N where none is."""
    distance, index = np.empty((len(places), number)), np.empty((len(places), number), np.int64)

    def look_up(part: slice) -> None:
        found = tree.query(places[part], number, distance_upper_bound=within)
        distance[part], index[part] = (one.reshape(-1, number) for one in found)  # without an axis of length one

    map_ranges(look_up, len(places), _POINTS_AT_ONCE)
    return distance, index
