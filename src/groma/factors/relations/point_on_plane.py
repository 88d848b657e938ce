# SPDX-License-Identifier: BSD-3-Clause
r"""A point lies on a plane.

With the point p and the plane (n, w), :math:`n \cdot X + w = 0`, of any scale,

.. math:: r = \frac{n \cdot p + w}{\lVert n \rVert}, \quad
          \frac{\partial r}{\partial p} = \hat n^\top, \quad
          \frac{\partial r}{\partial (n, w)} =
          \frac{1}{\lVert n\rVert} \left[\, (p - r\,\hat n)^\top ,\; 1 \,\right],

the signed distance in scene units, with :math:`\hat n = n/\lVert n \rVert`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import indices, make_example
from groma.factors._record import put_block, put_residual
from groma.factors.contract import Example, Factor, Ref, Slot, register


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _linearize(p, plane, r, J_point, J_plane):
    nn = plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2]
    if not nn > 1e-200:
        return False
    k = 1.0 / math.sqrt(nn)
    r[0] = (plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2] + plane[3]) * k
    for j in range(3):
        J_point[0, j] = plane[j] * k
        J_plane[0, j] = (p[j] - r[0] * plane[j] * k) * k
    J_plane[0, 3] = k
    return True


@loop
def _linearize_all(points, planes, point_index, plane_index, begin, end, point_column, plane_column, record):
    r, J_point, J_plane = np.empty(1), np.empty((1, 3)), np.empty((1, 4))
    degenerate = 0
    for i in range(begin, end):
        if not _linearize(points[point_index[i]], planes[plane_index[i]], r, J_point, J_plane):
            r[:], J_point[:], J_plane[:] = 0.0, 0.0, 0.0
            degenerate += 1
        put_block(J_point, record[i - begin], point_column)
        put_block(J_plane, record[i - begin], plane_column)
        put_residual(r, record[i - begin])
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("point_on_plane")
@dataclass(frozen=True, kw_only=True)
class PointOnPlane(Factor):
    """Points on planes; residual in scene units. Degenerate for the plane at infinity (n = 0)."""

    #: The points.
    point: Ref
    #: The planes, any scale of (n, w).
    plane: Ref

    slots: ClassVar[tuple[Slot, ...]] = (Slot("point", "point"), Slot("plane", "plane"))
    rows: ClassVar[int] = 1
    is_incidence: ClassVar[bool] = True

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        (points, planes), (i, j) = inputs, columns
        return _linearize_all(points, planes, self.point.index, self.plane.index, begin, end, i, j, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        return make_example(cls(point=Ref("points", indices(rng, 5)), plane=Ref("planes", indices(rng, 3))), rng)
