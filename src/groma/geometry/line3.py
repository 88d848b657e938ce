# SPDX-License-Identifier: BSD-3-Clause
r"""Lines in space as Plücker vectors: construction, matrices, validity, equality, distances.

A line is stored as :math:`L = (m; d)` with the direction d and the moment

.. math:: m = p \times d = p_1 \times p_2, \qquad d = W_1 \tilde p_2 - W_2 \tilde p_1, \qquad m^\top d = 0

for any point p of the line, up to one common factor. ``|m|/|d|`` is the distance to the origin. Homogeneous points and
planes are ``[X, Y, Z, W]`` and ``[n, w]`` with n·X + w = 0, W and w last. The Plücker notes use two opposite signs of
the moment, (4) against (17); here m = p x d throughout. Other orders and signs: :mod:`groma.geometry.line_orders`.

A line at infinity has d = 0: it has a Plücker vector and matrices, but no points, so functions that return points or
distances give NaN or infinity for it, as each of them says. Nothing warns.
"""

from __future__ import annotations

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.geometry.algebra import cross, dot, matrices, norm, not_negative, perpendicular, ratio, stack, unit, vectors
from groma.geometry.so3 import hat

#: A line whose |d| is below this fraction of |m| counts as a line at infinity.
INFINITY_RATIO = 1e-15


def moment(line: FloatArray) -> FloatArray:
    """Moment m of lines (..., 6), a view of shape (..., 3)."""
    return vectors(line, 6, "line")[..., :3]


def direction(line: FloatArray) -> FloatArray:
    """Direction d of lines (..., 6), a view of shape (..., 3), not normalised."""
    return vectors(line, 6, "line")[..., 3:]


# ------------------------------------------------------------------------------------------------------- Construction
def from_points(first: FloatArray, second: FloatArray) -> FloatArray:
    r"""Line through two points, directed from the first to the second.

    .. math:: d = p_2 - p_1, \qquad m = p_1 \times p_2

    The moment is computed as p1 x d, which keeps its digits when the points are close together and far from the origin.

    Parameters
    ----------
    first, second : (..., 3) float64
        Points, scene units.

    Returns
    -------
    (..., 6) float64
        Plücker vectors (m, d); zero where the two points are equal.

    References
    ----------
    Plücker notes, eq. (4), (13). The prose before eq. (8) has the opposite sign of m.
    """
    first, second = vectors(first, 3, "first"), vectors(second, 3, "second")
    along = second - first
    return stack(cross(first, along), along)


def from_homogeneous_points(first: FloatArray, second: FloatArray) -> FloatArray:
    r"""Line through two homogeneous points, either of which may lie at infinity.

    .. math:: d = W_1 \tilde p_2 - W_2 \tilde p_1, \qquad m = \tilde p_1 \times \tilde p_2

    Parameters
    ----------
    first, second : (..., 4) float64
        Homogeneous points [X, Y, Z, W].

    Returns
    -------
    (..., 6) float64
        Plücker vectors; zero where both are the same point.

    References
    ----------
    Plücker notes, eq. (9)-(12), there with W first. In (9) the minors run over the columns i, j.
    """
    first, second = vectors(first, 4, "first"), vectors(second, 4, "second")
    return stack(
        cross(first[..., :3], second[..., :3]), first[..., 3:] * second[..., :3] - second[..., 3:] * first[..., :3]
    )


def from_point_and_direction(point: FloatArray, direction: FloatArray) -> FloatArray:
    """Line through points (..., 3) along directions (..., 3) of any length: (p x d, d).

    References
    ----------
    Plücker notes, eq. (2). Eq. (17) has the opposite sign of m.
    """
    point, direction = vectors(point, 3, "point"), vectors(direction, 3, "direction")
    return stack(cross(point, direction), direction)


def from_planes(first: FloatArray, second: FloatArray) -> FloatArray:
    r"""Line in which two planes meet.

    .. math:: d = n_1 \times n_2, \qquad m = w_1 n_2 - w_2 n_1

    With unit normals, ``|d|`` is the sine of the angle between the planes. Parallel planes give their common line at
    infinity (d = 0); equal planes give zero.

    Parameters
    ----------
    first, second : (..., 4) float64
        Planes [n, w].

    Returns
    -------
    (..., 6) float64
        Plücker vectors.

    References
    ----------
    Plücker notes, eq. (31)-(33).
    """
    first, second = vectors(first, 4, "first"), vectors(second, 4, "second")
    return stack(
        first[..., 3:] * second[..., :3] - second[..., 3:] * first[..., :3], cross(first[..., :3], second[..., :3])
    )


# ----------------------------------------------------------------------------------------------------------- Matrices
def _skew4(upper: FloatArray, column: FloatArray) -> FloatArray:
    out = np.zeros((*upper.shape[:-1], 4, 4))
    out[..., :3, :3] = hat(upper)
    out[..., :3, 3] = column
    out[..., 3, :3] = -column
    return out


def _unskew4(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    matrix = matrices(matrix, 4, 4, "matrix")
    skew = 0.5 * (matrix - np.swapaxes(matrix, -1, -2))
    return skew[..., (2, 0, 1), (1, 2, 0)], skew[..., :3, 3]


def primal_matrix(line: FloatArray) -> FloatArray:
    r"""Primal Plücker matrix: its product with a plane is the point where line and plane meet.

    .. math:: L = \begin{bmatrix} [m]_\times & d \\ -d^\top & 0 \end{bmatrix} = B A^\top - A B^\top

    for homogeneous points A, B with the line ``from_homogeneous_points(A, B)``. Rank 2; its null space holds the planes
    through the line; its determinant is (m·d)².

    References
    ----------
    Plücker notes, eq. (29). The matrix printed in (23) is B Aᵀ - A Bᵀ, not A Bᵀ - B Aᵀ as the text says.
    """
    line = vectors(line, 6, "line")
    return _skew4(line[..., :3], line[..., 3:])


def dual_matrix(line: FloatArray) -> FloatArray:
    r"""Dual Plücker matrix: its product with a homogeneous point is the plane through line and point.

    .. math:: L^* = \begin{bmatrix} [d]_\times & m \\ -m^\top & 0 \end{bmatrix}, \qquad L^* L = -(m^\top d)\, I

    For planes P, Q it is Q Pᵀ - P Qᵀ of ``from_planes(P, Q)``.

    References
    ----------
    Plücker notes, eq. (39), where the upper left block is printed with the wrong sign, and (37).
    """
    line = vectors(line, 6, "line")
    return _skew4(line[..., 3:], line[..., :3])


def from_primal_matrix(matrix: FloatArray) -> FloatArray:
    """Plücker vectors (..., 6) of the skew part of primal matrices (..., 4, 4); inverse of :func:`primal_matrix`."""
    return stack(*_unskew4(matrix))


def from_dual_matrix(matrix: FloatArray) -> FloatArray:
    """Plücker vectors (..., 6) of the skew part of dual matrices (..., 4, 4); inverse of :func:`dual_matrix`."""
    upper, column = _unskew4(matrix)
    return stack(column, upper)


# ----------------------------------------------------------------------------------------------- Validity and equality
def klein_residual(line: FloatArray) -> FloatArray:
    r"""How far 6-vectors are from being lines, :math:`2\, m^\top d / (\|m\|^2 + \|d\|^2)`, in [-1, 1].

    Zero for lines, and for the zero vector. Free of scale, but dependent on the unit of length.

    References
    ----------
    Plücker notes, eq. (5), (14), (15).
    """
    line = vectors(line, 6, "line")
    scaled = unit(line)
    return 2.0 * dot(scaled[..., :3], scaled[..., 3:])


def is_line(line: FloatArray, tolerance: float = 1e-9) -> BoolArray:
    """Whether 6-vectors are finite, not zero, and on the Klein quadric: ``|klein_residual| <= tolerance``."""
    line = vectors(line, 6, "line")
    finite = np.asarray(np.isfinite(line).all(axis=-1))
    usable = np.where(finite[..., None], line, 0.0)
    on_quadric = np.abs(klein_residual(usable)) <= not_negative(tolerance, "tolerance")
    return finite & (usable != 0.0).any(axis=-1) & on_quadric


def closest_line(vector: FloatArray) -> FloatArray:
    r"""Closest valid line to any 6-vector in the Euclidean norm of :math:`R^6`.

    With :math:`a = (m + d)/\sqrt2`, :math:`b = (m - d)/\sqrt2` the quadric is ``|a| = |b|``, and the answer is

    .. math:: s = \tfrac12(\|a\| + \|b\|), \quad m' = s(\hat a + \hat b)/\sqrt2, \quad d' = s(\hat a - \hat b)/\sqrt2

    the same as the singular value recipe of Bartoli and Sturm, in closed form.

    Parameters
    ----------
    vector : (..., 6) float64
        Nearly Plücker vectors (m, d). Use a unit of length of the order of the line's distance: the norm mixes both.

    Returns
    -------
    (..., 6) float64
        Lines with m·d = 0 to rounding, not normalised. The zero vector stays zero.

    Notes
    -----
    Where m = d or m = -d all directions of the vanishing part are equally close; one perpendicular to the other part is
    taken, which gives a finite line.

    References
    ----------
    A. Bartoli, P. Sturm, *Structure-from-motion using lines*, CVIU 100, 2005, section on the Plücker correction.
    Deviation: closed form instead of a singular value decomposition.
    """
    vector = vectors(vector, 6, "vector")
    half = np.sqrt(0.5)
    plus, minus = (vector[..., :3] + vector[..., 3:]) * half, (vector[..., :3] - vector[..., 3:]) * half
    length_plus, length_minus = norm(plus), norm(minus)
    plus_unit, minus_unit = unit(plus), unit(minus)
    plus_unit = np.where((length_plus > 0.0)[..., None], plus_unit, perpendicular(minus)[0])
    minus_unit = np.where((length_minus > 0.0)[..., None], minus_unit, perpendicular(plus)[0])
    scale = (0.5 * half * (length_plus + length_minus))[..., None]
    return stack(scale * (plus_unit + minus_unit), scale * (plus_unit - minus_unit))


def normalize(line: FloatArray) -> FloatArray:
    """Scale lines (..., 6) to a unit direction; lines at infinity to a unit moment. The orientation is kept.

    The zero vector stays zero. Afterwards |m| is the distance to the origin.
    """
    line = vectors(line, 6, "line")
    length_d, length_m = norm(line[..., 3:]), norm(line[..., :3])
    length = np.where(length_d > INFINITY_RATIO * length_m, length_d, length_m)[..., None]
    return ratio(line, length, length > 0.0, 0.0)


def unit_vector(line: FloatArray) -> FloatArray:
    """Scale lines (..., 6) to norm one in R^6, the form in which every line is bounded. Zero stays zero."""
    return unit(vectors(line, 6, "line"))


def same_line(first: FloatArray, second: FloatArray, tolerance: float = 1e-9, oriented: bool = False) -> BoolArray:
    """Whether Plücker vectors are the same line, whatever their scale.

    The unit vectors of R^6 are compared: equal within ``tolerance`` (rounding is about 1e-15). The measure depends
    on the unit of length.

    Parameters
    ----------
    first, second : (..., 6) float64
        Plücker vectors.
    tolerance : float
        Largest distance of the unit vectors.
    oriented : bool
        Whether opposite directions count as different lines.

    Returns
    -------
    (...) bool
        False where a vector is zero or not finite.
    """
    first, second = unit_vector(first), unit_vector(second)
    apart = norm(first - second)
    if not oriented:
        apart = np.minimum(apart, norm(first + second))
    return (apart <= not_negative(tolerance, "tolerance")) & (norm(first) > 0.0) & (norm(second) > 0.0)


# --------------------------------------------------------------------------------------------------- Points, distances
def is_finite(line: FloatArray) -> BoolArray:
    """Whether lines (..., 6) have points: all numbers finite and d not zero against m."""
    line = vectors(line, 6, "line")
    length_d, length_m = norm(line[..., 3:]), norm(line[..., :3])
    return np.isfinite(line).all(axis=-1) & (length_d > INFINITY_RATIO * length_m)


def _or_infinity(distance: FloatArray) -> FloatArray:
    return np.where(np.isnan(distance), np.inf, distance)


def _points_or_nan(line: FloatArray) -> FloatArray:
    """Checked lines; those without points become NaN, which later arithmetic passes on without a warning."""
    line = vectors(line, 6, "line")
    return np.where(is_finite(line)[..., None], line, np.nan)


def distance_to_origin(line: FloatArray) -> FloatArray:
    """Distance ``|m|/|d|`` of lines (..., 6) to the origin; infinity for lines at infinity.

    References
    ----------
    Plücker notes, eq. (19).
    """
    line = _points_or_nan(line)
    return _or_infinity(norm(line[..., :3]) / norm(line[..., 3:]))


def foot_point(line: FloatArray) -> FloatArray:
    r"""Point of lines (..., 6) closest to the origin, :math:`d \times m / \|d\|^2`; NaN for lines at infinity.

    References
    ----------
    Plücker notes, eq. (16)-(18); the sign follows m = p x d, not the printed (17).
    """
    line = _points_or_nan(line)
    along = line[..., 3:]
    return cross(along, line[..., :3]) / dot(along, along)[..., None]


def distance_to_point(line: FloatArray, point: FloatArray) -> FloatArray:
    r"""Distance of points (..., 3) to lines (..., 6), :math:`\|p \times d - m\| / \|d\|`.

    Infinity for lines at infinity.
    """
    line, point = _points_or_nan(line), vectors(point, 3, "point")
    return _or_infinity(norm(cross(point, line[..., 3:]) - line[..., :3]) / norm(line[..., 3:]))


def closest_point(line: FloatArray, point: FloatArray) -> FloatArray:
    r"""Point of lines (..., 6) closest to points (..., 3): :math:`p + d \times (m - p \times d)/\|d\|^2`.

    NaN for lines at infinity.
    """
    line, point = _points_or_nan(line), vectors(point, 3, "point")
    along = line[..., 3:]
    step = cross(along, line[..., :3] - cross(point, along))
    return point + step / dot(along, along)[..., None]


def point_at(line: FloatArray, parameter: FloatArray | float) -> FloatArray:
    r"""Point at a signed distance from the foot point along the direction, :math:`p_\perp + t\, d/\|d\|`.

    Parameters
    ----------
    line : (..., 6) float64
        Lines.
    parameter : (...) float64
        Signed distance t, scene units.

    Returns
    -------
    (..., 3) float64
        Points; NaN for lines at infinity.

    References
    ----------
    Plücker notes, eq. (16), with a unit direction.
    """
    line = _points_or_nan(line)
    return (
        foot_point(line)
        + np.asarray(parameter, dtype=np.float64)[..., None] * line[..., 3:] / norm(line[..., 3:])[..., None]
    )


def parameter_of(line: FloatArray, point: FloatArray) -> FloatArray:
    """Signed distance from the foot point to the foot of points (..., 3) on lines (..., 6): inverse of `point_at`.

    NaN for lines at infinity.
    """
    line, point = _points_or_nan(line), vectors(point, 3, "point")
    return dot(line[..., 3:], point) / norm(line[..., 3:])
