# SPDX-License-Identifier: BSD-3-Clause
r"""Other orders and signs of Plücker coordinates, and the line types of other libraries.

groma stores (m, d) with m = p x d, homogeneous coordinates with W last. :func:`to_order` and :func:`from_order` convert
to and from the orders below; each is a signed permutation of the six numbers, so the way back is exact. The index
orders are minors of the two points A, B of the line or, where the name says *dual*, of two planes P, Q:

.. math:: l_{ij} = A_i B_j - A_j B_i, \qquad l^*_{ij} = P_i Q_j - P_j Q_i .

===================================  ==========================================================================
name                                 numbers
===================================  ==========================================================================
``moment_direction``                 (m, d): groma; Plücker notes (64)
``direction_moment``                 (d, m): Plücker notes (6)
``opposite_moment_direction``        (-m, d), moment d x p: Plücker notes (17), (39), (45) as printed
``direction_opposite_moment``        (d, -m): Plücker notes (8), m = p2 x p1
``w_first_cyclic``                   l01 l02 l03 l23 l31 l12, index 0 is W: (d, m); first of Plücker notes (26)
``w_first_lexicographic``            l01 l02 l03 l12 l13 l23, index 0 is W: second of (26)
``w_last_cyclic``                    l01 l02 l03 l23 l31 l12, index 3 is W
``w_last_lexicographic``             l01 l02 l03 l12 l13 l23, index 3 is W
``w_first_dual_cyclic``              l*01 l*02 l*03 l*23 l*31 l*12, index 0 is W: (m, d), as (33) says
``w_last_dual_cyclic``               the same with index 3 for W
===================================  ==========================================================================

Plücker notes (28) lists the W-last minors in the order l30 l31 l32 l12 l20 l01, which is ``direction_moment``; the
tuple printed in (38) is the negative of the mapped one, the same line.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.errors import InputError
from groma.geometry import line3, quaternion
from groma.geometry.algebra import dot, matrices, norm, perpendicular, stack, unit, vectors

#: Columns of the other format of quaternions.
_WXYZ = (3, 0, 1, 2)
#: Per order: which of (m0 m1 m2 d0 d1 d2) stands at each place, counted from 1, negative for the opposite sign.
_ORDERS: dict[str, tuple[int, ...]] = {
    "moment_direction": (1, 2, 3, 4, 5, 6),
    "direction_moment": (4, 5, 6, 1, 2, 3),
    "opposite_moment_direction": (-1, -2, -3, 4, 5, 6),
    "direction_opposite_moment": (4, 5, 6, -1, -2, -3),
    "w_first_cyclic": (4, 5, 6, 1, 2, 3),
    "w_first_lexicographic": (4, 5, 6, 3, -2, 1),
    "w_last_cyclic": (3, -2, -4, -6, 5, 1),
    "w_last_lexicographic": (3, -2, -4, 1, -5, -6),
    "w_first_dual_cyclic": (1, 2, 3, 4, 5, 6),
    "w_last_dual_cyclic": (6, -5, -1, -3, 2, 4),
}
#: Names of the orders.
ORDERS = tuple(_ORDERS)


def _signed_permutation(order: str) -> tuple[IntArray, FloatArray]:
    if order not in _ORDERS:
        raise InputError(f"order must be one of {', '.join(ORDERS)}; got {order!r}. Pass one of these names.")
    places = np.array(_ORDERS[order])
    return np.abs(places) - 1, np.sign(places).astype(np.float64)


def to_order(line: FloatArray, order: str) -> FloatArray:
    """Lines (..., 6) in the named order (see the module's table).

    Raises
    ------
    InputError
        If the name is not one of :data:`ORDERS`.
    """
    index, sign = _signed_permutation(order)
    return vectors(line, 6, "line")[..., index] * sign


def from_order(numbers: FloatArray, order: str) -> FloatArray:
    """Lines (m, d), shape (..., 6), from numbers in the named order; inverse of :func:`to_order`."""
    index, sign = _signed_permutation(order)
    numbers = vectors(numbers, 6, "numbers")
    out = np.empty_like(numbers)
    out[..., index] = numbers * sign
    return out


# ------------------------------------------------------------------------------------- Homogeneous coordinate, W first
def to_w_first(homogeneous: FloatArray) -> FloatArray:
    """Points or planes [X, Y, Z, W] as [W, X, Y, Z], shape (..., 4).

    References
    ----------
    Plücker notes, eq. (7) and (28).
    """
    return vectors(homogeneous, 4, "homogeneous")[..., _WXYZ]


def from_w_first(homogeneous: FloatArray) -> FloatArray:
    """Points or planes [W, X, Y, Z] as [X, Y, Z, W], shape (..., 4)."""
    return vectors(homogeneous, 4, "homogeneous")[..., (1, 2, 3, 0)]


def matrix_to_w_first(matrix: FloatArray) -> FloatArray:
    r"""Primal or dual Plücker matrices (..., 4, 4) with rows and columns in the order W, X, Y, Z.

    The primal matrix then is the one printed in Plücker notes (23); the dual one is minus that of (35) without the
    stars.
    """
    return matrices(matrix, 4, 4, "matrix")[..., _WXYZ, :][..., :, _WXYZ]


def matrix_from_w_first(matrix: FloatArray) -> FloatArray:
    """Plücker matrices (..., 4, 4) back from W, X, Y, Z to X, Y, Z, W."""
    back = (1, 2, 3, 0)
    return matrices(matrix, 4, 4, "matrix")[..., back, :][..., :, back]


# ------------------------------------------------------------------------------------------------------ Other libraries
def to_limap(line: FloatArray) -> tuple[FloatArray, FloatArray]:
    """LIMAP's ``InfiniteLine3d``: unit direction d (..., 3) and moment m = p x d (..., 3).

    Its constructor takes (d, m) with ``use_normal=False`` and checks that d has length one. NaN for lines at infinity,
    which that type cannot hold. The segment type ``Line3d`` holds two end points: use :func:`line3.from_points`.

    References
    ----------
    LIMAP, limap/base/infinite_line.cc, constructors of InfiniteLine3d.
    """
    line = np.where(line3.is_finite(line)[..., None], line3.normalize(line), np.nan)
    return line[..., 3:], line[..., :3]


def from_limap(direction: FloatArray, moment: FloatArray) -> FloatArray:
    """Lines (..., 6) from the d and m of LIMAP's ``InfiniteLine3d``."""
    return stack(vectors(moment, 3, "moment"), vectors(direction, 3, "direction"))


def to_limap_minimal(line: FloatArray) -> tuple[FloatArray, FloatArray]:
    r"""LIMAP's ``MinimalInfiniteLine3d``: quaternion uvec [x, y, z, w] (..., 4) and wvec (..., 2).

    .. math:: R(\mathrm{uvec}) = [\, d,\; \hat m,\; d \times \hat m \,], \qquad
              \mathrm{wvec} = (1, \|m\|) / \sqrt{1 + \|m\|^2}, \qquad \|d\| = 1

    A line through the origin has no m; any direction across d is stored, as LIMAP does. NaN for lines at infinity.

    References
    ----------
    LIMAP 2.0, limap/geometry/minimal_inf_line3d.cc. LIMAP 1 stored the same quaternion as [w, x, y, z]: reorder with
    :func:`groma.geometry.quaternion.to_wxyz`. Direction first, unlike Plücker notes (70), where m comes first.
    """
    direction, moment = to_limap(line)
    usable = line3.is_finite(line)[..., None]
    along = np.where(usable, direction, (1.0, 0.0, 0.0))
    across = np.where(usable, moment, 0.0)
    distance = norm(across)
    second = np.where((distance > 0.0)[..., None], unit(across), perpendicular(along)[0])
    second = unit(second - dot(second, along)[..., None] * along)
    rotation = np.stack([along, second, np.cross(along, second)], axis=-1)
    hypotenuse = np.hypot(1.0, distance)
    wvec = np.stack([1.0 / hypotenuse, distance / hypotenuse], axis=-1)
    return np.where(usable, quaternion.from_matrix(rotation), np.nan), np.where(usable, wvec, np.nan)


def from_limap_minimal(uvec: FloatArray, wvec: FloatArray) -> FloatArray:
    """Lines (..., 6) from LIMAP's uvec [x, y, z, w], of any length, and wvec; inverse of :func:`to_limap_minimal`.

    The moment is :math:`|w_2|/|w_1|` times the second column, as in LIMAP 1; both signs of wvec are the same line.
    """
    rotation = quaternion.to_matrix(unit(vectors(uvec, 4, "uvec")))
    weights = np.abs(vectors(wvec, 2, "wvec"))
    return stack(weights[..., 1:] * rotation[..., :, 1], weights[..., :1] * rotation[..., :, 0])


def to_spatialmath(line: FloatArray) -> FloatArray:
    """Vector [v, w] (..., 6) of ``Line3`` of spatialmath-python: v = w x p, the opposite moment, and direction w.

    References
    ----------
    spatialmath-python, spatialmath/geom3d.py, Line3.PointDir. Its Line3.Join(P, Q) points from Q to P.
    """
    return to_order(line, "opposite_moment_direction")


def from_spatialmath(vector: FloatArray) -> FloatArray:
    """Lines (..., 6) from the vector [v, w] of ``Line3`` of spatialmath-python."""
    return from_order(vector, "opposite_moment_direction")


def to_g2o(line: FloatArray) -> FloatArray:
    """Vector (..., 6) of g2o's ``Line3D``: moment w = p x d first, then the unit direction d. NaN at infinity.

    References
    ----------
    g2o, g2o/types/slam3d_addons/line3d.h, Line3D::fromCartesian and Line3D::normalize.
    """
    return np.where(line3.is_finite(line)[..., None], line3.normalize(line), np.nan)


def from_g2o(vector: FloatArray) -> FloatArray:
    """Lines (..., 6) from the vector of g2o's ``Line3D``: the same order and sign."""
    return vectors(vector, 6, "vector").copy()


def to_gtsam(line: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    r"""GTSAM's ``Line3``: rotation R (..., 3, 3) and a, b (...).

    The line is the z axis, moved by (a, b) in its xy plane and turned: foot point :math:`R\,(a, b, 0)`, direction
    :math:`R e_3`. The roll about the line is free; R's first column is chosen by a rule that depends on d only, so
    lines through the origin are no exception. NaN for lines at infinity.

    References
    ----------
    GTSAM, gtsam/geometry/Line3.h and Line3::point. Its ``Line3::project`` returns -m.
    """
    line = vectors(line, 6, "line")
    finite = line3.is_finite(line)
    along = np.where(finite[..., None], line[..., 3:], (0.0, 0.0, 1.0))
    first, second = perpendicular(along)
    rotation = np.stack([first, second, unit(along)], axis=-1)
    foot = line3.foot_point(line)
    return np.where(finite[..., None, None], rotation, np.nan), dot(first, foot), dot(second, foot)


def from_gtsam(rotation: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Lines (..., 6), unit direction, from the R, a, b of GTSAM's ``Line3``; inverse of :func:`to_gtsam`."""
    rotation = matrices(rotation, 3, 3, "rotation")
    a, b = np.asarray(a, dtype=np.float64)[..., None], np.asarray(b, dtype=np.float64)[..., None]
    return stack(b * rotation[..., :, 0] - a * rotation[..., :, 1], rotation[..., :, 2])
