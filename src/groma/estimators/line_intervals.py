# SPDX-License-Identifier: BSD-3-Clause
r"""Which intervals of a line images support, from what each image's segments cover of it. Kernels only.

At a place t of a line let c(t) be the number of images whose segments cover it, d(t) the number of images that deny
it: they show the line on both sides of t, but not there, and e(t) the most images that show it on one side only and
end at the same place. Breaks no wider than the noise of segment ends are no breaks. The place is supported where at
least two images show it, as many as the ends of a line need, and are not outvoted, neither by the rule that decides on
the ends (:mod:`groma.estimators.line_ends`) nor by images that end together, as those of a curve beside its chord do:

.. math:: c \ge 2, \qquad d < 3\, c, \qquad e < 2\, c.

An interval between two supported ones is supported, too, where it is no wider than the noise of the ends, or where one
image shows all of it and none denies it. What stands before a line in some images does not break it: it hides another
part of it from every view. What is gone in all images does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._numba import kernel, loop
from groma._ordering import ascending, median
from groma._rows import numbered
from groma._typing import FloatArray, IntArray
from groma.estimators.line_ends import LINE_ENDS
from groma.execution import map_ranges
from groma.gates import gate

#: Images that must show a place of a line.
_MIN_IMAGES = 2


@dataclass(frozen=True)
class IntervalGates:
    """When a place of a line is supported, in addition to what decides on its ends."""

    ended: float = gate(2.0, "ratio", "images that end at one place, over those that go on", "chosen on the chair")


GATES = IntervalGates()
#: Lines that are worth a thread: some milliseconds (cost: time only).
_LINES_AT_ONCE = 512


@kernel
def _joined(image, low, high, size, same_end):
    """Join the segments of one image across gaps within the noise of ends.

    Return start and end of each piece, in turn, and 1 for each that is the outermost of its image, else 0.
    """
    count = len(image)
    order, cuts, is_outer = np.empty(count, np.int64), np.empty(2 * count), np.empty(2 * count, np.int64)
    for k in range(count):  # they are few, and mostly come by image
        m = k
        while m > 0:
            before = order[m - 1]
            if image[before] < image[k] or (image[before] == image[k] and low[before] <= low[k]):
                break
            order[m] = before
            m -= 1
        order[m] = k
    found = 0
    for m in range(count):
        k = order[m]
        goes_on = m > 0 and image[order[m - 1]] == image[k]
        if goes_on and low[k] <= cuts[found - 1] + same_end * size[k]:
            cuts[found - 1] = max(cuts[found - 1], high[k])
            continue
        if goes_on:
            is_outer[found - 1] = 0
        cuts[found], cuts[found + 1] = low[k], high[k]
        is_outer[found], is_outer[found + 1] = not goes_on, 1
        found += 2
    return cuts[:found], is_outer


@kernel
def _num_ended(cuts, is_outer, order, here, ends, noise):
    """Count the images that show a line on one side of a cut only and end at the same place, the most that do."""
    most = start = found = 0
    for m in range(len(order)):
        k = order[m]
        if is_outer[k] and (k % 2 == 1) == (m <= here):
            ends[found] = cuts[k]
            found += 1
            while cuts[k] - ends[start] > 2.0 * noise:
                start += 1
            most = max(most, found - start)
    return most


@kernel
def _intervals(image, low, high, size, gates, begins, ends):
    """Write the supported intervals of a line between 0 and 1; return their number."""
    same_end, majority, most_ended = gates
    cuts, is_outer = _joined(image, low, high, size, same_end)
    noise = same_end * median(size)
    order, near = ascending(cuts), np.empty(len(cuts))
    found, bridged = 0, False
    shown = spanned = 0  # images that show the place after a cut, and those that show it or both of its sides
    for k in range(len(cuts) - 1):
        step = 1 - 2 * (order[k] % 2)
        shown += step
        spanned += step * is_outer[order[k]]
        begin, end = max(cuts[order[k]], 0.0), min(cuts[order[k + 1]], 1.0)
        if not begin < end:
            continue
        denied, ended = spanned - shown, _num_ended(cuts, is_outer, order, k, near, noise)
        if shown >= _MIN_IMAGES and denied < majority * shown and ended < most_ended * shown:
            if found and (bridged or begin - ends[found - 1] <= noise):
                ends[found - 1] = end
            else:
                begins[found], ends[found] = begin, end
                found += 1
            bridged = True
        else:
            bridged = bridged and shown > 0 and denied == 0
    return _of_some_length(begins, ends, found, noise)


@kernel
def _of_some_length(begins, ends, found, noise):
    """Drop intervals shorter than the noise of ends, and move the outermost ones to the ends of the line."""
    kept = 0
    for k in range(found):
        if ends[k] - begins[k] > noise:
            begins[kept], ends[kept] = begins[k], ends[k]
            kept += 1
    if kept:
        if begins[0] <= noise:
            begins[0] = 0.0
        if ends[kept - 1] >= 1.0 - noise:
            ends[kept - 1] = 1.0
    return kept


@loop
def _all_intervals(pointers, image, low, high, size, gates, begins, ends, count):
    """Loop of :func:`supported_intervals`."""
    for n in range(len(pointers) - 1):
        b, e = pointers[n], pointers[n + 1]
        if e > b:
            count[n] = _intervals(image[b:e], low[b:e], high[b:e], size[b:e], gates, begins[b:e], ends[b:e])


def supported_intervals(
    line_idx: IntArray, image_idx: IntArray, share: FloatArray, size: FloatArray, num_lines: int
) -> tuple[IntArray, FloatArray]:  # fmt: skip
    """Return the line (K,) and the shares (K, 2) of all supported intervals, in order; lines without any have none.

    Parameters
    ----------
    line_idx, image_idx : (N,) int
        Line and image of each observed segment.
    share : (N, 2) float64
        From where to where on its line the segment reaches, 0 at the first end of the line, 1 at the second.
    size : (N,) float64
        Length of a pixel along the line at each segment, in the same unit.
    num_lines : int
        Number of lines.
    """
    order = np.argsort(line_idx, kind="stable")
    pointers = np.searchsorted(line_idx[order], np.arange(num_lines + 1))
    begins, ends = np.zeros(len(order)), np.zeros(len(order))
    count = np.zeros(num_lines, np.int64)
    columns = [np.ascontiguousarray(column[order], np.float64) for column in (share[:, 0], share[:, 1], size)]
    image, gates = np.ascontiguousarray(image_idx[order]), (LINE_ENDS.same_end, LINE_ENDS.majority, GATES.ended)

    def fill(part: slice) -> None:
        _all_intervals(pointers[part.start : part.stop + 1], image, *columns, gates, begins, ends, count[part])

    map_ranges(fill, num_lines, _LINES_AT_ONCE)
    line, number = numbered(count)
    row = pointers[line] + number
    return line, np.column_stack([begins[row], ends[row]])
