# SPDX-License-Identifier: BSD-3-Clause
"""Trees of points, by SciPy. Its import takes a quarter of a second, and goes on beside other work where that is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from groma._typing import FloatArray

if TYPE_CHECKING:
    from scipy.spatial import KDTree


def kd_tree(points: FloatArray, **options: Any) -> KDTree:
    """Return the tree of points (N, d)."""
    from scipy.spatial import KDTree

    return KDTree(points, **options)
