# SPDX-License-Identifier: BSD-3-Clause
r"""Rotations SO(3): exponential, logarithm, adjoint, Jacobians. Batched over leading axes.

With :math:`\theta = \lVert\omega\rVert`,

.. math::
   \mathrm{Exp}(\omega) &= I + A\,\omega^\wedge + B\,\omega^{\wedge 2}, \\
   J_l(\omega) &= I + B\,\omega^\wedge + C\,\omega^{\wedge 2}, \qquad J_r(\omega) = J_l(-\omega), \\
   J_l^{-1}(\omega) &= I - \tfrac12\,\omega^\wedge + c\,\omega^{\wedge 2},
   \qquad c = \frac{1 - \tfrac{\theta}{2}\cot\tfrac{\theta}{2}}{\theta^2} = \frac{C - 2D}{2B},

where A to E are what remains of sine and cosine after the first terms of their series,

.. math::
   A = \frac{\sin\theta}{\theta}, \quad
   B = \frac{1-\cos\theta}{\theta^2}, \quad
   C = \frac{\theta-\sin\theta}{\theta^3}, \quad
   D = \frac{\theta^2/2 - 1 + \cos\theta}{\theta^4}, \quad
   E = \frac{\theta^3/6 - \theta + \sin\theta}{\theta^5} .

Their closed forms lose digits like :math:`\theta^{-k}`. For angles below 2 rad, D and E are therefore summed from
their series, and the rest follows without loss: :math:`C = 1/6 - \theta^2 E`, :math:`B = 1/2 - \theta^2 D`,
:math:`A = 1 - \theta^2 C`.

Two identities that the tests repeat: :math:`J_l(\omega) = \mathrm{Exp}(\omega)\,J_r(\omega)` and
:math:`R\,\mathrm{Exp}(\omega) = \mathrm{Exp}(R\,\omega)\,R`.

References
----------
Point-line-plane notes, section on SO(3): Rodrigues' formula and eq. (1).
Barfoot, *State Estimation for Robotics*, 2017, eqs. (7.14), (7.77), (7.78).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from groma._numba import kernel
from groma._typing import FloatArray
from groma.geometry import quaternion
from groma.geometry.algebra import matrices, vectors

#: Below this squared angle the coefficients are summed from their series (derived from the precision of doubles).
_SERIES = 4.0
#: Derived from the precision of doubles: the first term that is left out is below it.
_TERMS = 11
_SERIES_D = tuple((-1.0) ** k / math.factorial(2 * k + 4) for k in range(_TERMS))
_SERIES_E = tuple((-1.0) ** k / math.factorial(2 * k + 5) for k in range(_TERMS))

# ---------------------------------------------------------------------------------------------------------- Kernels


@kernel
def coefficients_kernel(t2):
    """(A, B, C, D) of the squared angle t2."""
    if t2 < _SERIES:
        d, e = 0.0, 0.0
        for k in range(_TERMS):
            d = d * t2 + _SERIES_D[_TERMS - 1 - k]
            e = e * t2 + _SERIES_E[_TERMS - 1 - k]
        c = 1.0 / 6.0 - t2 * e
        return 1.0 - t2 * c, 0.5 - t2 * d, c, d
    t = math.sqrt(t2)
    half = math.sin(0.5 * t)
    a, b = math.sin(t) / t, 2.0 * half * half / t2
    return a, b, (1.0 - a) / t2, (0.5 - b) / t2


@kernel
def exp_kernel(w0, w1, w2, R):
    """Rotation matrix, row-major in R[0..8], of a rotation vector."""
    a, b, _, _ = coefficients_kernel(w0 * w0 + w1 * w1 + w2 * w2)
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
    _, b, c, _ = coefficients_kernel(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    _quadratic_kernel(w, b, c, J)


@kernel
def left_jacobian_inverse_kernel(w, J):
    """Inverse of the left Jacobian of the rotation vector w (3,) into J (3, 3); singular at an angle of 2 pi."""
    _, b, c, d = coefficients_kernel(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    _quadratic_kernel(w, -0.5, (0.5 * c - d) / b, J)


# ----------------------------------------------------------------------------------------------------------- Public


def coefficients(theta2: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return (A, B, C, D, E) of the module's formulas, each with the shape of the squared angle ``theta2``."""
    theta2 = np.asarray(theta2, dtype=np.float64)
    small = theta2 < _SERIES
    x = np.where(small, theta2, 0.0)
    d, e = np.zeros_like(x), np.zeros_like(x)
    for k in reversed(range(_TERMS)):
        d, e = d * x + _SERIES_D[k], e * x + _SERIES_E[k]
    c = 1 / 6 - x * e
    b = 0.5 - x * d
    a = 1 - x * c
    if not small.all():
        x = np.where(small, 1.0, theta2)
        theta = np.sqrt(x)
        a = np.where(small, a, np.sin(theta) / theta)
        b = np.where(small, b, 2 * np.sin(0.5 * theta) ** 2 / x)
        c = np.where(small, c, (1 - a) / x)
        d = np.where(small, d, (0.5 - b) / x)
        e = np.where(small, e, (1 / 6 - c) / x)
    return a, b, c, d, e


def _vectors(omega: FloatArray) -> FloatArray:
    return vectors(omega, 3, "A rotation vector")


def _matrices(matrix: FloatArray) -> FloatArray:
    return matrices(matrix, 3, 3, "A matrix on 3-vectors")


def _quadratic(omega: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """I + b w^ + c w^2."""
    W = hat(omega)
    return np.eye(3) + b[..., None, None] * W + c[..., None, None] * (W @ W)


def hat(omega: FloatArray) -> FloatArray:
    r"""Skew matrix (..., 3, 3) of vectors (..., 3): :math:`\omega^\wedge b = \omega \times b`."""
    omega = _vectors(omega)
    out = np.zeros((*omega.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -omega[..., 2], omega[..., 1], -omega[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = omega[..., 2], -omega[..., 1], omega[..., 0]
    return out


def vee(matrix: FloatArray) -> FloatArray:
    """Vector (..., 3) of a skew matrix; the inverse of :func:`hat` (a symmetric part is ignored)."""
    matrix = _matrices(matrix)
    upper = [matrix[..., 2, 1], matrix[..., 0, 2], matrix[..., 1, 0]]
    lower = [matrix[..., 1, 2], matrix[..., 2, 0], matrix[..., 0, 1]]
    return 0.5 * (np.stack(upper, axis=-1) - np.stack(lower, axis=-1))


def exp(omega: FloatArray) -> FloatArray:
    r"""Rotation matrix of a rotation vector, :math:`I + A\,\omega^\wedge + B\,\omega^{\wedge 2}`.

    Parameters
    ----------
    omega : (..., 3) float64
        Rotation vectors, radians.

    Returns
    -------
    (..., 3, 3) float64
    """
    omega = _vectors(omega)
    a, b, *_ = coefficients(np.sum(omega * omega, axis=-1))
    return _quadratic(omega, a, b)


def log(rotation: FloatArray) -> FloatArray:
    """Rotation vector of a rotation matrix, through the quaternion; accurate at 0 and at pi.

    Parameters
    ----------
    rotation : (..., 3, 3) float64
        Rotation matrices.

    Returns
    -------
    (..., 3) float64
        Rotation vectors of length at most pi.

    Notes
    -----
    At an angle of pi the axis is defined up to its sign; one of the two is returned.
    """
    return quaternion.log(quaternion.from_matrix(rotation))


def compose(c_from_b: FloatArray, b_from_a: FloatArray) -> FloatArray:
    """Rotation c_from_a = c_from_b b_from_a, (..., 3, 3)."""
    return _matrices(c_from_b) @ _matrices(b_from_a)


def inverse(b_from_a: FloatArray) -> FloatArray:
    """Rotation a_from_b: the transpose."""
    return np.swapaxes(_matrices(b_from_a), -1, -2).copy()


def rotate(b_from_a: FloatArray, vector_in_a: FloatArray) -> FloatArray:
    """Vectors (..., 3) in the frame b; rotations and vectors broadcast."""
    return (_matrices(b_from_a) @ _vectors(vector_in_a)[..., None])[..., 0]


def adjoint(rotation: FloatArray) -> FloatArray:
    """Adjoint of a rotation: the matrix itself, R Exp(w) = Exp(R w) R."""
    return _matrices(rotation).copy()


def left_jacobian(omega: FloatArray) -> FloatArray:
    r"""Left Jacobian (..., 3, 3): :math:`\mathrm{Exp}(\omega + h) \approx \mathrm{Exp}(J_l h)\mathrm{Exp}(\omega)`."""
    omega = _vectors(omega)
    _, b, c, *_ = coefficients(np.sum(omega * omega, axis=-1))
    return _quadratic(omega, b, c)


def left_jacobian_inverse(omega: FloatArray) -> FloatArray:
    """Inverse of :func:`left_jacobian`, (..., 3, 3); singular at an angle of 2 pi."""
    omega = _vectors(omega)
    _, b, c, d, _ = coefficients(np.sum(omega * omega, axis=-1))
    return _quadratic(omega, np.full_like(b, -0.5), (0.5 * c - d) / b)


def right_jacobian(omega: FloatArray) -> FloatArray:
    r"""Right Jacobian (..., 3, 3): :math:`\mathrm{Exp}(\omega + h) \approx \mathrm{Exp}(\omega)\mathrm{Exp}(J_r h)`."""
    return left_jacobian(-_vectors(omega))


def right_jacobian_inverse(omega: FloatArray) -> FloatArray:
    """Inverse of :func:`right_jacobian`, (..., 3, 3); singular at an angle of 2 pi."""
    return left_jacobian_inverse(-_vectors(omega))


def nearest(matrix: npt.ArrayLike) -> FloatArray:
    r"""Return the rotations nearest to matrices, in the Frobenius norm: those R that maximise tr(R^T M).

    .. math:: M = U S V^\top, \qquad R = U\, \mathrm{diag}(1, 1, \det U V^\top)\, V^\top

    Parameters
    ----------
    matrix : (..., 3, 3) float64
        Finite.

    Returns
    -------
    (..., 3, 3) float64
    """
    left, _, right = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    left[..., 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return left @ right
