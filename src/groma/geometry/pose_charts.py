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

The third is the update of the free line notes (4.1), (4.2), in the order (:math:`\delta t, \delta\varphi`).
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from groma._numba import loop
from groma._typing import FloatArray
from groma.geometry import quaternion, se3
from groma.geometry._manifold import Manifold
from groma.geometry.quaternion import exp_kernel, multiply_kernel, to_matrix_kernel
from groma.geometry.so3 import left_jacobian_kernel

# ---------------------------------------------------------------------------------------------------------- Kernels


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


@loop
def _normalize(pose):
    scale = 1.0 / np.sqrt(pose[0] * pose[0] + pose[1] * pose[1] + pose[2] * pose[2] + pose[3] * pose[3])
    for k in range(4):
        pose[k] *= scale


# ----------------------------------------------------------------------------------------------------------- Public


class _PoseChart(Manifold):
    kind: ClassVar[str] = "pose"
    state_size, ambient_size, factor_columns, dof = 7, 12, 6, 6

    def ambient(self, state: FloatArray) -> FloatArray:
        out = np.empty((len(state), 12))
        _ambient_all(np.ascontiguousarray(state), out)
        return out

    def from_ambient(self, ambient: FloatArray) -> FloatArray:
        return se3.from_matrix(np.asarray(ambient).reshape(-1, 3, 4))

    def random(self, rng: np.random.Generator, count: int) -> FloatArray:
        q = quaternion.normalize(rng.normal(size=(count, 4)))
        return np.hstack([q, rng.normal(size=(count, 3))])


class PoseLeft(_PoseChart):
    """The default: increments in the camera frame."""

    name: ClassVar[str] = "left"

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:  # noqa: D102
        out = np.empty_like(state)
        _retract_left_all(state, np.ascontiguousarray(delta), out)
        return out

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:  # noqa: D102
        return se3.log(se3.compose(other, se3.inverse(state)))

    def basis(self, state: FloatArray) -> None:  # noqa: D102
        return None


class PoseRight(_PoseChart):
    """Increments in the world frame."""

    name: ClassVar[str] = "right"

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:  # noqa: D102
        out = np.empty_like(state)
        _retract_right_all(state, np.ascontiguousarray(delta), True, out)
        return out

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:  # noqa: D102
        return se3.log(se3.compose(se3.inverse(state), other))

    def basis(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return se3.adjoint(state)


class PoseBody(_PoseChart):
    """Increments in the world frame with a first-order translation, as in the free line notes."""

    name: ClassVar[str] = "body"

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:  # noqa: D102
        out = np.empty_like(state)
        _retract_right_all(state, np.ascontiguousarray(delta), False, out)
        return out

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:  # noqa: D102
        relative = se3.compose(se3.inverse(state), other)
        return np.concatenate([relative[..., 4:], quaternion.log(relative[..., :4])], axis=-1)

    def basis(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return se3.adjoint(state)


#: Charts of poses by name.
POSE_CHARTS: dict[str, Manifold] = {chart.name: chart for chart in (PoseLeft(), PoseRight(), PoseBody())}
