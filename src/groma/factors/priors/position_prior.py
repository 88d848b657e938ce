# SPDX-License-Identifier: BSD-3-Clause
r"""A camera centre is known: GNSS, a surveyed station.

.. math:: r = c - \tilde c, \qquad c = -R^\top t, \qquad
          \frac{\partial r}{\partial (\rho, \omega)} = \left[ -R^\top,\; 0 \right]

for the pose ``cam_from_world`` = (R, t) and its left increment. The residual is in the world frame, in scene units.
On a rig the centre is that of the camera, not of the body (:mod:`groma.factors._rig`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._numba import loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import indices, make_example
from groma.factors._rig import EXTRINSICS, POSE, CameraFactor
from groma.factors.contract import WORLD_FIXED, Example, Invariance, Measurement, Ref, Slot, register


# ------------------------------------------------------------------------------------------------------------ Kernels
@loop
def _linearize_all(poses, index, positions, begin, end, column, record):
    last = record.shape[2] - 1
    for i in range(begin, end):
        T, row = poses[index[i]], record[i - begin]
        for j in range(3):
            row[j, last] = -(T[j] * T[3] + T[4 + j] * T[7] + T[8 + j] * T[11]) - positions[i, j]
            if column >= 0:
                for k in range(3):
                    row[j, column + k] = -T[4 * k + j]
                    row[j, column + 3 + k] = 0.0
    return 0


# ------------------------------------------------------------------------------------------------------------- Public
@register("position_prior")
@dataclass(frozen=True, kw_only=True)
class PositionPrior(CameraFactor):
    """Known camera centres; residual in scene units, world frame."""

    #: (N, 3) measured camera centres in the world.
    cam_center_in_world: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (POSE, EXTRINSICS)
    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("cam_center_in_world", (3,)),)
    invariance: ClassVar[Invariance] = WORLD_FIXED
    rows: ClassVar[int] = 3

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        return _linearize_all(*inputs, self.cam_center_in_world, begin, end, *columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        return make_example(cls(pose=Ref("poses", indices(rng, 4)), cam_center_in_world=rng.normal(size=(6, 3))), rng)
