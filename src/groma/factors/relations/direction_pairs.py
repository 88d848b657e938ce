# SPDX-License-Identifier: BSD-3-Clause
r"""Two directions are parallel, or perpendicular.

Of a line the direction d takes part, of a plane the normal n, and a vanishing direction is one itself. With unit
vectors, *parallel* is

.. math:: r = \hat d_1 \times \hat d_2, \quad
          \frac{\partial r}{\partial d_1} = -[\hat d_2]_\times \frac{I - \hat d_1 \hat d_1^\top}{\lVert d_1\rVert},
          \quad
          \frac{\partial r}{\partial d_2} = [\hat d_1]_\times \frac{I - \hat d_2 \hat d_2^\top}{\lVert d_2\rVert} .

:math:`\lVert r\rVert` is the sine of the angle. Three rows of rank two, smooth everywhere; zero for opposite
directions too, so the orientation of a line or a plane does not matter. *Perpendicular* is

.. math:: r = \hat d_1 \cdot \hat d_2, \quad
          \frac{\partial r}{\partial d_1} = \frac{(\hat d_2 - r \hat d_1)^\top}{\lVert d_1\rVert}, \quad
          \frac{\partial r}{\partial d_2} = \frac{(\hat d_1 - r \hat d_2)^\top}{\lVert d_2\rVert} .

One row, the cosine of the angle. It turns its sign with the orientation of either direction; losses are even, so the
cost does not. A line is parallel to a *plane* where it is perpendicular to the normal.

Many lines share one vanishing direction, which is a variable of its own: it gathers what all of them say, and stays in
the reduced system while the lines are eliminated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import indices, make_example
from groma.factors._record import put_residual
from groma.factors.contract import ANY_SIMILARITY, Example, Factor, Invariance, Ref, Slot, register
from groma.geometry.manifold import FACTOR_COLUMNS

#: Where the direction starts in the numbers of each kind.
DIRECTION_OFFSET = {"line": 3, "plane": 0, "direction": 0}


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def put_direction_block(J, record, column, size, offset):
    """Write a block of ``size`` columns that is zero except for ``J`` (m, 3) at ``offset``."""
    if column >= 0:
        for i in range(J.shape[0]):
            for j in range(size):
                record[i, column + j] = 0.0
            for j in range(3):
                record[i, column + offset + j] = J[i, j]


@kernel
def _parallel(d1, d2, k1, k2, r, J_first, J_second):
    a0, a1, a2 = d1[0] * k1, d1[1] * k1, d1[2] * k1
    b0, b1, b2 = d2[0] * k2, d2[1] * k2, d2[2] * k2
    r[0], r[1], r[2] = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    # -[b] (I - a aᵀ) = -[b] - r aᵀ, as [b] a = -r; and [a] (I - b bᵀ) = [a] - r bᵀ
    J_first[0, 0], J_first[0, 1], J_first[0, 2] = 0.0, b2, -b1
    J_first[1, 0], J_first[1, 1], J_first[1, 2] = -b2, 0.0, b0
    J_first[2, 0], J_first[2, 1], J_first[2, 2] = b1, -b0, 0.0
    J_second[0, 0], J_second[0, 1], J_second[0, 2] = 0.0, -a2, a1
    J_second[1, 0], J_second[1, 1], J_second[1, 2] = a2, 0.0, -a0
    J_second[2, 0], J_second[2, 1], J_second[2, 2] = -a1, a0, 0.0
    for i in range(3):
        J_first[i, 0] = (J_first[i, 0] - r[i] * a0) * k1
        J_first[i, 1] = (J_first[i, 1] - r[i] * a1) * k1
        J_first[i, 2] = (J_first[i, 2] - r[i] * a2) * k1
        J_second[i, 0] = (J_second[i, 0] - r[i] * b0) * k2
        J_second[i, 1] = (J_second[i, 1] - r[i] * b1) * k2
        J_second[i, 2] = (J_second[i, 2] - r[i] * b2) * k2


@kernel
def _perpendicular(d1, d2, k1, k2, r, J_first, J_second):
    cosine = (d1[0] * d2[0] + d1[1] * d2[1] + d1[2] * d2[2]) * k1 * k2
    r[0] = cosine
    for j in range(3):
        J_first[0, j] = (d2[j] * k2 - cosine * d1[j] * k1) * k1
        J_second[0, j] = (d1[j] * k1 - cosine * d2[j] * k2) * k2


@loop
def _linearize_all(variables, indices, layout, begin, end, columns, record):
    """Write the records of either relation; how many rows they have says which."""
    (sizes, offsets), rows = layout, record.shape[1]
    r, J = np.empty(rows), np.empty((2, rows, 3))
    degenerate = 0
    for i in range(begin, end):
        first = variables[0][indices[0][i], offsets[0] : offsets[0] + 3]
        second = variables[1][indices[1][i], offsets[1] : offsets[1] + 3]
        k1 = first[0] * first[0] + first[1] * first[1] + first[2] * first[2]
        k2 = second[0] * second[0] + second[1] * second[1] + second[2] * second[2]
        if k1 > 1e-200 and k2 > 1e-200:
            k1, k2 = 1.0 / math.sqrt(k1), 1.0 / math.sqrt(k2)
            if rows == 3:
                _parallel(first, second, k1, k2, r, J[0], J[1])
            else:
                _perpendicular(first, second, k1, k2, r, J[0], J[1])
        else:
            r[:], J[:] = 0.0, 0.0
            degenerate += 1
        for k in range(2):
            put_direction_block(J[k], record[i - begin], columns[k], sizes[k], offsets[k])
        put_residual(r, record[i - begin])
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
class DirectionPair(Factor):
    """Two variables that each have a direction: two slots of kind line, plane or direction."""

    invariance: ClassVar[Invariance] = ANY_SIMILARITY

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        (_, first), (_, second) = self.references()
        kinds = [slot.kind for slot in self.slots]
        sizes, offsets = (tuple(table[kind] for kind in kinds) for table in (FACTOR_COLUMNS, DIRECTION_OFFSET))
        return _linearize_all(inputs, (first.index, second.index), (sizes, offsets), begin, end, columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        # Groups of their own, so that no direction is paired with itself.
        refs: dict[str, Any] = {slot.name: Ref(slot.name, indices(rng, 4)) for slot in cls.slots}
        return make_example(cls(**refs), rng)


@dataclass(frozen=True, kw_only=True)
class _Pair(DirectionPair):
    #: The one variable.
    first: Ref
    #: The other variable.
    second: Ref


class _Parallel(_Pair):
    rows: ClassVar[int] = 3
    independent_rows: ClassVar[int] = 2


class _Orthogonal(_Pair):
    rows: ClassVar[int] = 1


@register("line_direction")
@dataclass(frozen=True, kw_only=True)
class LineDirection(DirectionPair):
    """Lines parallel to vanishing directions, either way round. Degenerate for a line at infinity."""

    #: The lines, any scale of (m, d).
    line: Ref
    #: The vanishing directions.
    direction: Ref

    rows: ClassVar[int] = 3
    independent_rows: ClassVar[int] = 2
    slots: ClassVar[tuple[Slot, ...]] = (Slot("line", "line"), Slot("direction", "direction"))


@register("parallel_lines")
class ParallelLines(_Parallel):
    """Pairs of parallel lines. Degenerate for a line at infinity."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "line"), Slot("second", "line"))


@register("parallel_planes")
class ParallelPlanes(_Parallel):
    """Pairs of parallel planes. Degenerate for the plane at infinity."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "plane"), Slot("second", "plane"))


@register("line_perpendicular_to_plane")
class LinePerpendicularToPlane(_Parallel):
    """Lines perpendicular to planes: direction parallel to normal."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "line"), Slot("second", "plane"))


@register("plane_perpendicular_to_direction")
class PlanePerpendicularToDirection(_Parallel):
    """Planes whose normal is a vanishing direction, a floor and the vertical for example."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "plane"), Slot("second", "direction"))


@register("parallel_directions")
class ParallelDirections(_Parallel):
    """Pairs of equal vanishing directions, up to orientation."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "direction"), Slot("second", "direction"))


@register("orthogonal_lines")
class OrthogonalLines(_Orthogonal):
    """Pairs of perpendicular lines, which need not meet. Degenerate for a line at infinity."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "line"), Slot("second", "line"))


@register("orthogonal_planes")
class OrthogonalPlanes(_Orthogonal):
    """Pairs of perpendicular planes. Degenerate for the plane at infinity."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "plane"), Slot("second", "plane"))


@register("line_parallel_to_plane")
class LineParallelToPlane(_Orthogonal):
    """Lines parallel to planes: direction perpendicular to normal."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "line"), Slot("second", "plane"))


@register("line_perpendicular_to_direction")
class LinePerpendicularToDirection(_Orthogonal):
    """Lines perpendicular to vanishing directions, level edges and the vertical for example."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "line"), Slot("second", "direction"))


@register("plane_parallel_to_direction")
class PlaneParallelToDirection(_Orthogonal):
    """Planes that contain a vanishing direction, walls and the vertical for example."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "plane"), Slot("second", "direction"))


@register("orthogonal_directions")
class OrthogonalDirections(_Orthogonal):
    """Pairs of perpendicular vanishing directions, the axes of a building for example."""

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "direction"), Slot("second", "direction"))
