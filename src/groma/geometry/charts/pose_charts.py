# SPDX-License-Identifier: BSD-3-Clause
r"""Charts of poses: on which side, and how, an increment moves ``cam_from_world``.

========  =====================================================================  ========================
name      update                                                                 basis (left twist / delta)
========  =====================================================================  ========================
left      :math:`T \leftarrow \mathrm{Exp}(\xi)\,T`                              identity
right     :math:`T \leftarrow T\,\mathrm{Exp}(\xi)`                              :math:`\mathrm{Ad}_T`
body      :math:`C \leftarrow C\,\mathrm{Exp}(\delta\varphi)`,                   :math:`\mathrm{Ad}_T`
          :math:`t \leftarrow t + C\,\delta t`
========  =====================================================================  ========================

C is the rotation matrix of T and t its translation. The state is (7,), quaternion [x, y, z, w] and translation; factors
read the row-major 3x4 matrix [R | t] and differentiate with respect to the left twist (:math:`\rho, \omega`). All three
charts reach every pose whose rotation differs by less than pi, and are regular everywhere.

With ``left``, the lever arm in a Jacobian is the position of a point in the camera, so its condition does not depend
on where the world has its origin. Quaternions are renormalised in every step.

References
----------
Free line notes (4.1), (4.2) for ``body``, here in the order (:math:`\delta t, \delta\varphi`).
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import FloatArray
from groma.geometry import quaternion, se3
from groma.geometry.algebra import as_rows
from groma.geometry.charts.chart import as_steps, reject
from groma.geometry.charts.registry import charts_of, register_chart
from groma.geometry.manifold import Manifold
from groma.geometry.quaternion import exp_kernel, multiply_kernel, to_matrix_kernel
from groma.geometry.so3 import left_jacobian_kernel

# ---------------------------------------------------------------------------------------------------------- Kernels


@kernel
def _normalize(pose):
    """Scale the quaternion in pose[0..3] to unit length."""
    scale = 1.0 / math.sqrt(pose[0] * pose[0] + pose[1] * pose[1] + pose[2] * pose[2] + pose[3] * pose[3])
    for k in range(4):
        pose[k] *= scale


@loop
def _ambient_all(state, out):
    R = np.empty(9)
    for i in range(state.shape[0]):
        to_matrix_kernel(state[i], R)
        for a in range(3):
            for b in range(3):
                out[i, 4 * a + b] = R[3 * a + b]
            out[i, 4 * a + 3] = state[i, 4 + a]


@loop
def _retract_left_all(state, delta, out):
    """T <- Exp(xi) T."""
    q, R, J = np.empty(4), np.empty(9), np.empty((3, 3))
    for i in range(state.shape[0]):
        omega = delta[i, 3:6]
        exp_kernel(omega, q)
        multiply_kernel(q, state[i, :4], out[i, :4])
        to_matrix_kernel(q, R)
        left_jacobian_kernel(omega, J)
        for a in range(3):
            moved = R[3 * a] * state[i, 4] + R[3 * a + 1] * state[i, 5] + R[3 * a + 2] * state[i, 6]
            out[i, 4 + a] = moved + J[a, 0] * delta[i, 0] + J[a, 1] * delta[i, 1] + J[a, 2] * delta[i, 2]
        _normalize(out[i])


@loop
def _retract_right_all(state, delta, full, out):
    """T <- T Exp(xi); without ``full`` the translation moves by rho itself."""
    q, R, J = np.empty(4), np.empty(9), np.empty((3, 3))
    for i in range(state.shape[0]):
        omega = delta[i, 3:6]
        exp_kernel(omega, q)
        multiply_kernel(state[i, :4], q, out[i, :4])
        to_matrix_kernel(state[i], R)
        rho = delta[i, 0:3]
        x, y, z = rho[0], rho[1], rho[2]
        if full:
            left_jacobian_kernel(omega, J)
            x = J[0, 0] * rho[0] + J[0, 1] * rho[1] + J[0, 2] * rho[2]
            y = J[1, 0] * rho[0] + J[1, 1] * rho[1] + J[1, 2] * rho[2]
            z = J[2, 0] * rho[0] + J[2, 1] * rho[1] + J[2, 2] * rho[2]
        for a in range(3):
            out[i, 4 + a] = state[i, 4 + a] + R[3 * a] * x + R[3 * a + 1] * y + R[3 * a + 2] * z
        _normalize(out[i])


# ----------------------------------------------------------------------------------------------------------- Public


class _PoseChart(Manifold):
    kind: ClassVar[str] = "pose"
    state_size, ambient_size, factor_columns, dof = 7, 12, 6, 6

    def ambient(self, state: FloatArray) -> FloatArray:
        """Row-major 3x4 matrices [R | t], (N, 12)."""
        state = as_rows(state, (7,), "state")
        out = np.empty((len(state), 12))
        _ambient_all(state, out)
        return out

    def from_ambient(self, ambient: FloatArray) -> FloatArray:
        """Poses (N, 7) of row-major 3x4 matrices (N, 12).

        Raises
        ------
        InputError
            If a 3x3 part is not a rotation matrix to within 1e-6.
        """
        ambient = as_rows(ambient, (12,), "ambient")
        matrix = ambient.reshape(-1, 3, 4)
        finite = np.isfinite(ambient).min(axis=1)
        R = np.where(finite[:, None, None], matrix[:, :, :3], 0.0)
        off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        good = finite & (off < 1e-6) & (np.linalg.det(R) > 0)
        reject(
            ~good,
            ambient,
            "A pose [R | t] must be finite and hold a rotation matrix, orthonormal with determinant 1",
            "Orthonormalise it, or check the order of its numbers: row by row, r11 r12 r13 t1 r21 ...",
        )
        return se3.from_matrix(matrix)

    def random(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Rotations uniform on the sphere of quaternions, normal translations."""
        return np.hstack([quaternion.normalize(rng.normal(size=(count, 4))), rng.normal(size=(count, 3))])


@register_chart
class PoseLeft(_PoseChart):
    """Increments in the camera frame, ``"left"``: T <- Exp(xi) T. The default."""

    name: ClassVar[str] = "left"

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Move poses (N, 7) by left twists (N, 6)."""
        state, delta = as_steps(state, delta, 7, 6)
        out = np.empty_like(state)
        _retract_left_all(state, delta, out)
        return out

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Left twists (N, 6) from ``state`` to ``other``, with rotations of at most pi."""
        return se3.log(se3.compose(other, se3.inverse(state)))

    def basis(self, state: FloatArray) -> None:
        """The identity."""
        return None


@register_chart
class PoseRight(_PoseChart):
    """Increments in the world frame, ``"right"``: T <- T Exp(xi)."""

    name: ClassVar[str] = "right"
    #: Whether the translation moves along the twist, or by its first part as it is; to first order both are the same.
    _full: ClassVar[bool] = True

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Move poses (N, 7) by right increments (N, 6)."""
        state, delta = as_steps(state, delta, 7, 6)
        out = np.empty_like(state)
        _retract_right_all(state, delta, self._full, out)
        return out

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Right twists (N, 6) from ``state`` to ``other``, with rotations of at most pi."""
        return se3.log(se3.compose(se3.inverse(state), other))

    def basis(self, state: FloatArray) -> FloatArray:
        """Adjoint of the pose, (N, 6, 6)."""
        return se3.adjoint(state)


@register_chart
class PoseBody(PoseRight):
    """Increments in the world frame with a first-order translation, ``"body"``, as in the free line notes."""

    name: ClassVar[str] = "body"
    _full = False

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Increments (dt, dphi) (N, 6) from ``state`` to ``other``, with rotations of at most pi."""
        relative = se3.compose(se3.inverse(state), other)
        return np.concatenate([relative[..., 4:], quaternion.log(relative[..., :4])], axis=-1)


#: Charts of poses by name, the default first, registered ones too.
POSE_CHARTS = charts_of("pose")

__all__ = ["POSE_CHARTS", "PoseBody", "PoseLeft", "PoseRight"]
