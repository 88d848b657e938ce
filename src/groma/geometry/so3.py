# SPDX-License-Identifier: BSD-3-Clause
r"""Rotations SO(3): exponential, logarithm, Jacobians. Batched over leading axes.

With :math:`\theta = \lVert\omega\rVert`,

.. math::
   \mathrm{Exp}(\omega) &= I + \tfrac{\sin\theta}{\theta}\,\omega^\wedge + \tfrac{1-\cos\theta}{\theta^2}\,\omega^{\wedge 2},\\
   J_l(\omega) &= I + \tfrac{1-\cos\theta}{\theta^2}\,\omega^\wedge + \tfrac{\theta-\sin\theta}{\theta^3}\,\omega^{\wedge 2},
   \qquad J_r(\omega) = J_l(-\omega),\\
   J_l^{-1}(\omega) &= I - \tfrac12\,\omega^\wedge + c\,\omega^{\wedge 2},
   \qquad c = \frac{1 - \tfrac{\theta}{2}\cot\tfrac{\theta}{2}}{\theta^2}.

Point-line-plane notes, section I (Rodrigues' formula and eq. (1)).
"""

from __future__ import annotations

import math

import numpy as np

from groma._numba import kernel
from groma._typing import FloatArray
from groma.errors import ShapeError

#: Below this angle the coefficients are taken from their series.
_SMALL = 1e-4

# ---------------------------------------------------------------------------------------------------------- Kernels


@kernel
def exp_kernel(w0, w1, w2, R):
    """Rotation matrix, row-major in R[0..8], of a rotation vector."""
    t2 = w0 * w0 + w1 * w1 + w2 * w2
    if t2 < 1e-8:
        a, b = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0
    else:
        t = math.sqrt(t2)
        half = math.sin(0.5 * t)
        a, b = math.sin(t) / t, 2.0 * half * half / t2
    R[0] = 1.0 - b * (w1 * w1 + w2 * w2)
    R[1] = b * w0 * w1 - a * w2
    R[2] = b * w0 * w2 + a * w1
    R[3] = b * w0 * w1 + a * w2
    R[4] = 1.0 - b * (w0 * w0 + w2 * w2)
    R[5] = b * w1 * w2 - a * w0
    R[6] = b * w0 * w2 - a * w1
    R[7] = b * w1 * w2 + a * w0
    R[8] = 1.0 - b * (w0 * w0 + w1 * w1)


@kernel
def _quadratic_kernel(w, b, c, J):
    """J = I + b w^ + c w^2."""
    x, y, z = w[0], w[1], w[2]
    J[0, 0] = 1.0 - c * (y * y + z * z)
    J[0, 1] = c * x * y - b * z
    J[0, 2] = c * x * z + b * y
    J[1, 0] = c * x * y + b * z
    J[1, 1] = 1.0 - c * (x * x + z * z)
    J[1, 2] = c * y * z - b * x
    J[2, 0] = c * x * z - b * y
    J[2, 1] = c * y * z + b * x
    J[2, 2] = 1.0 - c * (x * x + y * y)


@kernel
def left_jacobian_kernel(w, J):
    """Left Jacobian of the rotation vector w (3,) into J (3, 3)."""
    t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if t2 < 1e-4:
        b = 0.5 - t2 / 24.0 + t2 * t2 / 720.0
        c = 1.0 / 6.0 - t2 / 120.0 + t2 * t2 / 5040.0
    else:
        t = math.sqrt(t2)
        half = math.sin(0.5 * t)
        b, c = 2.0 * half * half / t2, (t - math.sin(t)) / (t2 * t)
    _quadratic_kernel(w, b, c, J)


@kernel
def left_jacobian_inverse_kernel(w, J):
    """Inverse of the left Jacobian of the rotation vector w (3,) into J (3, 3)."""
    t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if t2 < 1e-4:
        c = 1.0 / 12.0 + t2 / 720.0 + t2 * t2 / 30240.0
    else:
        half = 0.5 * math.sqrt(t2)
        c = (1.0 - half * math.cos(half) / math.sin(half)) / t2
    _quadratic_kernel(w, -0.5, c, J)


# ----------------------------------------------------------------------------------------------------------- Public


def _vectors(omega: FloatArray) -> FloatArray:
    omega = np.asarray(omega, dtype=np.float64)
    if omega.ndim == 0 or omega.shape[-1] != 3:
        raise ShapeError(f"A rotation vector must have shape (..., 3); got {omega.shape}.")
    return omega


def hat(omega: FloatArray) -> FloatArray:
    r"""Skew matrix (..., 3, 3) with :math:`\omega^\wedge b = \omega \times b`."""
    omega = _vectors(omega)
    out = np.zeros((*omega.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -omega[..., 2], omega[..., 1], -omega[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = omega[..., 2], -omega[..., 1], omega[..., 0]
    return out


def vee(matrix: FloatArray) -> FloatArray:
    """Vector (..., 3) of a skew matrix; the inverse of :func:`hat` (the symmetric part is ignored)."""
    matrix = np.asarray(matrix, dtype=np.float64)
    return 0.5 * np.stack(
        [
            matrix[..., 2, 1] - matrix[..., 1, 2],
            matrix[..., 0, 2] - matrix[..., 2, 0],
            matrix[..., 1, 0] - matrix[..., 0, 1],
        ],
        axis=-1,
    )


def _coefficients(theta2: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3."""
    small = theta2 < 1e-4
    t2 = np.where(small, 1.0, theta2)
    t = np.sqrt(t2)
    a = np.where(small, 1 - theta2 / 6 + theta2**2 / 120, np.sin(t) / t)
    b = np.where(small, 0.5 - theta2 / 24 + theta2**2 / 720, 2 * np.sin(t / 2) ** 2 / t2)
    c = np.where(small, 1 / 6 - theta2 / 120 + theta2**2 / 5040, (t - np.sin(t)) / (t2 * t))
    return a, b, c


def _polynomial(omega: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    W = hat(omega)
    return np.eye(3) + b[..., None, None] * W + c[..., None, None] * (W @ W)


def exp(omega: FloatArray) -> FloatArray:
    """Rotation matrix (..., 3, 3) of a rotation vector (..., 3) in radians."""
    omega = _vectors(omega)
    a, b, _ = _coefficients(np.sum(omega * omega, axis=-1))
    return _polynomial(omega, a, b)


def log(rotation: FloatArray) -> FloatArray:
    """Rotation vector (..., 3), of length at most pi, of a rotation matrix; accurate at 0 and at pi."""
    from groma.geometry import quaternion

    return quaternion.log(quaternion.from_matrix(rotation))


def left_jacobian(omega: FloatArray) -> FloatArray:
    """Left Jacobian (..., 3, 3): Exp(w + dw) = Exp(J_l dw) Exp(w) to first order."""
    omega = _vectors(omega)
    _, b, c = _coefficients(np.sum(omega * omega, axis=-1))
    return _polynomial(omega, b, c)


def left_jacobian_inverse(omega: FloatArray) -> FloatArray:
    """Inverse of :func:`left_jacobian`; singular at an angle of 2 pi."""
    omega = _vectors(omega)
    theta2 = np.sum(omega * omega, axis=-1)
    small = theta2 < 1e-4
    half = 0.5 * np.sqrt(np.where(small, 1.0, theta2))
    c = np.where(
        small, 1 / 12 + theta2 / 720 + theta2**2 / 30240, (1 - half * np.cos(half) / np.sin(half)) / (4 * half**2)
    )
    return _polynomial(omega, np.full_like(theta2, -0.5), c)


def right_jacobian(omega: FloatArray) -> FloatArray:
    """Right Jacobian (..., 3, 3): Exp(w + dw) = Exp(w) Exp(J_r dw) to first order."""
    return left_jacobian(-_vectors(omega))


def right_jacobian_inverse(omega: FloatArray) -> FloatArray:
    """Inverse of :func:`right_jacobian`."""
    return left_jacobian_inverse(-_vectors(omega))


def adjoint(rotation: FloatArray) -> FloatArray:
    """Adjoint of a rotation: the matrix itself, R Exp(w) = Exp(R w) R."""
    return np.asarray(rotation, dtype=np.float64)
