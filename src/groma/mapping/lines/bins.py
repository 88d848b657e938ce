# SPDX-License-Identifier: BSD-3-Clause
"""Which intervals cover each bin of an axis, or of a circle: what may overlap has a bin in common."""

from __future__ import annotations

import numpy as np

from groma._numba import loop
from groma._typing import FloatArray, IntArray


@loop
def _fill(intervals, size, pointers, members):
    """Write the members of every bin; where there is no room, the pointers to them."""
    num_bins = len(pointers) - 1
    fill = np.zeros(num_bins, np.int64)
    for j in range(len(intervals)):
        low, high = int(np.floor(intervals[j, 0] / size)), int(np.floor(intervals[j, 1] / size))
        for k in range(low, min(high, low + num_bins - 1) + 1):
            b = k % num_bins
            if len(members):
                members[pointers[b] + fill[b]] = j
            fill[b] += 1
    if not len(members):
        for b in range(num_bins):
            pointers[b + 1] = pointers[b] + fill[b]


def in_bins(intervals: FloatArray, size: float, num_bins: int) -> tuple[IntArray, IntArray]:
    """Return the intervals of every bin, in their order, and pointers (num_bins + 1,) to those of each.

    Parameters
    ----------
    intervals : (N, 2) or wider float64
        Where intervals begin and end; what reaches beyond the last bin goes on in the first.
    size : float
        Size of a bin.
    num_bins : int
        Number of bins, from zero on.
    """
    pointers = np.zeros(num_bins + 1, np.int64)
    _fill(intervals, size, pointers, np.empty(0, np.int64))
    members = np.empty(pointers[-1], np.int64)
    if len(members):
        _fill(intervals, size, pointers, members)
    return members, pointers
