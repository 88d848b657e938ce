# SPDX-License-Identifier: BSD-3-Clause
r"""Two lines meet.

With the Plücker lines :math:`(m_1, d_1)` and :math:`(m_2, d_2)` the distance between them, with a sign, is

.. math:: r = \frac{m_1 \cdot d_2 + m_2 \cdot d_1}{s}, \qquad c = d_1 \times d_2, \quad s = \lVert c\rVert .

.. math:: \frac{\partial r}{\partial m_1} = \frac{d_2^\top}{s}, \quad
          \frac{\partial r}{\partial d_1} = \frac{m_2^\top}{s} - r\,\frac{(d_2 \times c)^\top}{s^2}, \quad
          \frac{\partial r}{\partial m_2} = \frac{d_1^\top}{s}, \quad
          \frac{\partial r}{\partial d_2} = \frac{m_1^\top}{s} - r\,\frac{(c \times d_1)^\top}{s^2} .

One row. The numerator is the side operator of the Plücker notes, zero for lines in one plane; parallel lines, which
meet at infinity, are degenerate. The sign turns with the orientation of either line; losses are even, so the cost does
not.
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
def _linearize(one, other, r, J_one, J_other):
    a0, a1, a2, b0, b1, b2 = one[3], one[4], one[5], other[3], other[4], other[5]
    c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    squared = c0 * c0 + c1 * c1 + c2 * c2
    if not squared > 1e-12 * (a0 * a0 + a1 * a1 + a2 * a2) * (b0 * b0 + b1 * b1 + b2 * b2):
        return False
    k = 1.0 / math.sqrt(squared)
    side = one[0] * b0 + one[1] * b1 + one[2] * b2 + other[0] * a0 + other[1] * a1 + other[2] * a2
    r[0] = side * k
    w = r[0] * k * k
    J_one[0, 3] = other[0] * k - w * (b1 * c2 - b2 * c1)
    J_one[0, 4] = other[1] * k - w * (b2 * c0 - b0 * c2)
    J_one[0, 5] = other[2] * k - w * (b0 * c1 - b1 * c0)
    J_other[0, 3] = one[0] * k - w * (c1 * a2 - c2 * a1)
    J_other[0, 4] = one[1] * k - w * (c2 * a0 - c0 * a2)
    J_other[0, 5] = one[2] * k - w * (c0 * a1 - c1 * a0)
    for j in range(3):
        J_one[0, j] = other[3 + j] * k
        J_other[0, j] = one[3 + j] * k
    return True


@loop
def _linearize_all(first, second, first_index, second_index, begin, end, first_column, second_column, record):
    r, J_one, J_other = np.empty(1), np.empty((1, 6)), np.empty((1, 6))
    degenerate = 0
    for i in range(begin, end):
        if not _linearize(first[first_index[i]], second[second_index[i]], r, J_one, J_other):
            r[:], J_one[:], J_other[:] = 0.0, 0.0, 0.0
            degenerate += 1
        put_block(J_one, record[i - begin], first_column)
        put_block(J_other, record[i - begin], second_column)
        put_residual(r, record[i - begin])
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("lines_meeting")
@dataclass(frozen=True, kw_only=True)
class LinesMeeting(Factor):
    """Pairs of lines that meet; residual in scene units.

    Degenerate for parallel lines. Both are landmarks: lines are then kept in the reduced system.
    """

    #: The one line, any scale of (m, d).
    first: Ref
    #: The other line.
    second: Ref

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "line"), Slot("second", "line"))
    rows: ClassVar[int] = 1

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        (first, second), (i, j) = inputs, columns
        return _linearize_all(first, second, self.first.index, self.second.index, begin, end, i, j, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        # Groups of their own, so that no line is paired with itself.
        return make_example(cls(first=Ref("first", indices(rng, 4)), second=Ref("second", indices(rng, 4))), rng)
