# SPDX-License-Identifier: BSD-3-Clause
r"""Join and meet of points, lines and planes; two lines in space: relation, distance, common perpendicular.

Joins and meets of exact objects return homogeneous coordinates, which are well defined in every case: a meet at
infinity has W = 0, and an undefined join or meet is the zero vector. Nothing divides, nothing warns.

Two *measured* lines never meet exactly. :func:`closest_points`, :func:`join_lines` and :func:`meet_lines` therefore
return a status per pair, :class:`LineRelation`, beside the numbers, and use closest points instead of the closed
formulas of the Plücker notes (45), (47): those carry wrong signs in print, (47) is 0/0 when the common plane contains
the origin, and (45) is zero for parallel lines, which have a plane all the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.geometry import line3
from groma.geometry.algebra import cross, dot, norm, not_negative, ratio, stack, unit, vectors

#: Lines, or a ray and a line, at an angle with a smaller sine do not tell where they pass each other (derived from
#: noise: 50 times as large).
MIN_SINE = 0.02


class LineRelation(IntEnum):
    """How two lines lie to each other, within the tolerances given."""

    #: They meet in one point.
    CROSSING = 0
    #: They pass each other at a distance.
    SKEW = 1
    #: Same direction (either sign), a positive distance.
    PARALLEL = 2
    #: The same line.
    IDENTICAL = 3
    #: One of the two is no finite line: d is zero, or a number is not finite.
    INVALID = 4


# ------------------------------------------------------------------------------------------------------- Join and meet
def side(first: FloatArray, second: FloatArray) -> FloatArray:
    r"""Side operator :math:`(L|\hat L) = d^\top \hat m + m^\top \hat d` of lines (..., 6).

    Zero for coplanar lines. Positive where the second line passes the first anticlockwise, seen with the first pointing
    at the viewer; its size is ``|d x d^|`` times the distance.

    References
    ----------
    Plücker notes, eq. (40)-(43): (40) is minus the determinant of the four points for coordinates with W last.
    """
    first, second = vectors(first, 6, "first"), vectors(second, 6, "second")
    return dot(first[..., :3], second[..., 3:]) + dot(first[..., 3:], second[..., :3])


def meet_line_plane(line: FloatArray, plane: FloatArray) -> FloatArray:
    r"""Homogeneous point where lines meet planes, :math:`X = L\,\pi = [\,m \times n + w d,\; -d^\top n\,]`.

    Parameters
    ----------
    line : (..., 6) float64
        Lines.
    plane : (..., 4) float64
        Planes.

    Returns
    -------
    (..., 4) float64
        Homogeneous points. W = 0 for a line parallel to the plane: the line's point at infinity. Zero where the line
        lies in the plane.

    References
    ----------
    Plücker notes, eq. (48), (50); (50) is minus this vector.
    """
    line, plane = vectors(line, 6, "line"), vectors(plane, 4, "plane")
    normal, along = plane[..., :3], line[..., 3:]
    return stack(cross(line[..., :3], normal) + plane[..., 3:] * along, -dot(along, normal)[..., None])


def join_line_point(line: FloatArray, point: FloatArray) -> FloatArray:
    r"""Plane (..., 4) through lines (..., 6) and homogeneous points (..., 4).

    .. math:: \pi = L^* X = [\,d \times \tilde X + W m,\; -m^\top \tilde X\,]

    Zero where the point lies on the line.

    References
    ----------
    Plücker notes, eq. (51), (53); (53) is minus this vector, (39) is printed with a wrong sign.
    """
    line, point = vectors(line, 6, "line"), vectors(point, 4, "point")
    position, across = point[..., :3], line[..., :3]
    return stack(cross(line[..., 3:], position) + point[..., 3:] * across, -dot(across, position)[..., None])


def meet_planes(first: FloatArray, second: FloatArray) -> FloatArray:
    """Line (..., 6) of two planes (..., 4): :func:`groma.geometry.line3.from_planes`."""
    return line3.from_planes(first, second)


def join_points(first: FloatArray, second: FloatArray) -> FloatArray:
    """Line (..., 6) of two homogeneous points (..., 4): :func:`groma.geometry.line3.from_homogeneous_points`."""
    return line3.from_homogeneous_points(first, second)


def join_three_points(first: FloatArray, second: FloatArray, third: FloatArray) -> FloatArray:
    """Plane (..., 4) through three homogeneous points (..., 4), some of which may lie at infinity.

    The join of the line of the first two with the third. Zero where the points lie on one line.
    """
    return join_line_point(line3.from_homogeneous_points(first, second), third)


def meet_three_planes(first: FloatArray, second: FloatArray, third: FloatArray) -> FloatArray:
    """Homogeneous point (..., 4) common to three planes (..., 4).

    W = 0 where all three are parallel to one line; zero where they share a line.
    """
    return meet_line_plane(line3.from_planes(first, second), third)


def dehomogenize(point: FloatArray) -> FloatArray:
    """Points (..., 3) of homogeneous points (..., 4). NaN where W is zero: at infinity, or undefined."""
    point = vectors(point, 4, "point")
    return ratio(point[..., :3], point[..., 3:], point[..., 3:] != 0.0)


# ----------------------------------------------------------------------------------------------------------- Two lines
@dataclass(frozen=True)
class ClosestPoints:
    """Two lines against each other. Arrays have the broadcast leading axes of the two."""

    #: (..., 3) point of the first line closest to the second; zero where the status is INVALID.
    first: FloatArray
    #: (..., 3) point of the second line closest to the first.
    second: FloatArray
    #: (...) distance of the lines, scene units.
    distance: FloatArray
    #: (...) sine of the angle between the lines, 0 to 1.
    sine: FloatArray
    #: (..., 6) line that meets both at right angles, unit direction from the first to the second; for CROSSING lines
    #: the normal of their plane in their point; zero for IDENTICAL and INVALID, where it is not determined.
    common_perpendicular: FloatArray
    #: (...) :class:`LineRelation`.
    status: IntArray

    @property
    def midpoint(self) -> FloatArray:
        """(..., 3) point half-way between the closest points."""
        return 0.5 * (self.first + self.second)


def closest_points(
    first: FloatArray, second: FloatArray, distance_tolerance: float = 1e-9, parallel_sine: float = 1e-8
) -> ClosestPoints:
    r"""Closest points, distance and common perpendicular of two lines, in every position.

    With :math:`k = d \times \hat d`

    .. math:: c = \frac{-m \times (\hat d \times k) + (\hat m^\top k)\, d}{k^\top k}, \qquad
              \hat c = \frac{\hat m \times (d \times k) - (m^\top k)\, \hat d}{k^\top k}, \qquad
              \text{distance} = \frac{|d^\top \hat m + m^\top \hat d|}{\|k\|}

    Parallel lines: the foot of the origin on the first, and its foot on the second.

    Parameters
    ----------
    first, second : (..., 6) float64
        Lines, any scale.
    distance_tolerance : float
        Distance up to which lines count as meeting, or as the same line; scene units.
    parallel_sine : float
        Sine of the angle up to which lines count as parallel. The points of nearly parallel lines lose digits like one
        over the sine; below 1e-8 the parallel formulas are the more accurate ones. With a larger value the distance of
        such pairs is the one near the origin.

    Returns
    -------
    ClosestPoints
        Points, distance, sine, common perpendicular and status; finite in every case. Invalid pairs have zeros and an
        infinite distance.

    References
    ----------
    Plücker notes, section 5.1, eq. (40)-(43) for the coplanarity test; the points are derived from m = p x d.
    Y.-B. Jia, *Plücker coordinates for lines in the space*, section 4.2, has the same formulas.
    """
    first, second = np.broadcast_arrays(vectors(first, 6, "first"), vectors(second, 6, "second"))
    not_negative(distance_tolerance, "distance_tolerance")
    not_negative(parallel_sine, "parallel_sine")
    valid = line3.is_finite(first) & line3.is_finite(second)
    placeholder = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    first = line3.normalize(np.where(valid[..., None], first, placeholder))
    second = line3.normalize(np.where(valid[..., None], second, placeholder))
    m1, d1, m2, d2 = first[..., :3], first[..., 3:], second[..., :3], second[..., 3:]
    k = cross(d1, d2)
    squared = dot(k, k)
    sine = np.minimum(np.sqrt(squared), 1.0)
    parallel = sine <= parallel_sine
    oblique = ~parallel[..., None]
    foot = cross(d1, m1)
    c1 = ratio(cross(cross(d2, k), m1) + dot(m2, k)[..., None] * d1, squared[..., None], oblique, 0.0) + np.where(
        oblique, 0.0, foot
    )
    c2 = ratio(cross(m2, cross(d1, k)) - dot(m1, k)[..., None] * d2, squared[..., None], oblique, 0.0)
    c2 = np.where(oblique, c2, line3.closest_point(second, foot))
    gap = c2 - c1
    distance = np.where(parallel, norm(gap), ratio(np.abs(side(first, second)), sine, ~parallel, 0.0))
    apart = distance > distance_tolerance
    status = np.select(
        [~valid, parallel & apart, parallel, apart],
        [LineRelation.INVALID, LineRelation.PARALLEL, LineRelation.IDENTICAL, LineRelation.SKEW],
        LineRelation.CROSSING,
    )
    # k has every digit of the direction; the gap has its sign, and is all there is for parallel lines
    sign = np.where(dot(k, gap) < 0.0, -1.0, 1.0)[..., None]
    normal = np.where(oblique, sign * unit(k), np.where(apart[..., None], unit(gap), 0.0))
    perpendicular_line = line3.from_point_and_direction(np.where(valid[..., None], 0.5 * (c1 + c2), 0.0), normal)
    usable = valid[..., None]
    return ClosestPoints(
        first=np.where(usable, c1, 0.0),
        second=np.where(usable, c2, 0.0),
        distance=np.where(valid, distance, np.inf),
        sine=np.where(valid, sine, 0.0),
        common_perpendicular=np.where(usable, perpendicular_line, 0.0),
        status=status,
    )


def distance(first: FloatArray, second: FloatArray) -> FloatArray:
    """Distance (...) of two lines (..., 6) in every position; infinity where one of them is no finite line."""
    return closest_points(first, second).distance


@dataclass(frozen=True)
class LineJoin:
    """Planes that hold two lines."""

    #: (..., 4) plane in Hesse form; zero where the status is IDENTICAL or INVALID.
    plane: FloatArray
    #: (...) distance of either line from the plane, scene units: half the lines' own where they are SKEW, else 0;
    #: infinity where there is no plane.
    distance: FloatArray
    #: (...) :class:`LineRelation`; for SKEW lines the plane lies half-way between them, parallel to both.
    status: IntArray


def join_lines(
    first: FloatArray, second: FloatArray, distance_tolerance: float = 1e-9, parallel_sine: float = 1e-8
) -> LineJoin:
    r"""Plane through two lines; for parallel lines too, and a stated answer for skew ones.

    .. math:: n = d \times \hat d, \qquad w = \tfrac12(\hat m^\top d - m^\top \hat d)

    For parallel lines :math:`n = d \times (\hat p_\perp - p_\perp)`, :math:`w = -n^\top p_\perp`.

    Parameters
    ----------
    first, second, distance_tolerance, parallel_sine
        As for :func:`closest_points`.

    Returns
    -------
    LineJoin
        Planes, distances and status.

    References
    ----------
    Plücker notes, eq. (44), (45). (45) is printed with the sign of w for m = d x p; here w is the mean of its two equal
    forms -m·d^ and m^·d, which also answers skew lines.
    """
    pair = closest_points(first, second, distance_tolerance, parallel_sine)
    first, second = np.broadcast_arrays(vectors(first, 6, "first"), vectors(second, 6, "second"))
    known = np.isin(pair.status, (LineRelation.CROSSING, LineRelation.SKEW, LineRelation.PARALLEL))
    first, second = (line3.normalize(np.where(known[..., None], line, 0.0)) for line in (first, second))
    parallel = pair.status == LineRelation.PARALLEL
    w = 0.5 * (dot(second[..., :3], first[..., 3:]) - dot(first[..., :3], second[..., 3:]))
    oblique_plane = stack(cross(first[..., 3:], second[..., 3:]), w[..., None])
    normal = cross(first[..., 3:], unit(pair.second - pair.first))
    parallel_plane = stack(normal, -dot(normal, pair.first)[..., None])
    plane = np.where(parallel[..., None], parallel_plane, oblique_plane)
    length = norm(plane[..., :3])[..., None]
    return LineJoin(
        plane=ratio(plane, length, known[..., None] & (length > 0.0), 0.0),
        distance=np.where(pair.status == LineRelation.SKEW, 0.5 * pair.distance, np.where(known, 0.0, np.inf)),
        status=pair.status,
    )


@dataclass(frozen=True)
class LineMeet:
    """Points where two lines meet."""

    #: (..., 4) homogeneous point: [X, Y, Z, 1] where the status is CROSSING or SKEW, the point at infinity
    #: [d, 0] with unit d where it is PARALLEL, zero where it is IDENTICAL or INVALID.
    point: FloatArray
    #: (...) distance of the lines, scene units: the point lies half of it off either line.
    distance: FloatArray
    #: (...) sine of the angle between the lines. The point is uncertain along them by about noise / sine.
    sine: FloatArray
    #: (...) :class:`LineRelation`. Only CROSSING points are to be trusted; SKEW ones are half-way between the lines.
    status: IntArray


def meet_lines(
    first: FloatArray, second: FloatArray, distance_tolerance: float = 1e-9, min_sine: float = MIN_SINE
) -> LineMeet:
    r"""Point where two lines meet: the midpoint of their closest points.

    .. math:: X \sim [\,m \times \hat m,\; m^\top \hat d\,]

    is the same point for exactly coplanar lines whose plane does not contain the origin; the midpoint needs neither.

    Parameters
    ----------
    first, second : (..., 6) float64
        Lines, any scale.
    distance_tolerance : float
        Largest distance at which lines count as meeting, scene units. Choose it from the noise.
    min_sine : float
        Smallest sine of the angle between lines that are allowed to meet at a finite point.

    Returns
    -------
    LineMeet
        Points, distances, sines and status; finite in every case.

    References
    ----------
    Plücker notes, eq. (46), (47). W is printed as d·d^, which cannot be: it is m·d^.
    """
    pair = closest_points(first, second, distance_tolerance)
    first, second = np.broadcast_arrays(vectors(first, 6, "first"), vectors(second, 6, "second"))
    finite = np.isin(pair.status, (LineRelation.CROSSING, LineRelation.SKEW))
    status = np.where(finite & (pair.sine < not_negative(min_sine, "min_sine")), LineRelation.PARALLEL, pair.status)
    finite &= status != LineRelation.PARALLEL
    parallel = status == LineRelation.PARALLEL
    d1, d2 = unit(first[..., 3:]), unit(second[..., 3:])
    along = unit(d1 + np.where(dot(d1, d2) < 0.0, -1.0, 1.0)[..., None] * d2)
    position = np.where(finite[..., None], pair.midpoint, np.where(parallel[..., None], along, 0.0))
    return LineMeet(
        point=stack(position, finite[..., None].astype(np.float64)),
        distance=pair.distance,
        sine=pair.sine,
        status=status,
    )
