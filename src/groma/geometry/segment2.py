# SPDX-License-Identifier: BSD-3-Clause
r"""Line segments in the image: homogeneous lines, directions, distances between segments.

A segment is [x1, y1, x2, y2], pixels, shape (..., 4), directed from the first end point to the second. All functions on
two segments broadcast their leading axes, so ``first[:, None], second[None]`` gives the matrix of all pairs. A segment
of length zero has no direction; its line is zero and its direction zero, never NaN.
"""

from __future__ import annotations

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.geometry.algebra import dot, norm, ratio, stack, unit, vectors


def _ends(segment: FloatArray, name: str = "segment") -> tuple[FloatArray, FloatArray]:
    segment = vectors(segment, 4, name)
    return segment[..., :2], segment[..., 2:]


def length(segment: FloatArray) -> FloatArray:
    """Lengths (...) in pixels."""
    start, end = _ends(segment)
    return norm(end - start)


def midpoint(segment: FloatArray) -> FloatArray:
    """Midpoints (..., 2) in pixels."""
    start, end = _ends(segment)
    return 0.5 * (start + end)


def direction(segment: FloatArray) -> FloatArray:
    """Unit directions (..., 2); zero for a segment of length zero."""
    start, end = _ends(segment)
    return unit(end - start)


def reverse(segment: FloatArray) -> FloatArray:
    """Segments (..., 4) with their end points exchanged."""
    start, end = _ends(segment)
    return stack(end, start)


def to_line(segment: FloatArray) -> FloatArray:
    r"""Homogeneous line through a segment, scaled to :math:`l_1^2 + l_2^2 = 1`.

    .. math:: l \sim x_1 \times x_2, \qquad x = [u, v, 1]

    Its value at a point is the distance, positive to the right of the direction as seen in an image with y down.

    Parameters
    ----------
    segment : (..., 4) float64
        Segments, pixels.

    Returns
    -------
    (..., 3) float64
        Lines; zero for a segment of length zero.

    Notes
    -----
    The third entry is taken at the midpoint, which keeps the digits of short segments far from the pixel origin.

    References
    ----------
    Plücker notes, section 5.6.2, eq. (61) with the sign corrected.
    """
    along = direction(segment)
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    return stack(normal, -dot(normal, midpoint(segment))[..., None])


def project_onto_line(segment: FloatArray, line: FloatArray) -> FloatArray:
    """Segments (..., 4) whose end points are moved to their feet on homogeneous lines (..., 3).

    NaN where the line is zero or at infinity (l1 = l2 = 0).
    """
    start, end = _ends(segment)
    line = vectors(line, 3, "line")
    normal = line[..., :2]
    squared = dot(normal, normal)[..., None]
    feet = [
        point - ratio((dot(normal, point) + line[..., 2])[..., None] * normal, squared, squared > 0.0)
        for point in (start, end)
    ]
    return stack(*feet)


def clip_line(line: FloatArray, width: float, height: float) -> tuple[FloatArray, BoolArray]:
    """Part of homogeneous lines inside an image.

    Parameters
    ----------
    line : (..., 3) float64
        Lines.
    width, height : float
        Size of the image in pixels; it spans (0, 0) to (width, height).

    Returns
    -------
    segment : (..., 4) float64
        Segments along the direction (l2, -l1), so that :func:`to_line` gives the line back, sign included. NaN where
        the line does not cross the image.
    inside : (...) bool
        Whether it crosses it, with a positive length.
    """
    line = vectors(line, 3, "line")
    normal = line[..., :2]
    squared = dot(normal, normal)
    usable = squared > 0.0
    center = np.array([0.5 * width, 0.5 * height])
    offset = ratio((dot(normal, center) + line[..., 2])[..., None] * normal, squared[..., None], usable[..., None])
    foot = center - offset
    along = unit(np.stack([normal[..., 1], -normal[..., 0]], axis=-1))
    moving = along != 0.0
    low, high = ratio(-foot, along, moving, -np.inf), ratio(2.0 * center - foot, along, moving, np.inf)
    within = (moving | ((foot >= 0.0) & (foot <= 2.0 * center))).all(axis=-1)
    begin = np.minimum(low, high).max(axis=-1)
    finish = np.maximum(low, high).min(axis=-1)
    inside = usable & within & (begin < finish)
    begin, finish = np.where(inside, begin, np.nan), np.where(inside, finish, np.nan)
    return stack(foot + begin[..., None] * along, foot + finish[..., None] * along), inside


# ----------------------------------------------------------------------------------------------- Between two segments
def angle(first: FloatArray, second: FloatArray, oriented: bool = False) -> FloatArray:
    """Angle (...) in radians, 0 to pi/2; with ``oriented`` 0 to pi. Zero if a segment has no length."""
    one, two = direction(first), direction(second)
    sine = np.abs(one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0])
    cosine = dot(one, two)
    return np.arctan2(sine, cosine if oriented else np.abs(cosine))


def perpendicular_distance(first: FloatArray, second: FloatArray) -> FloatArray:
    """Distances (..., 2) in pixels of the end points of the first segment from the line of the second.

    Where the second has no length, the distances from its point.
    """
    line = to_line(second)
    middle, has_line = midpoint(second), length(second) > 0.0
    distances = [
        np.where(has_line, np.abs(dot(line[..., :2], point) + line[..., 2]), norm(point - middle))
        for point in _ends(first, "first")
    ]
    return np.stack(distances, axis=-1)


def overlap(first: FloatArray, second: FloatArray) -> FloatArray:
    """Length (...) in pixels that the first segment, projected onto the second, has in common with it.

    Zero where they do not overlap or the second has no length. Divide by :func:`length` of either, or of the shorter,
    for a ratio.
    """
    start, end = _ends(second, "second")
    along = unit(end - start)
    at = np.stack([dot(point - start, along) for point in _ends(first, "first")], axis=-1)
    extent = norm(end - start)
    return np.maximum(np.minimum(at.max(axis=-1), extent) - np.maximum(at.min(axis=-1), 0.0), 0.0)


def endpoint_distance(first: FloatArray, second: FloatArray, oriented: bool = False) -> FloatArray:
    """Mean distance (...) in pixels of corresponding end points.

    Unless ``oriented``, for the better of the two orders of the end points.
    """
    (a, b), (c, d) = _ends(first, "first"), _ends(second, "second")
    straight = 0.5 * (norm(a - c) + norm(b - d))
    return straight if oriented else np.minimum(straight, 0.5 * (norm(a - d) + norm(b - c)))


def midpoint_distance(first: FloatArray, second: FloatArray) -> FloatArray:
    """Distance (...) of the midpoints in pixels."""
    return norm(midpoint(first) - midpoint(second))


def segments_apart(first: FloatArray, second: FloatArray) -> FloatArray:
    """Largest distance (n, m) of the ends of segments (n, 4) from the lines of others (m, 4); infinite where the middle
    of the first is not beside the second.
    """
    query, ends = first.reshape(-1, 2, 2), second.reshape(-1, 2, 2)
    step = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(step, axis=1)
    away = query[:, None] - ends[None, :, :1]
    across = np.abs(away @ np.array([[0.0, -1.0], [1.0, 0.0]]) @ (step / length[:, None])[None, :, :, None])[..., 0]
    along = (away.mean(axis=2) * step).sum(axis=-1) / length**2
    return np.where((along > 0) & (along < 1), across.max(axis=2), np.inf)
