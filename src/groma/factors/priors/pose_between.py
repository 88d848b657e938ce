# SPDX-License-Identifier: BSD-3-Clause
r"""The motion between two poses is known: odometry, loop closure, a calibrated pair.

With :math:`T_1, T_2` (``cam_from_world``) and the measured :math:`Z` (``first_from_second``)

.. math:: r = \mathrm{Log}(Z^{-1}\, T_1 T_2^{-1}), \quad
          \frac{\partial r}{\partial \xi_1} = J_l(r)^{-1}\, \mathrm{Ad}(Z^{-1}), \quad
          \frac{\partial r}{\partial \xi_2} = -J_r(r)^{-1} = -J_l(-r)^{-1}

for left increments. The residual is a twist (rho, omega) in the frame of the second camera, and so is its noise: the
order and the frame of g2o's ``EDGE_SE3:QUAT``, whose vertices are ``world_from_cam``. To first order its rotation part
is twice the quaternion part that g2o uses.

The residual jumps where the rotation error reaches :math:`\pi`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import make_example, random_poses
from groma.factors._record import poses_from_states, put_residual
from groma.factors.contract import Example, Factor, Measurement, Ref, Slot, register
from groma.factors.priors.pose_prior import compose_with_inverse, inverse_left_jacobian, pose_log


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _predict_error(first, second, Z, T, E):
    """Write E = Z^-1 T_1 T_2^-1."""
    compose_with_inverse(first, second, T)
    t0, t1, t2 = T[3] - Z[3], T[7] - Z[7], T[11] - Z[11]
    for i in range(3):
        for j in range(3):
            E[4 * i + j] = Z[i] * T[j] + Z[4 + i] * T[4 + j] + Z[8 + i] * T[8 + j]
        E[4 * i + 3] = Z[i] * t0 + Z[4 + i] * t1 + Z[8 + i] * t2


@kernel
def _put_times_inverse_adjoint(J, Z, record, column):
    """Write J Ad(Z^-1), Ad(Z^-1) = [[Rᵀ, -Rᵀ [t]x], [0, Rᵀ]]."""
    for i in range(6):
        for part in range(2):
            # one row a of a 3-column part of J times Rᵀ
            a0, a1, a2 = J[i, 3 * part], J[i, 3 * part + 1], J[i, 3 * part + 2]
            b0 = a0 * Z[0] + a1 * Z[1] + a2 * Z[2]
            b1 = a0 * Z[4] + a1 * Z[5] + a2 * Z[6]
            b2 = a0 * Z[8] + a1 * Z[9] + a2 * Z[10]
            if part == 0:
                record[i, column], record[i, column + 1], record[i, column + 2] = b0, b1, b2
                # -bᵀ [t]x = (t x b)ᵀ
                record[i, column + 3] = Z[7] * b2 - Z[11] * b1
                record[i, column + 4] = Z[11] * b0 - Z[3] * b2
                record[i, column + 5] = Z[3] * b1 - Z[7] * b0
            else:
                record[i, column + 3] += b0
                record[i, column + 4] += b1
                record[i, column + 5] += b2


@loop
def _linearize_all(firsts, seconds, Z, first_index, second_index, begin, end, first_column, second_column, record):
    T, E, r, J = np.empty(12), np.empty(12), np.empty(6), np.empty((6, 6))
    for i in range(begin, end):
        row = record[i - begin]
        _predict_error(firsts[first_index[i]], seconds[second_index[i]], Z[i], T, E)
        pose_log(E, r)
        put_residual(r, row)
        if first_column >= 0:
            inverse_left_jacobian(r, J)
            _put_times_inverse_adjoint(J, Z[i], row, first_column)
        if second_column >= 0:
            inverse_left_jacobian(-r, J)
            for a in range(6):
                for b in range(6):
                    row[a, second_column + b] = -J[a, b]
    return 0


# ------------------------------------------------------------------------------------------------------------- Public
@register("pose_between")
@dataclass(frozen=True, kw_only=True)
class PoseBetween(Factor):
    """Known relative poses; residual (rho, omega), scene units and radians, in the frame of the second camera.

    The parts have different units: pass square root information matrices (N, 6, 6).
    """

    #: First poses, cam_from_world.
    first: Ref
    #: Second poses, cam_from_world.
    second: Ref
    #: (N, 7) measured first_from_second, quaternion xyzw and translation.
    first_from_second: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "pose"), Slot("second", "pose"))

    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("first_from_second", (7,)),)
    rows: ClassVar[int] = 6

    def prepare(self, ambients: tuple[FloatArray, ...]) -> tuple[Any, ...]:  # noqa: D102
        return *ambients, poses_from_states(self.first_from_second)

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        (firsts, seconds, Z), (i, j) = inputs, columns
        return _linearize_all(firsts, seconds, Z, self.first.index, self.second.index, begin, end, i, j, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        first = np.arange(6) % 4
        factor = cls(
            first=Ref("poses", first),
            second=Ref("poses", (first + rng.integers(1, 4, 6)) % 4),
            first_from_second=random_poses(rng, 6, rotation=0.7),
        )
        return make_example(factor, rng, states={"poses": random_poses(rng, 4, rotation=0.7)})
