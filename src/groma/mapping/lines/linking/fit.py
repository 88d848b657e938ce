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

from groma._numba import kernel, loop
from groma._simd import width
from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.batch_least_squares import PROBLEMS_AT_ONCE, Observations, solve_batch, solve_damped
from groma.estimators.two_point_line import TWO_POINT_LINE, line_residuals
from groma.execution import map_ranges
from groma.mapping.lines.views import LineViews

#: Scale of the Cauchy loss, in sigma.
_CAUCHY = 2.0
_FOUR = width(4)


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
    r, J, g, x = np.zeros(2), np.zeros((2, 4)), np.zeros(4), np.zeros(4)
    L, H, without = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4))
    for n in range(len(pointers) - 1):
        begin, end = pointers[n], pointers[n + 1]
        H[:, :] = 0.0
        for m in range(begin, end):
            line_residuals(camera, image[m], own, m, X[n], U[n], r, J)
            squared[m] = r[0] * r[0] + r[1] * r[1]
            if active[m]:
                for a in range(4):
                    for b in range(a + 1):
                        H[a, b] += J[0, a] * J[0, b] + J[1, a] * J[1, b]
        uncertainty[n] = _largest_deviation(H, g, L, x)
        for m in range(begin, end):
            if not active[m] or (m > begin and active[m - 1] and image[m] == image[m - 1]):
                continue
            for a in range(4):
                for b in range(4):
                    without[a, b] = H[a, b]
            for k in range(m, end):
                if image[k] != image[m]:
                    break
                if active[k]:
                    line_residuals(camera, image[k], own, k, X[n], U[n], r, J)
                    for a in range(4):
                        for b in range(a + 1):
                            without[a, b] -= J[0, a] * J[0, b] + J[1, a] * J[1, b]
            unchecked[n] = max(unchecked[n], _largest_deviation(without, g, L, x))


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
@loop
def find_on_lines(P, X, lines, rows, ends, sigma, usable, forward, gate, min_overlap, min_px, found, distance):
    """Segments (rows) of one image that lie on projections of lines; return the number written, or needed."""
    count = 0
    u, v, allowed = ends[rows, 0], ends[rows, 1], gate * sigma[rows] * sigma[rows]
    for k in range(len(rows)):
        if not usable[rows[k]]:
            allowed[k] = -1.0
    near = np.empty(len(rows), np.bool_)
    for e in range(len(lines)):
        n = lines[e]
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
        offset = x0 * dy - y0 * dx
        for k in range(len(rows)):  # most segments are far away; this loop becomes vector instructions
            first = u[k] * dy - v[k] * dx - offset
            near[k] = first * first <= allowed[k]
        for k in range(len(rows)):
            if not near[k]:
                continue
            s = rows[k]
            first = (ends[s, 0] - x0) * dy - (ends[s, 1] - y0) * dx
            second = (ends[s, 2] - x0) * dy - (ends[s, 3] - y0) * dx
            if first * first + second * second > allowed[k]:
                continue
            t0 = (ends[s, 0] - x0) * dx + (ends[s, 1] - y0) * dy
            t1 = (ends[s, 2] - x0) * dx + (ends[s, 3] - y0) * dy
            if forward[n] * (t1 - t0) < 0.0:
                continue
            overlap = min(max(t0, t1), length) - max(min(t0, t1), 0.0)
            if overlap < min_overlap * min(abs(t1 - t0), length) or overlap < min_px:
                continue
            if count < len(found):
                found[count, 0], found[count, 1] = n, s
                distance[count] = (first * first + second * second) / (sigma[s] * sigma[s])
            count += 1
    return count
