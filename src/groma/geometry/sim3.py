# SPDX-License-Identifier: BSD-3-Clause
r"""Similarities Sim(3), :math:`X_b = s\,R\,X_a + t`, stored as (..., 8): quaternion, translation, scale. Batched.

A tangent vector is :math:`\zeta = (\rho, \omega, \sigma)`: translation, rotation vector, logarithm of the scale.

.. math::
   \mathrm{Exp}(\zeta) &= \begin{bmatrix} e^\sigma\,\mathrm{Exp}(\omega) & V\rho \\ 0 & 1 \end{bmatrix}, \qquad
   V = \int_0^1 e^{a\sigma}\,\mathrm{Exp}(a\,\omega)\,\mathrm{d}a, \\
   \mathrm{Ad}_S &= \begin{bmatrix} sR & t^\wedge R & -t \\ 0 & R & 0 \\ 0 & 0 & 1 \end{bmatrix}, \qquad
   S\,\mathrm{Exp}(\zeta) = \mathrm{Exp}(\mathrm{Ad}_S\,\zeta)\,S, \\
   J_l(\zeta) &= \int_0^1 \mathrm{Ad}_{\mathrm{Exp}(a\zeta)}\,\mathrm{d}a
   = \sum_{k \ge 0} \frac{\mathrm{ad}_\zeta^k}{(k+1)!}, \qquad J_r(\zeta) = J_l(-\zeta) .

The closed forms of V and :math:`J_l` divide by :math:`\sigma^2 + \theta^2` and by :math:`\theta^2`, and need a series
for each of three ways to approach zero. Here both are the integrals themselves, by Gauss's rule with 32 nodes: the
integrands are entire functions, and the rule is exact to rounding for :math:`\lvert\sigma\rvert \le 40` and rotations
up to :math:`2\pi`. Within :math:`\theta \le \pi` no digits cancel.

References
----------
Strasdat, *Local Accuracy and Global Consistency for Efficient Visual SLAM*, 2012, section 2.4 (exponential and
adjoint; there the order is (rho, omega, sigma), too).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray
from groma.errors import InputError, ShapeError
from groma.geometry import quaternion, so3
from groma.geometry.algebra import matrices, numbers, vectors

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS


def _similarities(similarity: FloatArray) -> FloatArray:
    if isinstance(similarity, tuple):
        raise ShapeError(
            "A similarity is one array (..., 8), quaternion x y z w, translation, scale; got a tuple. Of scale, "
            "rotation matrix and translation groma.geometry.sim3.from_parts(s, R, t) makes it."
        )
    similarity = numbers(similarity, "similarity")
    if similarity.ndim == 0 or similarity.shape[-1] != 8:
        raise ShapeError(
            "A similarity must have shape (..., 8), quaternion x y z w, translation, scale; "
            f"got {similarity.shape}. Append a scale of 1 to a pose."
        )
    if (similarity[..., 7] <= 0).any():
        raise InputError(f"The scale of a similarity must be positive; got {similarity[..., 7].min()}.")
    return similarity


def _tangents(zeta: FloatArray) -> FloatArray:
    return vectors(zeta, 7, "A tangent of Sim(3)", "rho, omega, sigma")


def identity(*batch: int) -> FloatArray:
    """Identity similarities (*batch, 8)."""
    return np.broadcast_to(np.array([0.0, 0, 0, 1, 0, 0, 0, 1]), (*batch, 8)).copy()


def from_parts(scale: npt.ArrayLike, rotation: npt.ArrayLike, translation: npt.ArrayLike) -> FloatArray:
    """Similarities (..., 8) of scales (...), rotations (..., 3, 3) and translations (..., 3); they broadcast."""
    s, R, t = numbers(scale, "scale"), numbers(rotation, "rotation"), numbers(translation, "translation")
    if R.shape[-2:] != (3, 3) or t.shape[-1:] != (3,):
        raise ShapeError(f"A rotation must have shape (..., 3, 3), a translation (..., 3); got {R.shape}, {t.shape}.")
    leading = np.broadcast_shapes(s.shape, R.shape[:-2], t.shape[:-1])
    q = quaternion.from_matrix(R)
    parts = [(q, 4), (t, 3), (s[..., None], 1)]
    return _similarities(np.concatenate([np.broadcast_to(part, (*leading, size)) for part, size in parts], axis=-1))


def to_parts(similarity: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Scales (...), rotation matrices (..., 3, 3) and translations (..., 3); the quaternion may be of any length."""
    similarity = _similarities(similarity)
    rotation = quaternion.to_matrix(quaternion.normalize(similarity[..., :4]))
    return similarity[..., 7], rotation, similarity[..., 4:7]


def to_matrix(similarity: FloatArray) -> FloatArray:
    """4x4 matrices [[sR, t], [0, 1]], (..., 4, 4)."""
    similarity = _similarities(similarity)
    out = np.zeros((*similarity.shape[:-1], 4, 4))
    out[..., :3, :3] = similarity[..., 7, None, None] * quaternion.to_matrix(similarity[..., :4])
    out[..., :3, 3] = similarity[..., 4:7]
    out[..., 3, 3] = 1.0
    return out


def from_matrix(matrix: FloatArray) -> FloatArray:
    """Similarities (..., 8) of 4x4 or 3x4 matrices [sR | t]; the scale is the cube root of the determinant."""
    matrix = numbers(matrix, "matrix")
    if matrix.ndim < 2 or matrix.shape[-2] not in (3, 4) or matrix.shape[-1] != 4:
        raise ShapeError(f"A similarity matrix must have shape (..., 3, 4) or (..., 4, 4); got {matrix.shape}.")
    determinant = np.linalg.det(matrix[..., :3, :3])
    if not (determinant > 0).all():
        raise InputError(
            "The determinant of a similarity must be positive; got "
            f"{np.min(determinant)}. A mirrored frame has to be flipped before."
        )
    scale = np.cbrt(determinant)[..., None]
    q = quaternion.from_matrix(matrix[..., :3, :3] / scale[..., None])
    return np.concatenate([q, matrix[..., :3, 3], scale], axis=-1)


def compose(c_from_b: FloatArray, b_from_a: FloatArray) -> FloatArray:
    """Similarity c_from_a (..., 8) = c_from_b b_from_a; both broadcast."""
    first, second = _similarities(c_from_b), _similarities(b_from_a)
    q = quaternion.normalize(quaternion.multiply(first[..., :4], second[..., :4]))
    t = apply(first, second[..., 4:7])
    return np.concatenate([q, t, first[..., 7:] * second[..., 7:]], axis=-1)


def inverse(b_from_a: FloatArray) -> FloatArray:
    """Similarity a_from_b (..., 8)."""
    similarity = _similarities(b_from_a)
    q, scale = quaternion.conjugate(similarity[..., :4]), 1 / similarity[..., 7:]
    return np.concatenate([q, -scale * quaternion.rotate(q, similarity[..., 4:7]), scale], axis=-1)


def apply(b_from_a: FloatArray, points_in_a: FloatArray) -> FloatArray:
    """Points (..., 3) in the frame b; similarities and points broadcast."""
    similarity = _similarities(b_from_a)
    return similarity[..., 7:] * quaternion.rotate(similarity[..., :4], points_in_a) + similarity[..., 4:7]


def hat(zeta: FloatArray) -> FloatArray:
    r"""Matrix (..., 4, 4) of a tangent vector, [[w^ + sigma I, rho], [0, 0]]."""
    zeta = _tangents(zeta)
    out = np.zeros((*zeta.shape[:-1], 4, 4))
    out[..., :3, :3] = so3.hat(zeta[..., 3:6]) + zeta[..., 6, None, None] * np.eye(3)
    out[..., :3, 3] = zeta[..., :3]
    return out


def vee(matrix: FloatArray) -> FloatArray:
    """Tangent vector (..., 7) of a matrix (..., 4, 4); the inverse of :func:`hat`."""
    matrix = matrices(matrix, 4, 4, "The matrix of a tangent")
    block = matrix[..., :3, :3]
    sigma = np.trace(block, axis1=-2, axis2=-1)[..., None] / 3
    return np.concatenate([matrix[..., :3, 3], so3.vee(block), sigma], axis=-1)


def _coupling(omega: FloatArray, sigma: FloatArray) -> FloatArray:
    r"""V (..., 3, 3): :math:`\sum_i w_i e^{a_i \sigma}\,(I + a_i A W + a_i^2 B W^2)`, A and B at a_i theta."""
    theta2 = np.sum(omega * omega, axis=-1)[..., None]
    a, b, *_ = so3.coefficients(theta2 * _NODES**2)
    growth = _WEIGHTS * np.exp(sigma[..., None] * _NODES)
    x, y, z = (np.sum(growth * f, axis=-1)[..., None, None] for f in (1.0, _NODES * a, _NODES**2 * b))
    W = so3.hat(omega)
    return x * np.eye(3) + y * W + z * (W @ W)


def exp(zeta: FloatArray) -> FloatArray:
    """Similarity of a tangent vector.

    Parameters
    ----------
    zeta : (..., 7) float64
        Tangent vectors (rho, omega, sigma): scene units, radians, logarithm of the scale.

    Returns
    -------
    (..., 8) float64
        Quaternion [x, y, z, w], translation, scale.
    """
    zeta = _tangents(zeta)
    omega, sigma = zeta[..., 3:6], zeta[..., 6]
    t = (_coupling(omega, sigma) @ zeta[..., :3, None])[..., 0]
    return np.concatenate([quaternion.exp(omega), t, np.exp(zeta[..., 6:])], axis=-1)


def log(similarity: FloatArray) -> FloatArray:
    """Tangent vector of a similarity.

    Parameters
    ----------
    similarity : (..., 8) float64
        Unit quaternion [x, y, z, w], translation, positive scale.

    Returns
    -------
    (..., 7) float64
        Tangent vectors (rho, omega, sigma) with a rotation of at most pi; at pi the sign of the axis is arbitrary.
    """
    similarity = _similarities(similarity)
    omega, sigma = quaternion.log(similarity[..., :4]), np.log(similarity[..., 7])
    rho = np.linalg.solve(_coupling(omega, sigma), similarity[..., 4:7, None])[..., 0].astype(np.float64, copy=False)
    return np.concatenate([rho, omega, sigma[..., None]], axis=-1)


def adjoint(similarity: FloatArray) -> FloatArray:
    """Adjoint (..., 7, 7), order (rho, omega, sigma): S Exp(zeta) = Exp(Ad zeta) S."""
    similarity = _similarities(similarity)
    R, t = quaternion.to_matrix(similarity[..., :4]), similarity[..., 4:7]
    Ad = np.zeros((*similarity.shape[:-1], 7, 7))
    Ad[..., :3, :3] = similarity[..., 7, None, None] * R
    Ad[..., :3, 3:6] = so3.hat(t) @ R
    Ad[..., :3, 6] = -t
    Ad[..., 3:6, 3:6] = R
    Ad[..., 6, 6] = 1.0
    return Ad


def left_jacobian(zeta: FloatArray) -> FloatArray:
    r"""Left Jacobian (..., 7, 7): :math:`\mathrm{Exp}(\zeta + h) \approx \mathrm{Exp}(J_l h)\,\mathrm{Exp}(\zeta)`."""
    zeta = _tangents(zeta)
    along = adjoint(exp(zeta[..., None, :] * _NODES[:, None]))
    return np.einsum("i,...ijk->...jk", _WEIGHTS, along)


def left_jacobian_inverse(zeta: FloatArray) -> FloatArray:
    """Inverse of :func:`left_jacobian`, (..., 7, 7); singular at an angle of 2 pi."""
    return np.linalg.inv(left_jacobian(zeta)).astype(np.float64, copy=False)


def right_jacobian(zeta: FloatArray) -> FloatArray:
    r"""Right Jacobian (..., 7, 7): :math:`\mathrm{Exp}(\zeta + h) \approx \mathrm{Exp}(\zeta)\,\mathrm{Exp}(J_r h)`."""
    return left_jacobian(-_tangents(zeta))


def right_jacobian_inverse(zeta: FloatArray) -> FloatArray:
    """Inverse of :func:`right_jacobian`, (..., 7, 7); singular at an angle of 2 pi."""
    return left_jacobian_inverse(-_tangents(zeta))
