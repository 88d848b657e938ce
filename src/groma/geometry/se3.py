# SPDX-License-Identifier: BSD-3-Clause
r"""Rigid motions SE(3), stored as (..., 7): quaternion [x, y, z, w], then translation. Batched over leading axes.

Twists are :math:`\xi = (\rho, \omega)`, translation first, and

.. math:: \mathrm{Exp}(\xi) = \begin{bmatrix} \mathrm{Exp}(\omega) & J_l(\omega)\,\rho \\ 0 & 1 \end{bmatrix}, \qquad
          \mathrm{Ad}_T = \begin{bmatrix} R & t^\wedge R \\ 0 & R \end{bmatrix}, \qquad
          T\,\mathrm{Exp}(\xi) = \mathrm{Exp}(\mathrm{Ad}_T\,\xi)\,T,

.. math:: J_l(\xi) = \begin{bmatrix} J_l(\omega) & Q(\xi) \\ 0 & J_l(\omega) \end{bmatrix}, \qquad
          J_r(\xi) = J_l(-\xi), \qquad J_l(\xi) = \mathrm{Ad}_{\mathrm{Exp}(\xi)}\,J_r(\xi) .

A pose named ``b_from_a`` takes a point in the frame a to the frame b: :math:`X_b = R\,X_a + t`.

Changing conventions: a Jacobian with respect to a left increment becomes one for a right increment of the same pose
by :math:`J_\mathrm{right} = J_\mathrm{left}\,\mathrm{Ad}_T`; a right increment of the *inverse* pose is minus a left
increment of the pose; the order (omega, rho) exchanges the first three columns with the last three.

References
----------
Barfoot, *State Estimation for Robotics*, 2017, eqs. (7.85), (7.86), (7.95). Point-line-plane notes, section on SE(3);
deviation: the twist is (rho, omega) here.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from groma._numba import kernel
from groma._typing import FloatArray
from groma.errors import ShapeError
from groma.geometry import quaternion, so3
from groma.geometry.algebra import matrices, numbers, unit, vectors
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
    """Write A B to out, row-major 3x4 matrices (12,); out must not be A or B."""
    for i in range(3):
        for j in range(4):
            out[4 * i + j] = A[4 * i] * B[j] + A[4 * i + 1] * B[4 + j] + A[4 * i + 2] * B[8 + j]
        out[4 * i + 3] += A[4 * i + 3]


# ----------------------------------------------------------------------------------------------------------- Public


def _poses(pose: FloatArray) -> FloatArray:
    return vectors(pose, 7, "A pose", "quaternion x y z w then translation")


def _twists(xi: FloatArray) -> FloatArray:
    return vectors(xi, 6, "A twist", "translation then rotation")


def identity(*batch: int) -> FloatArray:
    """Identity poses (*batch, 7)."""
    return np.broadcast_to(np.array([0.0, 0, 0, 1, 0, 0, 0]), (*batch, 7)).copy()


def to_matrix(pose: FloatArray) -> FloatArray:
    """4x4 matrices (..., 4, 4) of poses (..., 7)."""
    pose = _poses(pose)
    T = np.zeros((*pose.shape[:-1], 4, 4))
    T[..., :3, :3] = quaternion.to_matrix(pose[..., :4])
    T[..., :3, 3] = pose[..., 4:]
    T[..., 3, 3] = 1.0
    return T


def from_matrix(matrix: FloatArray) -> FloatArray:
    """Poses (..., 7) of 4x4 or 3x4 matrices [R | t]; R is not checked for orthonormality."""
    matrix = numbers(matrix, "matrix")
    if matrix.ndim < 2 or matrix.shape[-2] not in (3, 4) or matrix.shape[-1] != 4:
        raise ShapeError(f"A pose matrix must have shape (..., 3, 4) or (..., 4, 4); got {matrix.shape}.")
    return np.concatenate([quaternion.from_matrix(matrix[..., :3, :3]), matrix[..., :3, 3]], axis=-1)


def compose(c_from_b: FloatArray, b_from_a: FloatArray) -> FloatArray:
    """Pose c_from_a (..., 7) = c_from_b b_from_a; both broadcast, the quaternion is renormalised."""
    first, second = _poses(c_from_b), _poses(b_from_a)
    q = quaternion.normalize(quaternion.multiply(first[..., :4], second[..., :4]))
    t = quaternion.rotate(first[..., :4], second[..., 4:]) + first[..., 4:]
    return np.concatenate([q, t], axis=-1)


def inverse(b_from_a: FloatArray) -> FloatArray:
    """Pose a_from_b (..., 7)."""
    pose = _poses(b_from_a)
    q = quaternion.conjugate(pose[..., :4])
    return np.concatenate([q, -quaternion.rotate(q, pose[..., 4:])], axis=-1)


def transform_points(b_from_a: FloatArray, points_in_a: FloatArray) -> FloatArray:
    """Points (..., 3) in the frame b; poses and points broadcast."""
    pose = _poses(b_from_a)
    return quaternion.rotate(pose[..., :4], points_in_a) + pose[..., 4:]


def looking_at(centers: npt.ArrayLike, targets: npt.ArrayLike, up: npt.ArrayLike = (0.0, 0.0, 1.0)) -> FloatArray:
    """Poses ``cam_from_world`` of cameras that look at targets and are held upright.

    Parameters
    ----------
    centers, targets : (..., 3) float64
        Centres of the cameras, and what the middle of each image shows; either may be one for all.
    up : (..., 3) float64
        What is up in the world; not the direction of view, for which the pose is NaN.

    Returns
    -------
    (..., 7) float64
    """
    centers, targets = np.broadcast_arrays(vectors(centers, 3, "centers"), vectors(targets, 3, "targets"))
    ahead = unit(targets - centers)
    right = unit(np.cross(ahead, vectors(up, 3, "up")))
    rotation = np.stack([right, np.cross(ahead, right), ahead], axis=-2)
    q, t = quaternion.from_matrix(rotation), -(rotation @ centers[..., None])[..., 0]
    return np.concatenate([q, t], axis=-1, dtype=np.float64)


def hat(xi: FloatArray) -> FloatArray:
    r"""Matrix (..., 4, 4) of a twist, :math:`\begin{bmatrix} \omega^\wedge & \rho \\ 0 & 0 \end{bmatrix}`."""
    xi = _twists(xi)
    out = np.zeros((*xi.shape[:-1], 4, 4))
    out[..., :3, :3] = so3.hat(xi[..., 3:])
    out[..., :3, 3] = xi[..., :3]
    return out


def vee(matrix: FloatArray) -> FloatArray:
    """Twist (..., 6) of a matrix (..., 4, 4); the inverse of :func:`hat`."""
    matrix = matrices(matrix, 4, 4, "The matrix of a twist")
    return np.concatenate([matrix[..., :3, 3], so3.vee(matrix[..., :3, :3])], axis=-1)


def exp(xi: FloatArray) -> FloatArray:
    """Pose of a twist.

    Parameters
    ----------
    xi : (..., 6) float64
        Twists (rho, omega): translation part in scene units, rotation vector in radians.

    Returns
    -------
    (..., 7) float64
    """
    xi = _twists(xi)
    t = (so3.left_jacobian(xi[..., 3:]) @ xi[..., :3, None])[..., 0]
    return np.concatenate([quaternion.exp(xi[..., 3:]), t], axis=-1)


def log(pose: FloatArray) -> FloatArray:
    """Twist of a pose.

    Parameters
    ----------
    pose : (..., 7) float64
        Poses: unit quaternion [x, y, z, w], translation.

    Returns
    -------
    (..., 6) float64
        Twists (rho, omega) with a rotation of at most pi; at pi the sign of the axis is arbitrary.

    Raises
    ------
    ShapeError
        If the last axis is not 7.
    """
    pose = _poses(pose)
    omega = quaternion.log(pose[..., :4])
    rho = (so3.left_jacobian_inverse(omega) @ pose[..., 4:, None])[..., 0]
    return np.concatenate([rho, omega], axis=-1)


def adjoint(pose: FloatArray) -> FloatArray:
    """Adjoint (..., 6, 6), order (rho, omega): T Exp(xi) = Exp(Ad xi) T."""
    pose = _poses(pose)
    R = quaternion.to_matrix(pose[..., :4])
    Ad = np.zeros((*pose.shape[:-1], 6, 6))
    Ad[..., :3, :3] = Ad[..., 3:, 3:] = R
    Ad[..., :3, 3:] = so3.hat(pose[..., 4:]) @ R
    return Ad


def _coupling(xi: FloatArray) -> FloatArray:
    r"""Upper right block Q of the left Jacobian, in the coefficients of :mod:`groma.geometry.so3`.

    .. math:: Q = \tfrac12 P + C\,(WP + PW + WPW) + D\,(WWP + PWW - 3WPW) + \tfrac12 (D - 3E)\,(WPWW + WWPW),
              \qquad P = \rho^\wedge,\; W = \omega^\wedge

    Barfoot, eq. (7.86b).
    """
    P, W = so3.hat(xi[..., :3]), so3.hat(xi[..., 3:])
    _, _, c, d, e = (x[..., None, None] for x in so3.coefficients(np.sum(xi[..., 3:] ** 2, axis=-1)))
    WP, PW = W @ P, P @ W
    WPW = WP @ W
    return 0.5 * P + c * (WP + PW + WPW) + d * (W @ WP + PW @ W - 3 * WPW) + 0.5 * (d - 3 * e) * (WPW @ W + W @ WPW)


def left_jacobian(xi: FloatArray) -> FloatArray:
    r"""Left Jacobian (..., 6, 6): :math:`\mathrm{Exp}(\xi + h) \approx \mathrm{Exp}(J_l h)\,\mathrm{Exp}(\xi)`."""
    xi = _twists(xi)
    J = np.zeros((*xi.shape[:-1], 6, 6))
    J[..., :3, :3] = J[..., 3:, 3:] = so3.left_jacobian(xi[..., 3:])
    J[..., :3, 3:] = _coupling(xi)
    return J


def left_jacobian_inverse(xi: FloatArray) -> FloatArray:
    """Inverse of :func:`left_jacobian`, (..., 6, 6); singular at an angle of 2 pi."""
    xi = _twists(xi)
    inverse_3 = so3.left_jacobian_inverse(xi[..., 3:])
    J = np.zeros((*xi.shape[:-1], 6, 6))
    J[..., :3, :3] = J[..., 3:, 3:] = inverse_3
    J[..., :3, 3:] = -inverse_3 @ _coupling(xi) @ inverse_3
    return J


def right_jacobian(xi: FloatArray) -> FloatArray:
    r"""Right Jacobian (..., 6, 6): :math:`\mathrm{Exp}(\xi + h) \approx \mathrm{Exp}(\xi)\,\mathrm{Exp}(J_r h)`."""
    return left_jacobian(-_twists(xi))


def right_jacobian_inverse(xi: FloatArray) -> FloatArray:
    """Inverse of :func:`right_jacobian`, (..., 6, 6); singular at an angle of 2 pi."""
    return left_jacobian_inverse(-_twists(xi))
