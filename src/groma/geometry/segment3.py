# SPDX-License-Identifier: BSD-3-Clause
r"""Distances between line segments in space, each with the meaning and, up to rounding, the value of one of LIMAP's.

A segment is a pair of end points, shape (..., 2, 3), scene units, directed from the first to the second. All functions
on two segments broadcast their leading axes, so ``first[:, None], second[None]`` gives the matrix of all pairs. In the
formulas the first segment runs from :math:`a_0` to :math:`a_1`, the second from :math:`b_0` to :math:`b_1`, with
lengths :math:`|a|, |b|` and unit directions :math:`\hat a, \hat b`;

.. math:: r_b(x) = \| (x - b_0) - \hat b \hat b^\top (x - b_0) \|

is the distance of a point from the line of the second. Functions with ``one_way`` measure the first segment against the
second; without it they take the greater of both ways, and are symmetric. A segment without length is a point: its
direction is zero, and the distance from its line is that from the point.

Scale-invariant distances are divided by the depths (..., 2) of the end points in the image that made the segment, so
they are angles as the camera sees them, in radians where they are small.

=======================================  ==============================================================================
LIMAP                                    here
=======================================  ==============================================================================
ANGULAR (degrees)                        :func:`angle` (radians)
ANGULAR_DIST                             :func:`angular_distance`
ENDPOINTS                                :func:`endpoint_distance`
MIDPOINT                                 :func:`midpoint_distance`
MIDPOINT_PERPENDICULAR                   :func:`midpoint_perpendicular_distance`
OVERLAP, BIOVERLAP, OVERLAP_DIST         :func:`overlap`, :func:`mutual_overlap`, :func:`overlap_distance`
PERPENDICULAR(_ONEWAY)                   :func:`perpendicular_distance`
INNERSEG                                 :func:`inner_segment_distance`
PERPENDICULAR_SCALEINV(_ONEWAY)          :func:`scale_invariant_perpendicular_distance`, depths along the second
PERPENDICULAR_SCALEINV_LINE3DPP          :func:`scale_invariant_perpendicular_distance` with ``own_depths``
ENDPOINTS_SCALEINV(_ONEWAY)              :func:`scale_invariant_endpoint_distance`
``dist_minpoint``                        :func:`nearest_distance`
``infinite_dist_perpendicular``          :func:`line_distance`
the same, ``scaleinv_line3dpp``          :func:`scale_invariant_line_distance`
=======================================  ==============================================================================

References
----------
S. Liu et al., *3D Line Mapping Revisited*, CVPR 2023, section 3.2 and supplement A. Deviations: the limits of parallel,
perpendicular and lengthless segments are exact, where LIMAP adds a small number to the denominators.
"""

from __future__ import annotations

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.errors import InputError
from groma.geometry.algebra import dot, matrices, norm, ratio, unit, vectors

#: Directions whose angle has a smaller sine count as parallel: their common perpendicular has no digits left.
PARALLEL_SINE = 1e-9


def _ends(segment: FloatArray, name: str = "segment") -> tuple[FloatArray, FloatArray]:
    segment = matrices(segment, 2, 3, name)
    return segment[..., 0, :], segment[..., 1, :]


def _depths(depths: FloatArray, name: str) -> tuple[FloatArray, FloatArray]:
    depths = vectors(depths, 2, name)
    if not (depths > 0.0).all():
        raise InputError(f"{name} must be positive; got {depths.min()}. Pass the depths of the end points, in order.")
    return depths[..., 0], depths[..., 1]


def length(segment: FloatArray) -> FloatArray:
    """Lengths (...) in scene units."""
    start, end = _ends(segment)
    return norm(end - start)


def midpoint(segment: FloatArray) -> FloatArray:
    """Midpoints (..., 3)."""
    start, end = _ends(segment)
    return 0.5 * (start + end)


def direction(segment: FloatArray) -> FloatArray:
    """Unit directions (..., 3); zero for a segment without length."""
    start, end = _ends(segment)
    return unit(end - start)


def _across(vector: FloatArray, along: FloatArray) -> FloatArray:
    """Parts of vectors perpendicular to unit (or zero) directions."""
    return vector - dot(vector, along)[..., None] * along


def _away(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances of the two end points of the first segments from the lines of the second."""
    along, (start, _) = direction(second), _ends(second, "second")
    one, two = (norm(_across(point - start, along)) for point in _ends(first, "first"))
    return one, two


# ------------------------------------------------------------------------------------------------------------- Angles
def angle(first: FloatArray, second: FloatArray) -> FloatArray:
    r"""Angle (...) in radians, 0 to pi/2; zero if a segment has no length.

    .. math:: \operatorname{atan2}(\|\hat a \times \hat b\|, |\hat a^\top \hat b|)
    """
    one, two = direction(first), direction(second)
    return np.arctan2(norm(np.cross(one, two)), np.abs(dot(one, two)))


def angular_distance(first: FloatArray, second: FloatArray) -> FloatArray:
    r"""One less the cosine of the angle, (...): 0 to 1.

    .. math:: 1 - |\hat a^\top \hat b| = 2 \sin^2(\theta / 2)
    """
    return 2.0 * np.sin(0.5 * angle(first, second)) ** 2


# --------------------------------------------------------------------------------------------- Between points of both
def endpoint_distance(first: FloatArray, second: FloatArray) -> FloatArray:
    r"""Sum (...) of the distances of corresponding end points, in the better of the two orders.

    .. math:: \min(\|a_0 - b_0\| + \|a_1 - b_1\|,\; \|a_0 - b_1\| + \|a_1 - b_0\|)

    That of segments in images (:func:`groma.geometry.segment2.endpoint_distance`) is the mean.
    """
    (a, b), (c, d) = _ends(first, "first"), _ends(second, "second")
    return np.minimum(norm(a - c) + norm(b - d), norm(a - d) + norm(b - c))


def midpoint_distance(first: FloatArray, second: FloatArray) -> FloatArray:
    r"""Distance (...) of the midpoints: :math:`\tfrac12 \|a_0 + a_1 - b_0 - b_1\|`."""
    return norm(midpoint(first) - midpoint(second))


def midpoint_perpendicular_distance(first: FloatArray, second: FloatArray) -> FloatArray:
    r"""Mean (...) of the distances of each midpoint from the other's line.

    .. math:: \tfrac12 \left(r_b(\tfrac12(a_0 + a_1)) + r_a(\tfrac12(b_0 + b_1))\right)
    """
    apart = midpoint(first) - midpoint(second)
    return 0.5 * (norm(_across(apart, direction(second))) + norm(_across(apart, direction(first))))


def perpendicular_distance(first: FloatArray, second: FloatArray, one_way: bool = False) -> FloatArray:
    r"""Greatest distance (...) of an end point from the other's line.

    .. math:: \max(r_b(a_0), r_b(a_1)) \quad\text{and, both ways, also}\quad r_a(b_0), r_a(b_1)
    """
    there = np.maximum(*_away(first, second))
    return there if one_way else np.maximum(there, np.maximum(*_away(second, first)))


def line_distance(first: FloatArray, second: FloatArray) -> FloatArray:
    r"""Distance (...) of the two infinite lines.

    .. math:: |(b_0 - a_0)^\top k| / \|k\|, \quad k = \hat a \times \hat b; \qquad r_b(a_0) \text{ where parallel}
    """
    one, two, apart = direction(first), direction(second), _ends(second)[0] - _ends(first)[0]
    common = np.cross(one, two)
    sine = norm(common)
    parallel = norm(_across(_across(apart, two), one))
    return np.where(sine > PARALLEL_SINE, ratio(np.abs(dot(apart, common)), sine, sine > PARALLEL_SINE), parallel)


def nearest_distance(first: FloatArray, second: FloatArray) -> FloatArray:
    r"""Smallest distance (...) of a place on one segment from the infinite line of the other.

    .. math:: \min_{0 \le t \le 1} \min\left(r_b(a_0 + t (a_1 - a_0)),\; r_a(b_0 + t (b_1 - b_0))\right)

    Zero where either segment crosses the other's line.
    """
    return np.minimum(_nearest(first, second), _nearest(second, first))


def _nearest(first: FloatArray, second: FloatArray) -> FloatArray:
    along, (origin, _), (start, end) = direction(second), _ends(second), _ends(first)
    offset, extent = _across(start - origin, along), _across(end - start, along)
    squared = dot(extent, extent)
    t = np.clip(ratio(-dot(offset, extent), squared, squared > 0.0, 0.0), 0.0, 1.0)
    return norm(offset + t[..., None] * extent)


# ------------------------------------------------------------------------------------------------------------ Overlap
def overlap(first: FloatArray, second: FloatArray) -> FloatArray:
    r"""Share (...) of the second segment that the first covers when it is projected onto it.

    .. math:: \min(\max(s_0, s_1), 1) - \max(\min(s_0, s_1), 0), \qquad s_i = \hat b^\top (a_i - b_0) / |b|

    Negative, the gap in lengths of the second, where they do not overlap. Zero if the second has no length.
    """
    (start, _), extent = _ends(second, "second"), length(second)
    along = direction(second)
    places = [ratio(dot(point - start, along), extent, extent > 0.0, 0.0) for point in _ends(first, "first")]
    return np.minimum(np.maximum(*places), 1.0) - np.maximum(np.minimum(*places), 0.0)


def mutual_overlap(first: FloatArray, second: FloatArray) -> FloatArray:
    """Greater (...) of the two overlaps: a short segment beside a long one has 1."""
    return np.maximum(overlap(first, second), overlap(second, first))


def overlap_distance(first: FloatArray, second: FloatArray) -> FloatArray:
    """One less :func:`mutual_overlap`, (...): 0 where one lies wholly beside the other, above 1 across a gap."""
    return 1.0 - mutual_overlap(first, second)


def inner_segment(first: FloatArray, second: FloatArray) -> tuple[FloatArray, BoolArray]:
    r"""Return the part of the second segment that lies beside the first.

    It lies between the planes through the ends of the first that are perpendicular to the first:

    .. math:: \{\, b_0 + t (b_1 - b_0) : 0 \le t \le 1,\; 0 \le \hat a^\top (b_0 + t (b_1 - b_0) - a_0) \le |a| \,\}

    Returns
    -------
    segment : (..., 2, 3) float64
        The part, directed like the second; NaN where there is none.
    exists : (...) bool
        Whether there is a part with a length; where the segments are perpendicular, the second lies wholly between the
        planes or wholly outside.
    """
    (origin, _), (start, end) = _ends(first, "first"), _ends(second, "second")
    along, extent = direction(first), length(first)
    height, slope = dot(start - origin, along), dot(end - start, along)
    sloping = slope != 0.0
    at = ratio(-height, slope, sloping, -np.inf), ratio(extent - height, slope, sloping, np.inf)
    low, high = np.maximum(np.minimum(*at), 0.0), np.minimum(np.maximum(*at), 1.0)
    exists = (low < high) & (sloping | ((height >= 0.0) & (height <= extent))) & (extent > 0.0)
    low, high = (np.where(exists, t, np.nan)[..., None] for t in (low, high))
    return np.stack([start + low * (end - start), start + high * (end - start)], axis=-2), exists


def inner_segment_distance(first: FloatArray, second: FloatArray) -> FloatArray:
    """:func:`perpendicular_distance` (...) of the parts of two segments that lie beside each other.

    Infinite where one has no :func:`inner_segment`. What one segment has beyond the other does not count, so a small
    angle between a short segment and a long one costs little.
    """
    (inner_second, there), (inner_first, back) = inner_segment(first, second), inner_segment(second, first)
    both = (there & back)[..., None, None]
    distance = perpendicular_distance(np.where(both, inner_first, 0.0), np.where(both, inner_second, 0.0))
    return np.where(there & back, distance, np.inf)


# --------------------------------------------------------------------------------------------------- Scale-invariant
def scale_invariant_endpoint_distance(
    first: FloatArray, second: FloatArray, first_depths: FloatArray, second_depths: FloatArray | None = None
) -> FloatArray:
    r"""Greatest distance (...) of corresponding end points over the depth.

    .. math:: \max(\|a_0 - b_0\| / z_{a0},\; \|a_1 - b_1\| / z_{a1})

    With ``second_depths`` the greater of this and the same over the depths of the second. The order of the ends counts.
    """
    (a, b), (c, d) = _ends(first, "first"), _ends(second, "second")
    near, far = norm(a - c), norm(b - d)
    ways = [_depths(first_depths, "first_depths")]
    if second_depths is not None:
        ways.append(_depths(second_depths, "second_depths"))
    return np.max(np.stack(np.broadcast_arrays(*(np.maximum(near / z0, far / z1) for z0, z1 in ways))), axis=0)


def scale_invariant_perpendicular_distance(
    first: FloatArray,
    second: FloatArray,
    first_depths: FloatArray,
    second_depths: FloatArray,
    one_way: bool = False,
    own_depths: bool = False,
) -> FloatArray:
    r"""Greatest distance (...) of an end point from the other's line, over a depth.

    .. math:: \max(r_b(a_0) / z(a_0),\; r_b(a_1) / z(a_1)) \quad\text{and, both ways, also with a and b exchanged}

    The depth is that of the other segment at the foot of the end point, linear along it,
    :math:`z(x) = z_{b0} + s\,(z_{b1} - z_{b0})` with :math:`s = \hat b^\top(x - b_0)/|b|`; with ``own_depths`` it is
    that of the end point itself. Infinite where the depth at the foot is not positive.
    """
    there = _over_depths(first, second, first_depths, second_depths, own_depths)
    if one_way:
        return there
    return np.maximum(there, _over_depths(second, first, second_depths, first_depths, own_depths))


def _over_depths(
    first: FloatArray, second: FloatArray, first_depths: FloatArray, second_depths: FloatArray, own_depths: bool
) -> FloatArray:
    own, (begin, finish) = _depths(first_depths, "first_depths"), _depths(second_depths, "second_depths")
    depths = list(own)
    if not own_depths:
        (start, _), extent, along = _ends(second, "second"), length(second), direction(second)
        places = [ratio(dot(x - start, along), extent, extent > 0.0, 0.0) for x in _ends(first, "first")]
        depths = [begin + place * (finish - begin) for place in places]
    values = [ratio(r, z, z > 0.0, np.inf) for r, z in zip(_away(first, second), depths, strict=True)]
    return np.maximum(*values)


def scale_invariant_line_distance(
    first: FloatArray, second: FloatArray, first_depths: FloatArray, second_depths: FloatArray | None = None
) -> FloatArray:
    r"""Smallest distance (...) of a point of one infinite line from the other line, over the depth of the point.

    .. math:: \min_t \frac{r_b(a_0 + t(a_1 - a_0))}{z_{a0} + t (z_{a1} - z_{a0})}
        = \frac{\|u \times v\|}{\|z_{a0} v - (z_{a1} - z_{a0}) u\|}

    with u and v the parts of :math:`a_0 - b_0` and :math:`a_1 - a_0` perpendicular to :math:`\hat b`. With
    ``second_depths`` the smaller of both ways. Zero for parallel lines whose depth changes: they meet at infinity.
    """
    there = _line_over_depth(first, second, first_depths, "first_depths")
    if second_depths is None:
        return there
    return np.minimum(there, _line_over_depth(second, first, second_depths, "second_depths"))


def _line_over_depth(first: FloatArray, second: FloatArray, depths: FloatArray, name: str) -> FloatArray:
    (start, end), (origin, _), along = _ends(first), _ends(second), direction(second)
    near, far = _depths(depths, name)
    u, v = _across(start - origin, along), _across(end - start, along)
    below = norm(near[..., None] * v - (far - near)[..., None] * u)
    return ratio(norm(np.cross(u, v)), below, below > 0.0, 1.0) * np.where(below > 0.0, 1.0, norm(u) / near)


__all__ = [
    "PARALLEL_SINE",
    "angle",
    "angular_distance",
    "direction",
    "endpoint_distance",
    "inner_segment",
    "inner_segment_distance",
    "length",
    "line_distance",
    "midpoint",
    "midpoint_distance",
    "midpoint_perpendicular_distance",
    "mutual_overlap",
    "nearest_distance",
    "overlap",
    "overlap_distance",
    "perpendicular_distance",
    "scale_invariant_endpoint_distance",
    "scale_invariant_line_distance",
    "scale_invariant_perpendicular_distance",
]
