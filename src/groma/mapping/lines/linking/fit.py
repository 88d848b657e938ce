# SPDX-License-Identifier: BSD-3-Clause
"""Lines from their observations: maximum likelihood, and segments that lie on them.

The residuals and the parameters of a line are those of :mod:`groma.estimators.two_point_line`, under a Cauchy loss.

Observations of all lines are flat arrays, stored by line: those of line n are ``pointers[n] : pointers[n + 1]``, and
``rows`` names their segments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from groma._numba import kernel, loop, unrolled_loop
from groma._simd import width
from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.batch_least_squares import PROBLEMS_AT_ONCE, Observations, solve_batch, solve_damped
from groma.estimators.two_point_line import TWO_POINT_LINE, line_residuals
from groma.execution import map_ranges
from groma.mapping.lines.views import LineViews

#: Scale of the Cauchy loss, in sigma.
_CAUCHY = 2.0
_FOUR = width(4)
#: Segments in a box that lines are compared with (cost: time alone), and pixels by which boxes are larger than these
#: (derived from rounding).
_BOX, _MARGIN = 16, 1e-6


# ------------------------------------------------------------------------------------------------------------- Refine
@kernel
def _largest_deviation(H, g, L, x):
    """Root of the largest diagonal entry of the inverse of H; infinite where it has none."""
    worst = 0.0
    for a in range(4):
        g[:] = 0.0
        g[a] = 1.0
        if not solve_damped(H, g, 0.0, L, x, _FOUR):
            return np.inf
        worst = max(worst, x[a])
    return math.sqrt(worst)


@loop
def _examine(camera, image, own, pointers, active, X, U, squared, uncertainty, unchecked):
    """Write what :class:`Fit` tells of lines that were refined."""
    r, g, x = np.zeros(2), np.zeros(4), np.zeros(4)
    L, H, without = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4))
    for n in range(len(pointers) - 1):
        begin, end = pointers[n], pointers[n + 1]
        J = np.empty((end - begin, 2, 4))
        H[:, :] = 0.0
        for m in range(begin, end):
            own_J = J[m - begin]
            line_residuals(camera, image[m], own, m, X[n], U[n], r, own_J)
            squared[m] = r[0] * r[0] + r[1] * r[1]
            if active[m]:
                for a in range(4):
                    for b in range(a + 1):
                        H[a, b] += own_J[0, a] * own_J[0, b] + own_J[1, a] * own_J[1, b]
        for m in range(begin - 1, end):  # with all images, then without that of each observation
            if m >= begin and (not active[m] or (m > begin and active[m - 1] and image[m] == image[m - 1])):
                continue
            for a in range(4):
                for b in range(a + 1):
                    without[a, b] = H[a, b]
            k = max(m, begin)
            while m >= begin and k < end and image[k] == image[m]:
                if active[k]:
                    own_J = J[k - begin]
                    for a in range(4):
                        for b in range(a + 1):
                            without[a, b] -= own_J[0, a] * own_J[0, b] + own_J[1, a] * own_J[1, b]
                k += 1
            worst = _largest_deviation(without, g, L, x)
            if m < begin:
                uncertainty[n] = worst
            else:
                unchecked[n] = max(unchecked[n], worst)


@dataclass(frozen=True)
class Fit:
    """Lines of maximum likelihood."""

    #: (L, 2, 3) points on the lines.
    X: FloatArray
    #: (M,) squared distances over sigma of each observation.
    squared: FloatArray
    #: (L,) largest standard deviation of the end points across the line, and the same when the image that tells most is
    #: left out.
    uncertainty: FloatArray
    unchecked: FloatArray


def fit_lines(
    views: LineViews, sigma: FloatArray, pointers: IntArray, rows: IntArray, active: BoolArray, start: FloatArray
) -> Fit:
    """Fit lines to the segments ``rows`` (M,) that are ``active``, from lines through ``start`` (L, 2, 3)."""
    own = np.column_stack([views.ends[rows], sigma[rows]])
    observations = Observations(views.camera, views.image_idx[rows], own, pointers, active)
    found = solve_batch(TWO_POINT_LINE, observations, start, cauchy_scale=_CAUCHY)
    fit = Fit(found.states, np.zeros(len(rows)), np.zeros(len(start)), np.zeros(len(start)))

    def examine(part: slice) -> None:
        _examine(
            observations.shared, observations.shared_idx, own, pointers[part.start : part.stop + 1], active,
            fit.X[part], found.frames[part], fit.squared, fit.uncertainty[part], fit.unchecked[part],
        )  # fmt: skip

    map_ranges(examine, len(start), PROBLEMS_AT_ONCE)
    return fit


# ------------------------------------------------------------------------------------------------------------ Recover
@unrolled_loop
def find_on_lines(P, X, order, ends, sigma, forward, gate, min_overlap, min_px, found, distance):
    """Segments of one image that lie on projections of lines; return the number written, or needed.

    ``order`` holds the segments to look at, near ones together: lines are compared with boxes around a few of them at a
    time. Those of a line are written in the order of their numbers.
    """
    count, boxes = 0, -(-len(order) // _BOX)
    x, y, w, h, reach = np.empty(boxes), np.empty(boxes), np.empty(boxes), np.empty(boxes), np.empty(boxes)
    for b in range(boxes):
        left, right, top, bottom, largest = np.inf, -np.inf, np.inf, -np.inf, 0.0
        for k in range(b * _BOX, min((b + 1) * _BOX, len(order))):
            s = order[k]
            left, right = min(left, ends[s, 0], ends[s, 2]), max(right, ends[s, 0], ends[s, 2])
            top, bottom = min(top, ends[s, 1], ends[s, 3]), max(bottom, ends[s, 1], ends[s, 3])
            largest = max(largest, sigma[s])
        x[b], y[b], w[b], h[b] = 0.5 * (left + right), 0.5 * (top + bottom), 0.5 * (right - left), 0.5 * (bottom - top)
        reach[b] = math.sqrt(gate) * largest + _MARGIN
    near = np.empty(boxes, np.bool_)
    for n in range(len(X)):
        x0 = P[0, 0] * X[n, 0, 0] + P[0, 1] * X[n, 0, 1] + P[0, 2] * X[n, 0, 2] + P[0, 3]
        y0 = P[1, 0] * X[n, 0, 0] + P[1, 1] * X[n, 0, 1] + P[1, 2] * X[n, 0, 2] + P[1, 3]
        z0 = P[2, 0] * X[n, 0, 0] + P[2, 1] * X[n, 0, 1] + P[2, 2] * X[n, 0, 2] + P[2, 3]
        x1 = P[0, 0] * X[n, 1, 0] + P[0, 1] * X[n, 1, 1] + P[0, 2] * X[n, 1, 2] + P[0, 3]
        y1 = P[1, 0] * X[n, 1, 0] + P[1, 1] * X[n, 1, 1] + P[1, 2] * X[n, 1, 2] + P[1, 3]
        z1 = P[2, 0] * X[n, 1, 0] + P[2, 1] * X[n, 1, 1] + P[2, 2] * X[n, 1, 2] + P[2, 3]
        if z0 <= 1e-6 or z1 <= 1e-6:
            continue
        x0, y0, x1, y1 = x0 / z0, y0 / z0, x1 / z1, y1 / z1
        dx, dy = x1 - x0, y1 - y0
        length = math.sqrt(dx * dx + dy * dy)
        if length < min_px:
            continue
        dx, dy = dx / length, dy / length
        offset, middle, half = x0 * dy - y0 * dx, 0.5 * (x0 + x1) * dx + 0.5 * (y0 + y1) * dy, 0.5 * length + _MARGIN
        for b in range(boxes):  # most segments are far away; this loop becomes vector instructions
            across = abs(x[b] * dy - y[b] * dx - offset) - (w[b] * abs(dy) + h[b] * abs(dx) + reach[b])
            along = abs(x[b] * dx + y[b] * dy - middle) - (w[b] * abs(dx) + h[b] * abs(dy) + half)
            near[b] = (across <= 0.0) & (along <= 0.0)
        begin = count
        for b in range(boxes):
            if not near[b]:
                continue
            for k in range(b * _BOX, min((b + 1) * _BOX, len(order))):
                s = order[k]
                first = (ends[s, 0] - x0) * dy - (ends[s, 1] - y0) * dx
                second = (ends[s, 2] - x0) * dy - (ends[s, 3] - y0) * dx
                if first * first + second * second > gate * sigma[s] * sigma[s]:
                    continue
                t0 = (ends[s, 0] - x0) * dx + (ends[s, 1] - y0) * dy
                t1 = (ends[s, 2] - x0) * dx + (ends[s, 3] - y0) * dy
                if forward[n] * (t1 - t0) < 0.0:
                    continue
                overlap = min(max(t0, t1), length) - max(min(t0, t1), 0.0)
                if overlap < min_overlap * min(abs(t1 - t0), length) or overlap < min_px:
                    continue
                if count < len(found):
                    at = count
                    while at > begin and found[at - 1, 1] > s:
                        found[at, 1], distance[at] = found[at - 1, 1], distance[at - 1]
                        at -= 1
                    found[count, 0], found[at, 1] = n, s
                    distance[at] = (first * first + second * second) / (sigma[s] * sigma[s])
                count += 1
    return count


def near_together(ends: FloatArray, usable: BoolArray) -> IntArray:
    """Order of the usable segments, near ones together: strips of an image, each from top to bottom."""
    rows = np.flatnonzero(usable)
    x, y = ends[rows, 0] + ends[rows, 2], ends[rows, 1] + ends[rows, 3]
    strip = np.empty(len(rows))
    strip[np.argsort(x)] = np.arange(len(rows)) // (math.isqrt(len(rows) * _BOX) + 1)
    return rows[np.argsort(strip * (2.0 * np.ptp(y) + 1.0) + y)] if len(rows) else rows
