# SPDX-License-Identifier: BSD-3-Clause
r"""Proposals without another segment: lines through known points that lie on a segment in the image.

With the position t along the segment, 0 at its first end and 1 at its second, the inverse depth of a straight line is
affine in t. Two points determine it, and a third one confirms it. Where the ratio of the inverse depths
at the two ends is known from a vanishing point, :math:`q(t) = q_1 (1 + (r - 1) t)`, one point is enough.
"""

from __future__ import annotations

import math

import numpy as np

from groma._numba import kernel, loop
from groma._typing import FloatArray, IntArray
from groma.features.segments import SEGMENTS
from groma.mapping.lines.gates import AGREEMENT
from groma.mapping.lines.views import LineViews

#: Points of one segment that are looked at (cost: time).
_MAX_POINTS = 16


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _points_on(ends, line, begin, end, order, pixel, inverse, max_distance, t, q, found):
    """Positions along a segment and inverse depths of the first points on it, of order[begin:end]; return how many."""
    ux, uy = ends[2] - ends[0], ends[3] - ends[1]
    length2 = ux * ux + uy * uy
    reach = max_distance / math.sqrt(length2)
    number = 0
    for k in range(begin, end):
        p = order[k]
        if abs(line[0] * pixel[p, 0] + line[1] * pixel[p, 1] + line[2]) > max_distance:
            continue
        at = ((pixel[p, 0] - ends[0]) * ux + (pixel[p, 1] - ends[1]) * uy) / length2
        if not -reach <= at <= 1.0 + reach or (number == len(t) and p > found[number - 1]):
            continue
        number = min(number + 1, len(t))
        m = number - 1
        while m > 0 and found[m - 1] > p:
            t[m], q[m], found[m] = t[m - 1], q[m - 1], found[m - 1]
            m -= 1
        t[m], q[m], found[m] = at, inverse[p], p
    return number


@kernel
def _through_one(t, q, number, ratio, tolerance, out):
    """Scale the known ratio by the point that most others agree with; fill out = q1 q2 c11 c12 c22."""
    change, most, middle = ratio[0] - 1.0, 0, 0.0
    for m in range(number):
        scale = q[m] / (1.0 + change * t[m])
        agree = 0
        for p in range(number):
            if abs(scale * (1.0 + change * t[p]) - q[p]) < tolerance * q[p]:
                agree += 1
        if agree > most:
            most, middle = agree, scale
    out[0], out[1] = middle, ratio[0] * middle
    variance = (0.5 * tolerance * out[0]) ** 2
    out[2], out[3] = variance, ratio[0] * variance
    # The last term keeps the covariance regular.
    out[4] = ratio[0] ** 2 * variance + (ratio[1] * out[0]) ** 2 + 0.01 * variance


@kernel
def _through_several(t, q, number, tolerance, min_apart, out):
    """Fit the line that most points agree on, three at least; fill out = q1 q2 c11 c12 c22; False where too few do."""
    best, first, second = 2, -1, -1
    for m in range(number):
        for n in range(m):
            if abs(t[m] - t[n]) < min_apart:
                continue
            slope = (q[m] - q[n]) / (t[m] - t[n])
            agree = 0
            for p in range(number):
                if abs(q[n] + slope * (t[p] - t[n]) - q[p]) < tolerance * q[p]:
                    agree += 1
            if agree > best:
                best, first, second = agree, m, n
    if first < 0:
        return False
    slope = (q[first] - q[second]) / (t[first] - t[second])
    s0 = s1 = s2 = y0 = y1 = 0.0
    for p in range(number):
        if abs(q[second] + slope * (t[p] - t[second]) - q[p]) < tolerance * q[p]:
            u, v = 1.0 - t[p], t[p]
            s0, s1, s2 = s0 + u * u, s1 + u * v, s2 + v * v
            y0, y1 = y0 + u * q[p], y1 + v * q[p]
    determinant = s0 * s2 - s1 * s1
    if not determinant > 1e-6:
        return False
    out[0], out[1] = (s2 * y0 - s1 * y1) / determinant, (s0 * y1 - s1 * y0) / determinant
    variance = (0.5 * tolerance * max(out[0], out[1])) ** 2
    out[2], out[3] = variance * s2 / determinant, -variance * s1 / determinant
    out[4] = variance * s0 / determinant
    return True


@loop
def _propose(
    ends, line, usable, search, ratio, near, order, pixel, inverse, max_distance, tolerance, min_apart, neighbor,
    out_index, out,
):  # fmt: skip
    """Lines through one point have the slot ``neighbor + 1``, those through several ``neighbor``; return how many."""
    count = 0
    t, q, found, work = np.empty(_MAX_POINTS), np.empty(_MAX_POINTS), np.empty(_MAX_POINTS, np.int64), np.empty(5)
    for i in range(len(ends)):
        if not usable[i]:
            continue
        number = _points_on(ends[i], line[i], near[i, 0], near[i, 1], order, pixel, inverse, max_distance, t, q, found)
        for several in range(2):
            if several:
                if not _through_several(t, q, number, tolerance, min_apart, work):
                    continue
            elif ratio[i, 0] > 0.0 and number > 0:
                _through_one(t, q, number, ratio[i], tolerance, work)
            else:
                continue
            if min(work[0], work[1]) < search[i, 0] or max(work[0], work[1]) > search[i, 1]:
                continue
            out_index[count, 0], out_index[count, 1], out_index[count, 2] = i, neighbor + 1 - several, -1
            out[count, 5] = 1.0
            for c in range(5):
                out[count, c] = work[c]
            count += 1
    return count


# ------------------------------------------------------------------------------------------------------------- Public
def lines_through_points(
    views: LineViews, rows: slice, ratios: FloatArray, points: tuple[FloatArray, FloatArray], slot: int
) -> tuple[IntArray, FloatArray]:
    """Lines through known points on the segments of an image, as proposals.

    Parameters
    ----------
    views, rows : LineViews, slice
        The segments of all images, and which of them are those of the image.
    ratios : (n, 2) float64
        Ratio of the inverse depths at the two ends of each segment and its deviation; zero where it is not known.
    points : (p, 2), (p,)
        Pixels and inverse depths of the points.
    slot : int
        What stands for points in the place of a neighbour; the next number stands for a point and a direction.

    Returns
    -------
    (m, 3) int, (m, 6) float64
        Segment, slot, -1; and inverse depths, their covariance, and score, as in
        :class:`groma.mapping.lines.hypotheses.proposals.Proposals`.
    """
    index, values = np.empty((2 * len(ratios), 3), np.int64), np.empty((2 * len(ratios), 6))
    ends, order = views.ends[rows], np.argsort(points[0][:, 0])
    x = np.sort(ends[:, ::2], axis=1) + 2.0 * SEGMENTS.on * np.array([-1.0, 1.0])  # a point on a segment is in between
    near = np.searchsorted(points[0][order, 0], x)
    count = _propose(
        ends, views.line[rows], views.usable[rows], views.range[rows], ratios, near, order, *points, SEGMENTS.on,
        AGREEMENT.depth, SEGMENTS.overlap, slot, index, values,
    )  # fmt: skip
    return index[:count], values[:count]
