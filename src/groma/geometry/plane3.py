# SPDX-License-Identifier: BSD-3-Clause
r"""Planes in four forms, their conversions, construction and distances.

A plane is :math:`\pi = [n, w]` with :math:`n^\top X + w = 0`, up to one factor. The forms:

homogeneous
    [n, w] of any scale; the one all functions take.
Hesse
    unit normal; w is minus the signed distance of the plane from the origin along n. :func:`hesse` keeps the side the
    normal points to, :func:`canonical` makes the normal point away from the origin (w <= 0; for w = 0 the first
    component of n that is not zero is positive).
closest point
    the point of the plane closest to the origin, three numbers. Planes through the origin do not have this form.
unit quaternion
    [n, w] with norm one and w >= 0, read as a quaternion [x, y, z, w]; the rotation is by 2 atan2(|n|, w) about n.
    Every plane has it, also the plane at infinity (the identity) and planes through the origin (a half turn, where
    both signs remain and the first component of n that is not zero is made positive).

The plane at infinity has n = 0: its Hesse form, closest point and distances are NaN or infinite, as stated.
"""

from __future__ import annotations

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.geometry.algebra import dot, norm, not_negative, ratio, stack, unit, vectors


def _first_sign(vector: FloatArray) -> FloatArray:
    """Sign (+1 or -1) of the first component that is not zero."""
    index = np.argmax(vector != 0.0, axis=-1)[..., None]
    return np.where(np.take_along_axis(vector, index, axis=-1)[..., 0] < 0.0, -1.0, 1.0)


def hesse(plane: FloatArray) -> FloatArray:
    """Planes (..., 4) with unit normal, the side of the normal kept. NaN for the plane at infinity."""
    plane = vectors(plane, 4, "plane")
    length = norm(plane[..., :3])[..., None]
    return ratio(plane, length, length > 0.0)


def canonical(plane: FloatArray) -> FloatArray:
    """Hesse form (..., 4) with the normal pointing away from the origin, the same for every factor of the plane.

    w <= 0 is minus the distance. For w = 0 the first component of n that is not zero is positive. NaN for the plane at
    infinity.
    """
    plane = hesse(plane)
    flip = np.where(plane[..., 3] == 0.0, _first_sign(plane[..., :3]), -np.copysign(1.0, plane[..., 3]))
    return plane * flip[..., None]


def to_closest_point(plane: FloatArray) -> FloatArray:
    r"""Point (..., 3) of planes (..., 4) closest to the origin, :math:`-w\,n/\|n\|^2`. NaN for the plane at infinity.

    The zero vector for planes through the origin, whose normal is then lost.
    """
    plane = vectors(plane, 4, "plane")
    squared = dot(plane[..., :3], plane[..., :3])[..., None]
    return ratio(-plane[..., 3:] * plane[..., :3], squared, squared > 0.0)


def from_closest_point(point: FloatArray) -> FloatArray:
    """Planes (..., 4), canonical Hesse form, whose closest point to the origin is (..., 3): [p/|p|, -|p|].

    NaN for the zero vector, which leaves the normal open.
    """
    point = vectors(point, 3, "point")
    length = norm(point)[..., None]
    return stack(ratio(point, length, length > 0.0), np.where(length > 0.0, -length, np.nan))


def to_quaternion(plane: FloatArray) -> FloatArray:
    """Unit quaternions [x, y, z, w] (..., 4) of planes, with w >= 0.

    References
    ----------
    Point-line-plane notes, section on planes: q(pi) = pi/|pi|. The sign is not fixed there; see the module's text.
    """
    quaternion = unit(vectors(plane, 4, "plane"))
    flip = np.where(quaternion[..., 3] == 0.0, _first_sign(quaternion[..., :3]), np.copysign(1.0, quaternion[..., 3]))
    return quaternion * flip[..., None]


def from_quaternion(quaternion: FloatArray) -> FloatArray:
    """Hesse form (..., 4) of planes given as quaternions [x, y, z, w]. NaN for the identity, the plane at infinity."""
    return hesse(vectors(quaternion, 4, "quaternion"))


def from_points(first: FloatArray, second: FloatArray, third: FloatArray) -> FloatArray:
    r"""Plane through three points, normal :math:`(p_2 - p_1) \times (p_3 - p_1)`: anticlockwise seen from its side.

    Parameters
    ----------
    first, second, third : (..., 3) float64
        Points, scene units.

    Returns
    -------
    (..., 4) float64
        Planes; |n| is twice the area of the triangle, zero where the points lie on one line.
    """
    first, second, third = vectors(first, 3, "first"), vectors(second, 3, "second"), vectors(third, 3, "third")
    normal = np.cross(second - first, third - first)
    return stack(normal, -dot(normal, first)[..., None])


def from_point_and_normal(point: FloatArray, normal: FloatArray) -> FloatArray:
    """Plane (..., 4) through points (..., 3) with normals (..., 3) of any length: [n, -n·p]."""
    point, normal = vectors(point, 3, "point"), vectors(normal, 3, "normal")
    return stack(normal, -dot(normal, point)[..., None])


def signed_distance(plane: FloatArray, point: FloatArray) -> FloatArray:
    """Signed distance (n·p + w)/|n| of points (..., 3), positive on the side of the normal.

    Infinity with the sign of w for the plane at infinity.
    """
    plane, point = vectors(plane, 4, "plane"), vectors(point, 3, "point")
    length = norm(plane[..., :3])
    value = dot(plane[..., :3], point) + plane[..., 3]
    return np.where(length > 0.0, ratio(value, length, length > 0.0), np.copysign(np.inf, value))


def closest_point(plane: FloatArray, point: FloatArray) -> FloatArray:
    """Foot (..., 3) of points (..., 3) on planes (..., 4). NaN for the plane at infinity."""
    plane, point = vectors(plane, 4, "plane"), vectors(point, 3, "point")
    normal = plane[..., :3]
    squared = dot(normal, normal)[..., None]
    return point - ratio((dot(normal, point) + plane[..., 3])[..., None] * normal, squared, squared > 0.0)


def same_plane(first: FloatArray, second: FloatArray, tolerance: float = 1e-9, oriented: bool = False) -> BoolArray:
    """Whether planes (..., 4) are equal up to scale (and sign, unless ``oriented``), compared as unit 4-vectors.

    False where a vector is zero or not finite. The measure depends on the unit of length.
    """
    first, second = unit(vectors(first, 4, "first")), unit(vectors(second, 4, "second"))
    apart = norm(first - second)
    if not oriented:
        apart = np.minimum(apart, norm(first + second))
    return (apart <= not_negative(tolerance, "tolerance")) & (norm(first) > 0.0) & (norm(second) > 0.0)
