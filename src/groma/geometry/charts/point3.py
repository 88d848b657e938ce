# SPDX-License-Identifier: BSD-3-Clause
r"""Points: three numbers (x, y, z), their charts, and their homogeneous form [X, Y, Z, W].

.. math:: (x, y, z) = (X, Y, Z) / W, \qquad X_b = R\,X_a + t .

Points are moved into another frame by :func:`groma.geometry.se3.transform_points`.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.geometry.algebra import vectors
from groma.geometry.charts.point_inverse_depth import InverseDepthPoint
from groma.geometry.charts.registry import charts_of, register_chart
from groma.geometry.manifold import Euclidean

register_chart(Euclidean(3, "point"))
register_chart(InverseDepthPoint)
#: Charts of points by name: moved by addition, linear in the inverse of the distance from an anchor, registered ones.
POINT_CHARTS = charts_of("point")


def to_homogeneous(point: FloatArray) -> FloatArray:
    """Homogeneous points (..., 4) with W = 1 of points (..., 3)."""
    point = vectors(point, 3, "A point")
    return np.concatenate([point, np.ones((*point.shape[:-1], 1))], axis=-1)


def from_homogeneous(point: FloatArray) -> FloatArray:
    """Points (..., 3) of homogeneous points (..., 4), W last; NaN for points at infinity (W = 0)."""
    point = vectors(point, 4, "A homogeneous point", "W last")
    scale = point[..., 3:]
    return point[..., :3] / np.where(scale == 0, np.nan, scale)
