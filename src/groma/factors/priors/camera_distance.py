# SPDX-License-Identifier: BSD-3-Clause
r"""The distance between two camera centres is known: the baseline of a stereo head, a slide of known length.

With a centre fixed in its body at a (zero for a camera alone) and the pose ``body_from_world`` = (R, t)

.. math:: r = \lVert c_2 - c_1 \rVert - \tilde d, \qquad c = R^\top (a - t), \qquad
          \frac{\partial c}{\partial (\rho, \omega)} = \left[ -R^\top,\; R^\top [a]_\times \right]

for left increments, and the derivative by each centre is the unit vector between the two. Where the centres coincide
the factor is degenerate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import FloatArray
from groma.factors._examples import make_example, random_poses
from groma.factors._record import set_rows
from groma.factors.contract import Example, Factor, Ref, Slot, register


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _center(T, a, c):
    """Write c = R^T (a - t)."""
    x, y, z = a[0] - T[3], a[1] - T[7], a[2] - T[11]
    for j in range(3):
        c[j] = T[j] * x + T[4 + j] * y + T[8 + j] * z


@kernel
def _put_pose(T, a, u, row, column):
    """Write the block [-R u, a x (-R u)] of a derivative u by the centre; uᵀ Rᵀ [a]x = (R u x a)ᵀ."""
    g0 = T[0] * u[0] + T[1] * u[1] + T[2] * u[2]
    g1 = T[4] * u[0] + T[5] * u[1] + T[6] * u[2]
    g2 = T[8] * u[0] + T[9] * u[1] + T[10] * u[2]
    row[column], row[column + 1], row[column + 2] = -g0, -g1, -g2
    row[column + 3] = g1 * a[2] - g2 * a[1]
    row[column + 4] = g2 * a[0] - g0 * a[2]
    row[column + 5] = g0 * a[1] - g1 * a[0]


@loop
def _linearize_all(
    firsts, seconds, first_index, second_index, first_arm, second_arm, distances, begin, end, columns, record
):
    c, d, u = np.empty(3), np.empty(3), np.empty(3)
    degenerate, last = 0, record.shape[2] - 1
    for i in range(begin, end):
        row = record[i - begin, 0]
        T, S = firsts[first_index[i]], seconds[second_index[i]]
        _center(T, first_arm[i], c)
        _center(S, second_arm[i], d)
        for j in range(3):
            u[j] = d[j] - c[j]
        length = math.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
        usable = 0.0 < length < math.inf
        over = 1.0 / length if usable else 0.0
        row[last] = length - distances[i] if usable else 0.0
        degenerate += 0 if usable else 1
        for j in range(3):
            u[j] = u[j] * over if usable else 0.0
        if columns[1] >= 0:
            _put_pose(S, second_arm[i], u, row, columns[1])
        if columns[0] >= 0:
            for j in range(3):
                u[j] = -u[j]
            _put_pose(T, first_arm[i], u, row, columns[0])
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("camera_distance")
@dataclass(frozen=True, kw_only=True)
class CameraDistance(Factor):
    """Known distances between camera centres; residual in scene units."""

    #: Poses, cam_from_world or body_from_world.
    first: Ref
    second: Ref
    #: (N,) measured distances, scene units.
    distances: FloatArray
    #: (N, 3) places of the two centres in their bodies; zero for cameras alone.
    first_arm: FloatArray
    second_arm: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "pose"), Slot("second", "pose"))
    rows: ClassVar[int] = 1

    def __post_init__(self) -> None:
        set_rows(self, "distances")
        set_rows(self, "first_arm", 3)
        set_rows(self, "second_arm", 3)

    def linearize(  # noqa: D102
        self, inputs: tuple[Any, ...], begin: int, end: int, columns: tuple[int, ...], record: FloatArray
    ) -> int:
        arms = self.first_arm, self.second_arm
        return _linearize_all(
            *inputs, self.first.index, self.second.index, *arms, self.distances, begin, end, columns, record
        )

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        first = np.arange(6) % 4
        factor = cls(
            first=Ref("poses", first),
            second=Ref("poses", (first + rng.integers(1, 4, 6)) % 4),
            distances=rng.uniform(1.0, 3.0, 6),
            first_arm=rng.normal(size=(6, 3)),
            second_arm=rng.normal(size=(6, 3)),
        )
        return make_example(factor, rng, states={"poses": random_poses(rng, 4, rotation=0.7)})


__all__ = ["CameraDistance"]
