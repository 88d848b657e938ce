# SPDX-License-Identifier: BSD-3-Clause
r"""Two directions are perpendicular.

Of a line the direction d takes part, of a plane the normal n, and a vanishing direction is one itself. With unit
vectors

.. math:: r = \hat d_1 \cdot \hat d_2, \quad
          \frac{\partial r}{\partial d_1} = \frac{(\hat d_2 - r \hat d_1)^\top}{\lVert d_1\rVert}, \quad
          \frac{\partial r}{\partial d_2} = \frac{(\hat d_1 - r \hat d_2)^\top}{\lVert d_2\rVert} .

One row, the cosine of the angle. It turns its sign with the orientation of either direction; losses are even, so the
cost does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import FloatArray
from groma.factors._record import put_residual
from groma.factors.contract import Ref, Slot, register
from groma.factors.relations.parallel import DirectionPair, put_direction_block


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _linearize(d1, d2, r, J_first, J_second):
    k1 = d1[0] * d1[0] + d1[1] * d1[1] + d1[2] * d1[2]
    k2 = d2[0] * d2[0] + d2[1] * d2[1] + d2[2] * d2[2]
    if not (k1 > 1e-200 and k2 > 1e-200):
        return False
    k1, k2 = 1.0 / math.sqrt(k1), 1.0 / math.sqrt(k2)
    cosine = (d1[0] * d2[0] + d1[1] * d2[1] + d1[2] * d2[2]) * k1 * k2
    r[0] = cosine
    for j in range(3):
        J_first[0, j] = (d2[j] * k2 - cosine * d1[j] * k1) * k1
        J_second[0, j] = (d1[j] * k1 - cosine * d2[j] * k2) * k2
    return True


@loop
def _linearize_all(variables, indices, layout, begin, end, columns, record):
    sizes, offsets = layout
    r, J_first, J_second = np.empty(1), np.empty((1, 3)), np.empty((1, 3))
    degenerate = 0
    for i in range(begin, end):
        first = variables[0][indices[0][i], offsets[0] : offsets[0] + 3]
        second = variables[1][indices[1][i], offsets[1] : offsets[1] + 3]
        if not _linearize(first, second, r, J_first, J_second):
            r[:], J_first[:], J_second[:] = 0.0, 0.0, 0.0
            degenerate += 1
        put_direction_block(J_first, record[i - begin], columns[0], sizes[0], offsets[0])
        put_direction_block(J_second, record[i - begin], columns[1], sizes[1], offsets[1])
        put_residual(r, record[i - begin])
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, kw_only=True)
class _Orthogonal(DirectionPair):
    #: The one variable.
    first: Ref
    #: The other variable.
    second: Ref

    rows: ClassVar[int] = 1

    def linearize(
        self, inputs: tuple[Any, ...], begin: int, end: int, columns: tuple[int, ...], record: FloatArray
    ) -> int:
        indices, layout = (self.first.index, self.second.index), (self._sizes, self._offsets)
        return _linearize_all(inputs, indices, layout, begin, end, columns, record)


@register("orthogonal_lines")
@dataclass(frozen=True, kw_only=True)
class OrthogonalLines(_Orthogonal):
    """Pairs of perpendicular lines, which need not meet. Degenerate for a line at infinity."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "line"), Slot("second", "line"))


@register("orthogonal_planes")
@dataclass(frozen=True, kw_only=True)
class OrthogonalPlanes(_Orthogonal):
    """Pairs of perpendicular planes. Degenerate for the plane at infinity."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "plane"), Slot("second", "plane"))


@register("line_parallel_to_plane")
@dataclass(frozen=True, kw_only=True)
class LineParallelToPlane(_Orthogonal):
    """Lines parallel to planes: direction perpendicular to normal."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "line"), Slot("second", "plane"))


@register("line_perpendicular_to_direction")
@dataclass(frozen=True, kw_only=True)
class LinePerpendicularToDirection(_Orthogonal):
    """Lines perpendicular to vanishing directions, level edges and the vertical for example."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "line"), Slot("second", "direction"))


@register("plane_parallel_to_direction")
@dataclass(frozen=True, kw_only=True)
class PlaneParallelToDirection(_Orthogonal):
    """Planes that contain a vanishing direction, walls and the vertical for example."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "plane"), Slot("second", "direction"))


@register("orthogonal_directions")
@dataclass(frozen=True, kw_only=True)
class OrthogonalDirections(_Orthogonal):
    """Pairs of perpendicular vanishing directions, the axes of a building for example."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "direction"), Slot("second", "direction"))
