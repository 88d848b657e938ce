# SPDX-License-Identifier: BSD-3-Clause
r"""The similarity between two cameras with units of length of their own is known: a map whose scale drifts, and a loop.

With :math:`S_1, S_2` (``cam_from_world``), the measured :math:`Z` (``first_from_second``) and the error
:math:`E = Z^{-1} S_1 S_2^{-1} = (s_e, R_e, t_e)`

.. math:: r = (t_e,\; \varphi,\; \log s_e), \qquad \varphi = \mathrm{Log}(R_e) .

A left increment of the first camera arrives at E as :math:`\zeta = \mathrm{Ad}(Z^{-1})\,\xi_1`, so

.. math::
   \delta t_e = \rho_\zeta + \omega_\zeta \times t_e + \sigma_\zeta\, t_e, \quad
   \delta\varphi = J_l(\varphi)^{-1} \omega_\zeta, \quad \delta\log s_e = \sigma_\zeta, \\
   \rho_\zeta = \tfrac1{s_z} R_z^\top (\rho_1 + \omega_1 \times t_z + \sigma_1 t_z), \quad
   \omega_\zeta = R_z^\top \omega_1, \quad \sigma_\zeta = \sigma_1,

and one of the second from the right, :math:`E \leftarrow E\,\mathrm{Exp}(-\xi_2)`:

.. math:: \delta t_e = -s_e R_e\, \rho_2, \quad \delta\varphi = -J_r(\varphi)^{-1} \omega_2, \quad
          \delta\log s_e = -\sigma_2 .

The residual is in the frame and in the unit of the second camera. To first order it is the logarithm of E, the error of
Strasdat's graph; the translation itself is compared, which needs no coupling of translation, rotation and scale, and
has a Jacobian that is exact in a few lines. The residual jumps where the rotation error reaches :math:`\pi`.

Reference: H. Strasdat, J. M. M. Montiel, A. J. Davison, *Scale drift-aware large scale monocular SLAM*, RSS 2010,
eq. (10); deviation: above.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import make_example, random_poses
from groma.factors._record import put_residual
from groma.factors.contract import ANY_SIMILARITY, Example, Factor, Invariance, Measurement, Ref, Slot, register
from groma.geometry import sim3
from groma.geometry.quaternion import log_kernel, multiply_kernel, to_matrix_kernel
from groma.geometry.so3 import left_jacobian_inverse_kernel


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _divide(A, B, R, out):
    """Write A B^-1 of two similarities, eight numbers each, and its rotation matrix."""
    q = np.array([-B[0], -B[1], -B[2], B[3]])
    multiply_kernel(A[:4], q, out[:4])
    to_matrix_kernel(out, R)
    out[7] = A[7] / B[7]
    for i in range(3):
        out[4 + i] = A[4 + i] - out[7] * (R[3 * i] * B[4] + R[3 * i + 1] * B[5] + R[3 * i + 2] * B[6])


@kernel
def _predict_error(first, second, inverse, F, E, RZ, RE):
    """Write E = Z^-1 S_1 S_2^-1 and the matrices of Z^-1 and E; ``inverse`` is Z^-1."""
    _divide(first, second, RE, F)
    multiply_kernel(inverse[:4], F[:4], E[:4])
    to_matrix_kernel(inverse, RZ)
    to_matrix_kernel(E, RE)
    E[7] = inverse[7] * F[7]
    for i in range(3):
        turned = RZ[3 * i] * F[4] + RZ[3 * i + 1] * F[5] + RZ[3 * i + 2] * F[6]
        E[4 + i] = inverse[7] * turned + inverse[4 + i]


@kernel
def _put_first(E, inverse, RZ, J, record, column):
    """Write the derivative by the first camera: what its increment is after Ad(Z^-1), then how E feels it."""
    for k in range(3):
        # Columns of R_z^T, turned into the frame of the second camera.
        x, y, z = RZ[k], RZ[3 + k], RZ[6 + k]
        record[0, column + k], record[1, column + k], record[2, column + k] = (
            inverse[7] * x, inverse[7] * y, inverse[7] * z,
        )  # fmt: skip
        # omega x (t_e - t'), with t' the translation of Z^-1.
        a, b, c = E[4] - inverse[4], E[5] - inverse[5], E[6] - inverse[6]
        record[0, column + 3 + k] = y * c - z * b
        record[1, column + 3 + k] = z * a - x * c
        record[2, column + 3 + k] = x * b - y * a
        record[k, column + 6] = E[4 + k] - inverse[4 + k]
        for i in range(3):
            record[3 + i, column + k] = 0.0
            record[3 + i, column + 3 + k] = J[i, 0] * x + J[i, 1] * y + J[i, 2] * z
        record[3 + k, column + 6] = record[6, column + k] = record[6, column + 3 + k] = 0.0
    record[6, column + 6] = 1.0


@kernel
def _put_second(E, RE, J, record, column):
    """Write the derivative by the second camera; ``J`` is the inverse left Jacobian at -phi."""
    for i in range(3):
        for k in range(3):
            record[i, column + k] = -E[7] * RE[3 * i + k]
            record[3 + i, column + 3 + k] = -J[i, k]
            record[i, column + 3 + k] = record[3 + i, column + k] = 0.0
        record[i, column + 6] = record[3 + i, column + 6] = 0.0
        record[6, column + i] = record[6, column + 3 + i] = 0.0
    record[6, column + 6] = -1.0


@loop
def _linearize_all(firsts, seconds, inverses, first_index, second_index, begin, end, columns, record):
    F, E, r = np.empty(8), np.empty(8), np.empty(7)
    RZ, RE, J = np.empty(9), np.empty(9), np.empty((3, 3))
    degenerate = 0
    for i in range(begin, end):
        row, inverse = record[i - begin], inverses[i]
        if not (firsts[first_index[i], 7] > 0.0 and seconds[second_index[i], 7] > 0.0):
            row[:] = 0.0
            degenerate += 1
            continue
        _predict_error(firsts[first_index[i]], seconds[second_index[i]], inverse, F, E, RZ, RE)
        r[0], r[1], r[2] = E[4], E[5], E[6]
        log_kernel(E[:4], r[3:6])
        r[6] = math.log(E[7])
        put_residual(r, row)
        if columns[0] >= 0:
            left_jacobian_inverse_kernel(r[3:6], J)
            _put_first(E, inverse, RZ, J, row, columns[0])
        if columns[1] >= 0:
            left_jacobian_inverse_kernel(-r[3:6], J)
            _put_second(E, RE, J, row, columns[1])
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("similarity_between")
@dataclass(frozen=True, kw_only=True)
class SimilarityBetween(Factor):
    """Known relative similarities; residual (translation, rotation, log scale), in unit and frame of the second camera.

    The parts have different units: pass square root information matrices (N, 7, 7).
    """

    #: First similarities, cam_from_world.
    first: Ref
    #: Second similarities, cam_from_world.
    second: Ref
    #: (N, 8) measured first_from_second: quaternion xyzw, translation, scale.
    first_from_second: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (Slot("first", "similarity"), Slot("second", "similarity"))
    rows: ClassVar[int] = 7
    invariance: ClassVar[Invariance | None] = ANY_SIMILARITY

    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("first_from_second", (8,)),)

    def prepare(self, ambients: tuple[FloatArray, ...]) -> tuple[Any, ...]:  # noqa: D102
        return *ambients, sim3.inverse(self.first_from_second)

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        return _linearize_all(*inputs, self.first.index, self.second.index, begin, end, columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        def some(count: int) -> FloatArray:
            return np.hstack([random_poses(rng, count, rotation=0.7), rng.uniform(0.5, 2.0, (count, 1))])

        first = np.arange(6) % 4
        second = (first + rng.integers(1, 4, 6)) % 4
        factor = cls(first=Ref("cameras", first), second=Ref("cameras", second), first_from_second=some(6))
        return make_example(factor, rng, states={"cameras": some(4)})
