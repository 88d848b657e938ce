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
    """Join the segments of one image across gaps within the noise of ends; return image, start, end of each piece."""
    count = len(image)
    owner, first, last = np.empty(count, np.int64), np.empty(count), np.empty(count)
    order = np.empty(count, np.int64)
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
    for k in order:
        if found and owner[found - 1] == image[k] and low[k] <= last[found - 1] + same_end * size[k]:
            last[found - 1] = max(last[found - 1], high[k])
        else:
            owner[found], first[found], last[found] = image[k], low[k], high[k]
            found += 1
    return owner[:found], first[:found], last[:found]


@kernel
def _votes(owner, first, last, place):
    """Count the images that show a place, and those that deny it; pieces come by image."""
    shown = denied = 0
    k = 0
    while k < len(owner):
        here = before = after = False
        begin = k
        while k < len(owner) and owner[k] == owner[begin]:
            here = here or (first[k] <= place and place <= last[k])
            before = before or last[k] < place
            after = after or first[k] > place
            k += 1
        if here:
            shown += 1
        elif before and after:
            denied += 1
    return shown, denied


@kernel
def _num_ended(owner, first, last, place, noise):
    """Count the images that show a line on one side of a place only and end at the same place, the most that do."""
    ends = np.empty(len(owner))
    found = k = 0
    while k < len(owner):
        low, high = first[k], last[k]
        begin = k
        while k < len(owner) and owner[k] == owner[begin]:
            low, high = min(low, first[k]), max(high, last[k])
            k += 1
        if high < place:
            ends[found] = high
            found += 1
        elif low > place:
            ends[found] = low
            found += 1
    order = ascending(ends[:found])
    most = start = 0
    for k in range(found):
        while ends[order[k]] - ends[order[start]] > 2.0 * noise:
            start += 1
        most = max(most, k - start + 1)
    return most


@kernel
def _intervals(image, low, high, size, gates, begins, ends):
    """Write the supported intervals of a line between 0 and 1; return their number."""
    same_end, majority, most_ended = gates
    owner, first, last = _joined(image, low, high, size, same_end)
    noise = same_end * median(size)
    cuts = np.empty(2 * len(first))
    for k in range(len(first)):
        cuts[2 * k], cuts[2 * k + 1] = first[k], last[k]
    order = ascending(cuts)
    found, bridged = 0, False
    for k in range(len(cuts) - 1):
        begin, end = max(cuts[order[k]], 0.0), min(cuts[order[k + 1]], 1.0)
        if not begin < end:
            continue
        shown, denied = _votes(owner, first, last, 0.5 * (begin + end))
        ended = _num_ended(owner, first, last, 0.5 * (begin + end), noise)
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
