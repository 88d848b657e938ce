# SPDX-License-Identifier: BSD-3-Clause
r"""A pose is known.

.. math:: r = \mathrm{Log}(T\, T_0^{-1}) = (\rho, \omega), \qquad
          \frac{\partial r}{\partial \xi} = J_l(r)^{-1}
          \quad\text{for}\quad T \leftarrow \mathrm{Exp}(\xi)\, T .

T is ``cam_from_world``, :math:`T_0` the prior. The residual is a twist in the camera frame (translation in scene
units, then rotation in radians), and so is its noise. With :math:`\theta = \lVert\omega\rVert`,
:math:`c = (1 - \tfrac\theta2 \cot\tfrac\theta2)/\theta^2` and Q of Barfoot, *State estimation for robotics*, 2017,
eq. (7.86),

.. math:: J_l(\omega)^{-1} = I - \tfrac12 [\omega]_\times + c\,[\omega]_\times^2, \quad
          \rho = J_l(\omega)^{-1} t, \quad
          J_l(\rho, \omega)^{-1} = \begin{bmatrix} J_l(\omega)^{-1} & -J_l(\omega)^{-1} Q\, J_l(\omega)^{-1} \\
          0 & J_l(\omega)^{-1} \end{bmatrix} .

The residual jumps where the rotation error reaches :math:`\pi`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import indices, make_example, random_poses
from groma.factors._record import SMALL_TURN, poses_from_states, put_block, put_residual
from groma.factors.contract import WORLD_FIXED, Example, Factor, Invariance, Measurement, Ref, Slot, register
from groma.geometry.quaternion import log_kernel
from groma.geometry.so3 import left_jacobian_inverse_kernel


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def compose_with_inverse(A, B, out):
    """Write A B^-1 of two poses, each twelve numbers [R | t] row by row."""
    for i in range(3):
        t = A[4 * i + 3]
        for j in range(3):
            out[4 * i + j] = A[4 * i] * B[4 * j] + A[4 * i + 1] * B[4 * j + 1] + A[4 * i + 2] * B[4 * j + 2]
        for j in range(3):
            t -= out[4 * i + j] * B[4 * j + 3]
        out[4 * i + 3] = t


@kernel
def _rotation_quaternion(T, q):
    """Write the quaternion of the pose T, of any length; precise at any angle up to pi."""
    xx, yy, zz = T[0], T[5], T[10]
    trace = xx + yy + zz
    if trace >= xx and trace >= yy and trace >= zz:
        qw, qx, qy, qz = 1.0 + trace, T[9] - T[6], T[2] - T[8], T[4] - T[1]
    elif xx >= yy and xx >= zz:
        qw, qx, qy, qz = T[9] - T[6], 1.0 + xx - yy - zz, T[4] + T[1], T[2] + T[8]
    elif yy >= zz:
        qw, qx, qy, qz = T[2] - T[8], T[4] + T[1], 1.0 + yy - xx - zz, T[9] + T[6]
    else:
        qw, qx, qy, qz = T[4] - T[1], T[2] + T[8], T[9] + T[6], 1.0 + zz - xx - yy
    q[0], q[1], q[2], q[3] = qx, qy, qz, qw


@kernel
def _add_hat_product(scale, a, b, M):
    """Add scale [a]x [b]x = scale (b aᵀ - (a.b) I) to M."""
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    for i in range(3):
        for j in range(3):
            M[i, j] += scale * b[i] * a[j]
        M[i, i] -= scale * dot


@kernel
def _add_hat(scale, a, M):
    """Add scale [a]x to M."""
    M[0, 1] -= scale * a[2]
    M[0, 2] += scale * a[1]
    M[1, 0] += scale * a[2]
    M[1, 2] -= scale * a[0]
    M[2, 0] -= scale * a[1]
    M[2, 1] += scale * a[0]


@kernel
def _q_matrix(rho, w, Q):
    """Write Q(rho, omega), the off-diagonal block of the left Jacobian of SE(3)."""
    t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if t2 < SMALL_TURN:
        k1 = 1.0 / 6.0 - t2 * (1.0 / 120.0 - t2 * (1.0 / 5040.0 - t2 / 362880.0))
        k2 = 1.0 / 24.0 - t2 * (1.0 / 720.0 - t2 * (1.0 / 40320.0 - t2 / 3628800.0))
        k3 = 1.0 / 120.0 - t2 * (1.0 / 2520.0 - t2 * (1.0 / 120960.0 - t2 / 9979200.0))
    else:
        t = math.sqrt(t2)
        sine, cosine = math.sin(t), math.cos(t)
        k1 = (t - sine) / (t2 * t)
        k2 = (0.5 * t2 + cosine - 1.0) / (t2 * t2)
        k3 = 0.5 * (k2 + 3.0 * (t - sine - t * t2 / 6.0) / (t2 * t2 * t))
    # Q = P/2 + k1 (W P + P W + W P W) + k2 (W W P + P W W - 3 W P W) + k3 (W P W W + W W P W), P = [rho]x, W = [w]x,
    # where W P W = -(w.rho) W and W W P + P W W = -t2 P - (w.rho) W.
    dot = w[0] * rho[0] + w[1] * rho[1] + w[2] * rho[2]
    Q[:] = 0.0
    _add_hat(0.5, rho, Q)
    _add_hat_product(k1, w, rho, Q)
    _add_hat_product(k1, rho, w, Q)
    _add_hat(-k2 * t2, rho, Q)
    _add_hat((2.0 * k2 - k1) * dot, w, Q)
    _add_hat_product(-2.0 * k3 * dot, w, w, Q)


@kernel
def pose_log(T, r):
    """Write Log(T) = (rho, omega) of the pose T, twelve numbers, to r (6,)."""
    q, M = np.empty(4), np.empty((3, 3))
    _rotation_quaternion(T, q)
    log_kernel(q, r[3:])
    left_jacobian_inverse_kernel(r[3:], M)
    for i in range(3):
        r[i] = M[i, 0] * T[3] + M[i, 1] * T[7] + M[i, 2] * T[11]


@kernel
def inverse_left_jacobian(r, J):
    """Write the inverse left Jacobian of SE(3) at the twist ``r`` (6,) to ``J`` (6, 6)."""
    M, Q = np.empty((3, 3)), np.empty((3, 3))
    left_jacobian_inverse_kernel(r[3:], M)
    _q_matrix(r[:3], r[3:], Q)
    for i in range(3):
        for j in range(3):
            J[i, j] = J[3 + i, 3 + j] = M[i, j]
            J[3 + i, j] = 0.0
            total = 0.0
            for a in range(3):
                for b in range(3):
                    total += M[i, a] * Q[a, b] * M[b, j]
            J[i, 3 + j] = -total


@loop
def _linearize_all(poses, priors, index, begin, end, column, record):
    E, r, J = np.empty(12), np.empty(6), np.empty((6, 6))
    for i in range(begin, end):
        compose_with_inverse(poses[index[i]], priors[i], E)
        pose_log(E, r)
        if column >= 0:
            inverse_left_jacobian(r, J)
            put_block(J, record[i - begin], column)
        put_residual(r, record[i - begin])
    return 0


# ------------------------------------------------------------------------------------------------------------- Public
@register("pose_prior")
@dataclass(frozen=True, kw_only=True)
class PosePrior(Factor):
    """Known poses; residual (rho, omega), scene units and radians, in the camera frame.

    The parts have different units: pass square root information matrices (N, 6, 6).
    """

    #: The poses, cam_from_world.
    pose: Ref
    #: (N, 7) prior cam_from_world, quaternion xyzw and translation.
    cam_from_world: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (Slot("pose", "pose"),)
    invariance: ClassVar[Invariance] = WORLD_FIXED

    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("cam_from_world", (7,)),)
    rows: ClassVar[int] = 6

    def prepare(self, ambients: tuple[FloatArray, ...]) -> tuple[Any, ...]:  # noqa: D102
        return ambients[0], self._priors

    @cached_property
    def _priors(self) -> FloatArray:
        """The prior poses (N, 12) as matrices."""
        return poses_from_states(self.cam_from_world)

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        poses, priors = inputs
        return _linearize_all(poses, priors, self.pose.index, begin, end, columns[0], record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        # Near the poses, as priors are; the residual jumps where the rotation error reaches pi.
        priors = random_poses(rng, 6, rotation=1.0)
        return make_example(
            cls(pose=Ref("poses", indices(rng, 4)), cam_from_world=priors),
            rng,
            states={"poses": random_poses(rng, 4, rotation=1.0)},
        )
