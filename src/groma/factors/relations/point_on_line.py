# SPDX-License-Identifier: BSD-3-Clause
r"""A point lies on a line.

With the point p and the Plücker line (m, d)

.. math:: r = \frac{p \times d - m}{\lVert d \rVert}, \qquad \lVert r \rVert = \text{distance}, \qquad r \perp d .

Three rows of rank two. Two rows would need two axes across the line, and no choice of axes is continuous over all
lines; those of a chart would tie the residual to that chart and break where the chart does. The three rows are smooth
everywhere, do not depend on the chart, and, the noise being equal in all directions, give the normal equations and
the squared norm of the two-row form exactly.

.. math:: \frac{\partial r}{\partial p} = -\frac{[d]_\times}{\lVert d\rVert}, \quad
          \frac{\partial r}{\partial m} = -\frac{I}{\lVert d\rVert}, \quad
          \frac{\partial r}{\partial d} = \frac{[p]_\times}{\lVert d\rVert} - \frac{r\,d^\top}{\lVert d\rVert^2}

The distance is that of the Plücker notes, eq. (18), taken at p instead of the origin.
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
def _linearize(p, line, r, J_point, J_line):
    m0, m1, m2, d0, d1, d2 = line[0], line[1], line[2], line[3], line[4], line[5]
    dd = d0 * d0 + d1 * d1 + d2 * d2
    if not dd > 1e-200:
        return False
    k = 1.0 / math.sqrt(dd)
    r[0] = (p[1] * d2 - p[2] * d1 - m0) * k
    r[1] = (p[2] * d0 - p[0] * d2 - m1) * k
    r[2] = (p[0] * d1 - p[1] * d0 - m2) * k
    J_point[:] = 0.0
    J_point[0, 1], J_point[0, 2] = d2 * k, -d1 * k
    J_point[1, 0], J_point[1, 2] = -d2 * k, d0 * k
    J_point[2, 0], J_point[2, 1] = d1 * k, -d0 * k
    J_line[:] = 0.0
    J_line[0, 4], J_line[0, 5] = -p[2] * k, p[1] * k
    J_line[1, 3], J_line[1, 5] = p[2] * k, -p[0] * k
    J_line[2, 3], J_line[2, 4] = -p[1] * k, p[0] * k
    for i in range(3):
        J_line[i, i] = -k
        for j in range(3):
            J_line[i, 3 + j] -= r[i] * line[3 + j] * k * k
    return True


@loop
def _linearize_all(points, lines, point_index, line_index, begin, end, point_column, line_column, record):
    r, J_point, J_line = np.empty(3), np.empty((3, 3)), np.empty((3, 6))
    degenerate = 0
    for i in range(begin, end):
        if not _linearize(points[point_index[i]], lines[line_index[i]], r, J_point, J_line):
            r[:], J_point[:], J_line[:] = 0.0, 0.0, 0.0
            degenerate += 1
        put_block(J_point, record[i - begin], point_column)
        put_block(J_line, record[i - begin], line_column)
        put_residual(r, record[i - begin])
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("point_on_line")
@dataclass(frozen=True, kw_only=True)
class PointOnLine(Factor):
    """Points on lines; residual in scene units.

    Degenerate for a line at infinity (d = 0). Point and line are both landmarks: one of the two groups is then kept in
    the reduced system.
    """

    #: The points.
    point: Ref
    #: The lines, any scale of (m, d).
    line: Ref

    slots: ClassVar[tuple[Slot, ...]] = (Slot("point", "point"), Slot("line", "line"))
    rows: ClassVar[int] = 3
    independent_rows: ClassVar[int] = 2
    is_incidence: ClassVar[bool] = True

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        (points, lines), (i, j) = inputs, columns
        return _linearize_all(points, lines, self.point.index, self.line.index, begin, end, i, j, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        return make_example(cls(point=Ref("points", indices(rng, 5)), line=Ref("lines", indices(rng, 5))), rng)
