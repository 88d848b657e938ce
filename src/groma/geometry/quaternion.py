# SPDX-License-Identifier: BSD-3-Clause
r"""Unit quaternions, Hamilton product, stored as [x, y, z, w]. Batched over leading axes.

.. math:: \exp(\omega) = \begin{bmatrix} \sin(\theta/2)\,\hat\omega \\ \cos(\theta/2) \end{bmatrix}, \qquad
          \log(q) = 2\,\mathrm{atan2}(\lVert q_v \rVert, q_w)\,\frac{q_v}{\lVert q_v \rVert}\quad (q_w \ge 0).

Both are accurate for all angles: the logarithm never sees an arc cosine, and at small angles it takes the series
:math:`2\,q_v/q_w\,(1 - \lVert q_v\rVert^2/(3 q_w^2))`.

References
----------
Point-line-plane notes, section on unit quaternions. Deviations: there the exponential multiplies the unit axis by
:math:`\tfrac12\mathrm{sinc}(\theta/2)`, which must multiply the rotation vector itself, and the logarithm holds for
:math:`q_w \ge 0` only; here q and -q give the same.
"""

from __future__ import annotations

import math

import numpy as np

from groma._numba import kernel
from groma._typing import FloatArray
from groma.errors import InputError
from groma.geometry.algebra import cross, matrices, vectors

# ---------------------------------------------------------------------------------------------------------- Kernels


@kernel
def to_matrix_kernel(q, R):
    """Rotation matrix, row-major in R[0..8], of a unit quaternion q (4,)."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    R[0] = 1.0 - 2.0 * (y * y + z * z)
    R[1] = 2.0 * (x * y - z * w)
    R[2] = 2.0 * (x * z + y * w)
    R[3] = 2.0 * (x * y + z * w)
    R[4] = 1.0 - 2.0 * (x * x + z * z)
    R[5] = 2.0 * (y * z - x * w)
    R[6] = 2.0 * (x * z - y * w)
    R[7] = 2.0 * (y * z + x * w)
    R[8] = 1.0 - 2.0 * (x * x + y * y)


@kernel
def multiply_kernel(a, b, out):
    """Hamilton product a b into out (4,); out must not be a or b."""
    out[0] = a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1]
    out[1] = a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0]
    out[2] = a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3]
    out[3] = a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2]


@kernel
def exp_kernel(w, q):
    """Unit quaternion of the rotation vector w (3,)."""
    t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if t2 < 1e-8:
        s, c = 0.5 - t2 / 48.0, 1.0 - t2 / 8.0
    else:
        t = math.sqrt(t2)
        s, c = math.sin(0.5 * t) / t, math.cos(0.5 * t)
    q[0] = s * w[0]
    q[1] = s * w[1]
    q[2] = s * w[2]
    q[3] = c


@kernel
def log_kernel(q, w):
    """Rotation vector, of length at most pi, of q (4,), of any length; q and -q give the same; zeros for zeros."""
    sign = 1.0 if q[3] >= 0.0 else -1.0
    x, y, z, c = sign * q[0], sign * q[1], sign * q[2], sign * q[3]
    s2 = x * x + y * y + z * z
    if s2 < 1e-12:
        scale = 0.0 if c == 0.0 else 2.0 / c * (1.0 - s2 / (3.0 * c * c))
    else:
        s = math.sqrt(s2)
        scale = 2.0 * math.atan2(s, c) / s
    w[0] = scale * x
    w[1] = scale * y
    w[2] = scale * z


# ----------------------------------------------------------------------------------------------------------- Public


def _quaternions(q: FloatArray) -> FloatArray:
    return vectors(q, 4, "A quaternion", "order x, y, z, w")


def multiply(first: FloatArray, second: FloatArray) -> FloatArray:
    """Hamilton product (..., 4): R(first second) = R(first) R(second)."""
    a, b = _quaternions(first), _quaternions(second)
    vector = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + cross(a[..., :3], b[..., :3])
    scalar = a[..., 3:] * b[..., 3:] - np.sum(a[..., :3] * b[..., :3], axis=-1, keepdims=True)
    return np.concatenate([vector, scalar], axis=-1)


def conjugate(q: FloatArray) -> FloatArray:
    """Conjugate (..., 4); the inverse of a unit quaternion."""
    return _quaternions(q) * np.array([-1.0, -1.0, -1.0, 1.0])


def normalize(q: FloatArray) -> FloatArray:
    """Quaternions (..., 4) scaled to unit length.

    Raises
    ------
    InputError
        If one of them is zero.
    """
    q = _quaternions(q)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    if (length == 0).any():
        raise InputError(
            "A quaternion x, y, z, w must not be zero; got [0, 0, 0, 0]. No rotation is [0, 0, 0, 1]; "
            "drop the pose if it was never estimated."
        )
    return q / length


def rotate(q: FloatArray, vector: FloatArray) -> FloatArray:
    """Vectors (..., 3) turned by unit quaternions (..., 4); both broadcast."""
    q, v = _quaternions(q), vectors(vector, 3, "A vector")
    t = 2.0 * cross(q[..., :3], v)
    return v + q[..., 3:] * t + cross(q[..., :3], t)


def to_matrix(q: FloatArray) -> FloatArray:
    """Rotation matrix (..., 3, 3) of unit quaternions."""
    q = _quaternions(q)
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    R = np.empty((*x.shape, 3, 3))
    R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    R[..., 1, 0], R[..., 1, 1], R[..., 1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return R


def from_matrix(rotation: FloatArray) -> FloatArray:
    """Unit quaternion of a rotation matrix, through the largest of its four components.

    Parameters
    ----------
    rotation : (..., 3, 3) float64
        Rotation matrices; they are not checked for orthonormality.

    Returns
    -------
    (..., 4) float64
        Quaternions [x, y, z, w] with w >= 0.

    References
    ----------
    Shepperd, *Quaternion from Rotation Matrix*, Journal of Guidance and Control, 1978.
    """
    R = matrices(rotation, 3, 3, "A rotation")
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    squares = np.stack([1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz], axis=-1)
    s01, s02, s12 = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    k0, k1, k2 = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    rows = np.stack(
        [
            np.stack([squares[..., 0], s01, s02, k0], axis=-1),
            np.stack([s01, squares[..., 1], s12, k1], axis=-1),
            np.stack([s02, s12, squares[..., 2], k2], axis=-1),
            np.stack([k0, k1, k2, squares[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(squares, axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def exp(omega: FloatArray) -> FloatArray:
    """Unit quaternion (..., 4) of a rotation vector (..., 3) in radians; w >= 0 for angles up to pi."""
    omega = vectors(omega, 3, "A vector")
    theta = np.linalg.norm(omega, axis=-1, keepdims=True)
    scale = 0.5 * np.sinc(theta / (2 * np.pi))
    return np.concatenate([scale * omega, np.cos(theta / 2)], axis=-1)


def log(q: FloatArray) -> FloatArray:
    """Rotation vector of a quaternion: the shorter of the two ways round.

    Parameters
    ----------
    q : (..., 4) float64
        Quaternions [x, y, z, w], of unit length up to rounding.

    Returns
    -------
    (..., 3) float64
        Rotation vectors, radians, of length at most pi; q and -q give the same, except at pi itself.
    """
    q = _quaternions(q)
    q = np.where(q[..., 3:] < 0, -q, q)
    s = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    c = q[..., 3:]
    small = s < 1e-6
    safe_s, safe_c = np.where(small, 1.0, s), np.where(small & (c > 0), c, 1.0)
    scale = np.where(small, 2 / safe_c * (1 - (s / safe_c) ** 2 / 3), 2 * np.arctan2(s, c) / safe_s)
    return scale * q[..., :3]


def from_wxyz(q: FloatArray) -> FloatArray:
    """Change the order from [w, x, y, z]."""
    return np.roll(_quaternions(q), -1, axis=-1)


def to_wxyz(q: FloatArray) -> FloatArray:
    """Change the order to [w, x, y, z]."""
    return np.roll(_quaternions(q), 1, axis=-1)
