# SPDX-License-Identifier: BSD-3-Clause
"""Order and median of numbers, and copies of rows, inside compiled loops.

In come numbers, none of them NaN; out comes the order that sorts them, equal ones as they came, or their median.
NumPy's functions do the same there, but Numba's versions of them take a second to compile, and again in each loop.
"""

from __future__ import annotations

import numpy as np

from groma._numba import kernel, loop


@kernel
def copy(source, out):
    """Copy a row; ``out[:] = source`` compares shapes, and compiles the words for when they differ."""
    for k in range(len(out)):
        out[k] = source[k]


@loop
def sort_by(values, order):
    """Sort indices (N,) by the values that they name, in place; where values are equal, they stay as they are."""
    count, width = len(order), 1
    merged = np.empty(count, np.int64)
    while width < count:
        for begin in range(0, count, 2 * width):
            middle, end = min(begin + width, count), min(begin + 2 * width, count)
            i, j = begin, middle
            for k in range(begin, end):
                if i < middle and (j == end or values[order[i]] <= values[order[j]]):
                    merged[k] = order[i]
                    i += 1
                else:
                    merged[k] = order[j]
                    j += 1
        for k in range(count):
            order[k] = merged[k]
        width *= 2


@loop
def ascending(values):
    """Return the indices (N,) that sort values."""
    order = np.empty(len(values), np.int64)
    for k in range(len(values)):
        order[k] = k
    sort_by(values, order)
    return order


@loop
def median(values):
    """Return the median of values (N,), at least one; by selection, in linear time."""
    count = len(values)
    left, half, low, high = np.empty(count), count // 2, 0, count - 1
    for k in range(count):
        left[k] = values[k]
    while low < high:
        pivot, i, j = left[(low + high) // 2], low, high
        while i <= j:
            while left[i] < pivot:
                i += 1
            while left[j] > pivot:
                j -= 1
            if i <= j:
                left[i], left[j] = left[j], left[i]
                i += 1
                j -= 1
        if half <= j:
            high = j
        elif half >= i:
            low = i
        else:
            break
    if count % 2:
        return left[half]
    below = left[0]
    for k in range(1, half):
        below = max(below, left[k])
    return 0.5 * (below + left[half])
