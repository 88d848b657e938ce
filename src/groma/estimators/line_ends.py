# SPDX-License-Identifier: BSD-3-Clause
r"""Where a line ends, from the ends of the segments that show it. Kernels only.

An image shows less of a line where something stands before it, or where a detector breaks the segment; and more, now
and then, where another edge goes on in the same direction. So the outermost end is not to be trusted, and most ends lie
too far inside. A line first reaches as far as two images see it. If some way inside of that many images end at the same
place, within a few pixels, and few go on, then that is the end, and those that go on are wrong:

.. math:: n_\text{end} \ge 3\, n_\text{beyond}.

Of the images that end there, the outer third counts, by their resolution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._numba import kernel, loop
from groma._ordering import ascending, copy, median
from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.batch_least_squares import PROBLEMS_AT_ONCE
from groma.execution import map_ranges
from groma.gates import STRECHA, gate, numbers
from groma.geometry.incidence import MIN_SINE


@dataclass(frozen=True)
class LineEndGates:
    """Where a line ends, by where its segments end."""

    same_end: float = gate(5.0, "px", "ends so near to each other are the same end", "chosen on Strecha's scenes")
    majority: float = gate(3.0, "ratio", "images that end at a place, over those that go on", STRECHA)
    quantile: float = gate(1 / 3, "share", "of the weight of segments, beyond an end", STRECHA)


#: The defaults.
LINE_ENDS = LineEndGates()


@kernel
def _along(center, ray, X):
    """Where the ray from a camera comes closest to the line X: position in units of X's length, and depth."""
    d0, d1, d2 = X[1, 0] - X[0, 0], X[1, 1] - X[0, 1], X[1, 2] - X[0, 2]
    w0, w1, w2 = X[0, 0] - center[0], X[0, 1] - center[1], X[0, 2] - center[2]
    dd = d0 * d0 + d1 * d1 + d2 * d2
    ff = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]
    df = d0 * ray[0] + d1 * ray[1] + d2 * ray[2]
    dw = d0 * w0 + d1 * w1 + d2 * w2
    fw = ray[0] * w0 + ray[1] * w1 + ray[2] * w2
    determinant = dd * ff - df * df
    if not determinant > MIN_SINE**2 * dd * ff:
        return np.nan, -1.0
    return (df * fw - ff * dw) / determinant, (dd * fw - df * dw) / determinant


@kernel
def _seen_twice(ends, order, limits):
    """Write from where to where at least two of the intervals cover a line, minus the former; -inf if no two overlap.

    ``ends`` (2, count) are minus the lower ends of intervals and their upper ends, ``order`` sorts each, falling.
    """
    count = ends.shape[1]
    limits[0], limits[1] = -np.inf, -np.inf
    depth = i = 0
    j = count - 1
    while j >= 0:
        if i < count and -ends[0, order[0, i]] <= ends[1, order[1, j]]:
            depth += 1
            if depth == 2:
                limits[0] = max(limits[0], ends[0, order[0, i]])
            i += 1
        else:
            if depth == 2:
                limits[1] = max(limits[1], ends[1, order[1, j]])
            depth -= 1
            j -= 1


@kernel
def _end_of(last, order, size, usual, limit, stop, gates):
    """The upper end of a line from the upper ends of its segments and the size of a pixel of each, along the line.

    ``order`` sorts the ends, falling, and ``usual`` is the median size. ``limit`` is as far as two images see; the end
    is not below ``stop``.
    """
    same_end, majority, quantile = gates
    count = len(last)
    place = limit
    for k in order:
        if last[k] > limit:
            continue
        if last[k] < stop:
            break
        ends, beyond = 0, 0
        for m in range(count):
            if last[m] > last[k] + same_end * size[m]:
                beyond += 1
            elif last[m] >= last[k] - same_end * min(size[m], size[k]):
                ends += 1
        if ends >= majority * beyond and beyond > 0:
            place = last[k]
            break
        if majority * beyond > count:
            break
    reach = same_end * usual
    total = 0.0
    for k in order:
        if abs(last[k] - place) <= reach:
            total += 1.0 / (size[k] * size[k])
    so_far = 0.0
    for k in order:
        if abs(last[k] - place) <= reach:
            so_far += 1.0 / (size[k] * size[k])
            if so_far >= quantile * total:
                return last[k]
    return place


@loop
def _trim_all(center, image, ray, length, pointers, rows, active, gates, X, front):
    """Loop of :func:`trim`."""
    limits = np.empty(2)
    for n in range(len(pointers) - 1):
        begin, end = pointers[n], pointers[n + 1]
        ends, rising, size = np.empty((2, end - begin)), np.empty((2, end - begin)), np.empty(end - begin)
        order = np.empty((2, end - begin), np.int64)
        count = 0
        for m in range(begin, end):
            s = rows[m]
            t0, z0 = _along(center[image[s]], ray[s, 0], X[n])
            t1, z1 = _along(center[image[s]], ray[s, 1], X[n])
            front[m] = z0 > 0.0 and z1 > 0.0
            if active[m] and front[m]:
                low, high = min(t0, t1), max(t0, t1)
                ends[0, count], ends[1, count], rising[0, count], rising[1, count] = -low, high, low, -high
                size[count] = max(abs(t1 - t0) / length[s], 1e-12)
                count += 1
        for side in range(2):
            copy(ascending(rising[side, :count]), order[side, :count])
        _seen_twice(ends[:, :count], order, limits)
        if -limits[0] < limits[1]:
            middle, usual = 0.5 * (limits[1] - limits[0]), median(size[:count])
            for side in range(2):
                stop = middle if side else -middle
                limits[side] = _end_of(
                    ends[side, :count], order[side, :count], size, usual, limits[side], stop, gates
                )  # fmt: skip
            for c in range(3):
                a, d = X[n, 0, c], X[n, 1, c] - X[n, 0, c]
                X[n, 0, c], X[n, 1, c] = a - limits[0] * d, a + limits[1] * d


@dataclass(frozen=True)
class SegmentRays:
    """Segments as the rays of their ends."""

    #: (N, 3) camera centres, and the camera (S,) of each segment.
    center: FloatArray
    image: IntArray
    #: (S, 2, 3) directions of the ends.
    ray: FloatArray
    #: (S,) lengths in the image, pixels.
    length: FloatArray


def trim(
    segments: SegmentRays, pointers: IntArray, rows: IntArray, active: BoolArray, X: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return end points (L, 2, 3) of lines X where they end, and (M,) whether observations lie before their cameras.

    Observations of all lines are flat arrays, stored by line: those of line n are ``pointers[n] : pointers[n + 1]``,
    and ``rows`` names their segments.
    """
    found, front = X.copy(), np.empty(len(rows), np.bool_)

    def trim_some(part: slice) -> None:
        _trim_all(
            segments.center, segments.image, segments.ray, segments.length, pointers[part.start : part.stop + 1], rows,
            active, numbers(LINE_ENDS), found[part], front,
        )  # fmt: skip

    map_ranges(trim_some, len(X), PROBLEMS_AT_ONCE)
    return found, front
