# SPDX-License-Identifier: BSD-3-Clause
r"""Rigid motions SE(3), stored as (..., 7): quaternion [x, y, z, w], then translation. Batched over leading axes.

Twists are :math:`\xi = (\rho, \omega)`, translation first, and

.. math:: \mathrm{Exp}(\xi) = \begin{bmatrix} \mathrm{Exp}(\omega) & J_l(\omega)\,\rho \\ 0 & 1 \end{bmatrix}, \qquad
          \mathrm{Ad}_T = \begin{bmatrix} R & t^\wedge R \\ 0 & R \end{bmatrix}, \qquad
          T\,\mathrm{Exp}(\xi) = \mathrm{Exp}(\mathrm{Ad}_T\,\xi)\,T .
"""

from __future__ import annotations

import numpy as np

from groma._numba import kernel
from groma._typing import FloatArray
from groma.errors import ShapeError
from groma.geometry import quaternion, so3
from groma.geometry.so3 import exp_kernel as rotation_exp_kernel
from groma.geometry.so3 import left_jacobian_kernel

# ---------------------------------------------------------------------------------------------------------- Kernels


@kernel
def exp_kernel(xi, T):
    """Row-major 3x4 matrix T (12,) of the twist xi (6,)."""
    R = np.empty(9)
    J = np.empty((3, 3))
    rotation_exp_kernel(xi[3], xi[4], xi[5], R)
    left_jacobian_kernel(xi[3:6], J)
    for i in range(3):
        for j in range(3):
            T[4 * i + j] = R[3 * i + j]
        T[4 * i + 3] = J[i, 0] * xi[0] + J[i, 1] * xi[1] + J[i, 2] * xi[2]


@kernel
def compose_kernel(A, B, out):
    """out = A B for row-major 3x4 matrices (12,); out must not be A or B."""
    for i in range(3):
        for j in range(4):
            out[4 * i + j] = A[4 * i] * B[j] + A[4 * i + 1] * B[4 + j] + A[4 * i + 2] * B[8 + j]
        out[4 * i + 3] += A[4 * i + 3]


@kernel
def adjoint_kernel(T, Ad):
    """Adjoint (6, 6), order (rho, omega), of a row-major 3x4 matrix T (12,)."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for c in range(3):
            Ad[i, c] = T[4 * i + c]
            Ad[i + 3, c + 3] = T[4 * i + c]
            Ad[i + 3, c] = 0.0
            Ad[i, c + 3] = T[4 * j + 3] * T[4 * k + c] - T[4 * k + 3] * T[4 * j + c]


# ----------------------------------------------------------------------------------------------------------- Public


def _poses(pose: FloatArray) -> FloatArray:
    pose = np.asarray(pose, dtype=np.float64)
    if pose.ndim == 0 or pose.shape[-1] != 7:
        raise ShapeError(f"A pose must have shape (..., 7), quaternion x y z w then translation; got {pose.shape}.")
    return pose


def identity(*batch: int) -> FloatArray:
    """Identity poses (*batch, 7)."""
    return np.broadcast_to(np.array([0.0, 0, 0, 1, 0, 0, 0]), (*batch, 7)).copy()


def to_matrix(pose: FloatArray) -> FloatArray:
    """4x4 matrices of poses."""
    pose = _poses(pose)
    T = np.zeros((*pose.shape[:-1], 4, 4))
    T[..., :3, :3] = quaternion.to_matrix(pose[..., :4])
    T[..., :3, 3] = pose[..., 4:]
    T[..., 3, 3] = 1.0
    return T


def from_matrix(matrix: FloatArray) -> FloatArray:
    """Poses (..., 7) of 4x4 or 3x4 matrices."""
    matrix = np.asarray(matrix, dtype=np.float64)
    return np.concatenate([quaternion.from_matrix(matrix[..., :3, :3]), matrix[..., :3, 3]], axis=-1)


def compose(c_from_b: FloatArray, b_from_a: FloatArray) -> FloatArray:
    """Return c_from_a = c_from_b b_from_a."""
    first, second = _poses(c_from_b), _poses(b_from_a)
    q = quaternion.normalize(quaternion.multiply(first[..., :4], second[..., :4]))
    return np.concatenate([q, quaternion.rotate(first[..., :4], second[..., 4:]) + first[..., 4:]], axis=-1)


def inverse(b_from_a: FloatArray) -> FloatArray:
    """Return a_from_b."""
    pose = _poses(b_from_a)
    q = quaternion.conjugate(pose[..., :4])
    return np.concatenate([q, -quaternion.rotate(q, pose[..., 4:])], axis=-1)


def transform_points(b_from_a: FloatArray, points_in_a: FloatArray) -> FloatArray:
    """Points (..., 3) in the frame b; poses and points broadcast."""
    pose = _poses(b_from_a)
    return quaternion.rotate(pose[..., :4], points_in_a) + pose[..., 4:]


def exp(xi: FloatArray) -> FloatArray:
    """Pose (..., 7) of a twist (..., 6) = (rho, omega)."""
    xi = np.asarray(xi, dtype=np.float64)
    t = (so3.left_jacobian(xi[..., 3:]) @ xi[..., :3, None])[..., 0]
    return np.concatenate([quaternion.exp(xi[..., 3:]), t], axis=-1)


def log(pose: FloatArray) -> FloatArray:
    """Twist (..., 6) of a pose; the rotation is at most pi."""
    pose = _poses(pose)
    omega = quaternion.log(pose[..., :4])
    rho = (so3.left_jacobian_inverse(omega) @ pose[..., 4:, None])[..., 0]
    return np.concatenate([rho, omega], axis=-1)


def adjoint(pose: FloatArray) -> FloatArray:
    """Adjoint (..., 6, 6), order (rho, omega)."""
    pose = _poses(pose)
    R = quaternion.to_matrix(pose[..., :4])
    Ad = np.zeros((*pose.shape[:-1], 6, 6))
    Ad[..., :3, :3] = Ad[..., 3:, 3:] = R
    Ad[..., :3, 3:] = so3.hat(pose[..., 4:]) @ R
    return Ad


def _coupling(xi: FloatArray) -> FloatArray:
    """Upper right block Q of the left Jacobian (Barfoot, State Estimation for Robotics, 2017, eq. (7.86b))."""
    rho, phi = so3.hat(xi[..., :3]), so3.hat(xi[..., 3:])
    t2 = np.sum(xi[..., 3:] ** 2, axis=-1)
    small = t2 < 0.01
    u2 = np.where(small, 1.0, t2)
    u = np.sqrt(u2)
    a = np.where(small, 1 / 6 - t2 / 120 + t2**2 / 5040, (u - np.sin(u)) / u**3)
    b = np.where(small, 1 / 24 - t2 / 720 + t2**2 / 40320, (u2 + 2 * np.cos(u) - 2) / (2 * u**4))
    c = np.where(
        small, 1 / 120 - t2 / 2520 + t2**2 / 120960, (2 * u - 3 * np.sin(u) + u * np.cos(u)) / (2 * u**5)
    )
    a, b, c = (x[..., None, None] for x in (a, b, c))
    pr, rp = phi @ rho, rho @ phi
    prp = pr @ phi
    return 0.5 * rho + a * (pr + rp + prp) + b * (phi @ pr + rp @ phi - 3 * prp) + c * (prp @ phi + phi @ prp)


def left_jacobian(xi: FloatArray) -> FloatArray:
    """Left Jacobian (..., 6, 6): Exp(xi + d) = Exp(J_l d) Exp(xi) to first order."""
    xi = np.asarray(xi, dtype=np.float64)
    J = np.zeros((*xi.shape[:-1], 6, 6))
    J[..., :3, :3] = J[..., 3:, 3:] = so3.left_jacobian(xi[..., 3:])
    J[..., :3, 3:] = _coupling(xi)
    return J


def left_jacobian_inverse(xi: FloatArray) -> FloatArray:
    """Inverse of :func:`left_jacobian`."""
    xi = np.asarray(xi, dtype=np.float64)
    inverse_3 = so3.left_jacobian_inverse(xi[..., 3:])
    J = np.zeros((*xi.shape[:-1], 6, 6))
    J[..., :3, :3] = J[..., 3:, 3:] = inverse_3
    J[..., :3, 3:] = -inverse_3 @ _coupling(xi) @ inverse_3
    return J


def right_jacobian(xi: FloatArray) -> FloatArray:
    """Right Jacobian: J_r(xi) = J_l(-xi)."""
    return left_jacobian(-np.asarray(xi, dtype=np.float64))


def right_jacobian_inverse(xi: FloatArray) -> FloatArray:
    """Inverse of :func:`right_jacobian`."""
    return left_jacobian_inverse(-np.asarray(xi, dtype=np.float64))
