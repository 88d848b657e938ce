# SPDX-License-Identifier: BSD-3-Clause
r"""The distance between two points is known: a scale bar, a tape, a total station.

.. math:: r = \lVert X_2 - X_1 \rVert - \tilde d, \qquad
          \frac{\partial r}{\partial X_2} = u^\top = -\frac{\partial r}{\partial X_1}, \qquad
          u = \frac{X_2 - X_1}{\lVert X_2 - X_1 \rVert} .

Where the points coincide u is not defined, and the factor is degenerate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._numba import loop
from groma._typing import FloatArray
from groma.factors._examples import make_example
from groma.factors._record import set_rows
from groma.factors.contract import Example, Factor, Ref, Slot, register


# ------------------------------------------------------------------------------------------------------------ Kernels
@loop
def _linearize_all(firsts, seconds, first_index, second_index, distances, begin, end, first_column, second_column, out):
    degenerate, last = 0, out.shape[2] - 1
    for i in range(begin, end):
        row = out[i - begin, 0]
        X, Y = firsts[first_index[i]], seconds[second_index[i]]
        x, y, z = Y[0] - X[0], Y[1] - X[1], Y[2] - X[2]
        length = math.sqrt(x * x + y * y + z * z)
        usable = 0.0 < length < math.inf
        over = 1.0 / length if usable else 0.0
        row[last] = length - distances[i] if usable else 0.0
        degenerate += 0 if usable else 1
        for column, sign in ((first_column, -over), (second_column, over)):
            if column >= 0:
                row[column], row[column + 1], row[column + 2] = sign * x, sign * y, sign * z
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("point_distance")
@dataclass(frozen=True, kw_only=True)
class PointDistance(Factor):
    """Known distances between points; residual in scene units."""

    first: Ref
    second: Ref
    #: (N,) measured distances, scene units.
    distances: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "point"), Slot("second", "point"))
    rows: ClassVar[int] = 1

    def __post_init__(self) -> None:
        set_rows(self, "distances")

    def prepare(self, ambients: tuple[FloatArray, ...]) -> tuple[Any, ...]:  # noqa: D102
        return tuple(np.ascontiguousarray(ambient) for ambient in ambients)

    def linearize(  # noqa: D102
        self, inputs: tuple[Any, ...], begin: int, end: int, columns: tuple[int, ...], record: FloatArray
    ) -> int:
        return _linearize_all(
            *inputs, self.first.index, self.second.index, self.distances, begin, end, *columns, record
        )

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        first = np.arange(6) % 4
        factor = cls(
            first=Ref("points", first),
            second=Ref("points", (first + rng.integers(1, 4, 6)) % 4),
            distances=rng.uniform(1.0, 3.0, 6),
        )
        return make_example(factor, rng)


__all__ = ["PointDistance"]
