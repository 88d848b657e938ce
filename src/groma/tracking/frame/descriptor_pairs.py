# SPDX-License-Identifier: BSD-3-Clause
"""Pair described features by the bits in which their descriptors differ: anywhere, or near an expected place.

In come binary descriptors of both, and places; out come pairs that are most alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._numba import kernel, loop, unrolled_loop
from groma._rows import pointers_of
from groma._typing import FloatArray, IntArray

#: Width of the cells into which features are sorted, pixels (cost: number of comparisons).
CELL = 16.0

# ------------------------------------------------------------------------------------------------------------ Kernels


@kernel
def _count_bits(x):
    """Return the number of ones of a uint64; the compiler knows this form as one instruction."""
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))


@loop
def _best_near(expected, first, pixel, second, order, begin, columns, cell, radius, max_bits, partner, bits, distance):
    """Write the best partner of each of both sides, or -1, with its bits and squared distance.

    The rows of ``pixel`` and ``second`` are sorted into the cells of a grid with so many ``columns``; those of cell k
    begin at ``begin[k]``. ``order`` has their numbers, which ``partner`` is about; of rows that are as good the least
    counts. ``partner``, ``bits`` and ``distance`` hold first, then second.
    """
    count, rows = expected.shape[0], (begin.shape[0] - 1) // columns
    for i in range(count):
        u, v = expected[i, 0], expected[i, 1]
        if not (v + radius >= 0.0 and v - radius < rows * cell and u + radius >= 0.0 and u - radius < columns * cell):
            continue
        a, b, c, d = first[i, 0], first[i, 1], first[i, 2], first[i, 3]
        left, right = max(int((u - radius) / cell), 0), min(int((u + radius) / cell) + 1, columns)
        for k in range(max(int((v - radius) / cell), 0), min(int((v + radius) / cell) + 1, rows)):
            for j in range(begin[k * columns + left], begin[k * columns + right]):
                apart = (pixel[j, 0] - u) ** 2 + (pixel[j, 1] - v) ** 2
                if apart > radius * radius:
                    continue
                differ = (
                    _count_bits(second[j, 0] ^ a)
                    + _count_bits(second[j, 1] ^ b)
                    + _count_bits(second[j, 2] ^ c)
                    + _count_bits(second[j, 3] ^ d)
                )
                if differ > max_bits:
                    continue
                number = order[j]
                for one, other in ((i, number), (count + number, i)):
                    best = partner[one]
                    if best >= 0 and (differ > bits[one] or (differ == bits[one] and apart > distance[one])):
                        continue
                    if best < 0 or differ < bits[one] or apart < distance[one] or other < best:
                        partner[one], bits[one], distance[one] = other, differ, apart


@unrolled_loop
def _best_anywhere(words, second, max_bits, partner, bits):
    """Write for each of first (its ``words`` in columns) the nearest of second, or -1 if that has a nearer one.

    All bits of a row are counted before any are compared, and without branches: so the compiler takes several at once.
    """
    count = words.shape[1]
    one, two, three, four = words[0], words[1], words[2], words[3]
    differ, nearest = np.empty(count, np.int64), np.full(len(second), -1)
    for i in range(second.shape[0]):
        a, b, c, d = second[i, 0], second[i, 1], second[i, 2], second[i, 3]
        least = np.int64(max_bits + 1)
        for j in range(count):
            n = _count_bits(one[j] ^ a) + _count_bits(two[j] ^ b) + _count_bits(three[j] ^ c) + _count_bits(four[j] ^ d)
            differ[j], least = n, min(least, n)
        if least > max_bits:
            continue
        for j in range(count):
            nearer = differ[j] < bits[j]
            partner[j], bits[j] = i if nearer else partner[j], differ[j] if nearer else bits[j]
        nearest[i] = 0
        while differ[nearest[i]] != least:
            nearest[i] += 1
    for j in range(count):
        if partner[j] >= 0 and nearest[partner[j]] != j:
            partner[j] = -1


# ------------------------------------------------------------------------------------------------------------- Public


def pair_anywhere(first: np.ndarray, second: np.ndarray, max_bits: int) -> tuple[IntArray, IntArray]:
    """Pair descriptors that are nearest to each other, both ways; the first of those that are as near.

    Parameters
    ----------
    first, second : (n, 32), (m, 32) uint8
        Descriptors.
    max_bits : int
        Most bits in which two descriptors differ.

    Returns
    -------
    (k,), (k,) int
        Rows of both, in the order of the first.
    """
    partner, bits = np.full(len(first), -1), np.full(len(first), int(max_bits) + 1)
    words = [np.ascontiguousarray(table).view(np.uint64) for table in (first, second)]
    _best_anywhere(np.ascontiguousarray(words[0].T), words[1], int(max_bits), partner, bits)
    rows = np.flatnonzero(partner >= 0)
    return rows, partner[rows]


@dataclass(frozen=True)
class PlacedFeatures:
    """Described features of an image, sorted into the cells of a grid, row by row."""

    #: (m, 2) pixels, (m, 4) words of descriptors, (m,) their numbers, (cells + 1,) starts of the cells, and the number
    #: of cells in a row.
    pixel: FloatArray
    words: np.ndarray
    number: IntArray
    begin: IntArray
    columns: int

    @classmethod
    def of(cls, pixel: FloatArray, descriptor: np.ndarray) -> PlacedFeatures:
        """Sort features: pixels (m, 2), not negative, and descriptors (m, 32) uint8."""
        column, row = (pixel / CELL).astype(np.int64).T
        columns = int(column.max(initial=0)) + 1
        cell = row * columns + column
        order = np.argsort(cell, kind="stable")
        begin = pointers_of(np.bincount(cell, minlength=(row.max(initial=-1) + 1) * columns))
        return cls(pixel[order], descriptor[order].view(np.uint64), order, begin, columns)


def pair_near(
    expected: FloatArray, descriptor: np.ndarray, features: PlacedFeatures, radius: float, max_bits: int
) -> IntArray:
    """Pair features with others near where they are expected: the most alike for both, the nearest among equals.

    Parameters
    ----------
    expected : (n, 2)
        Where features are expected, pixels; NaN where nowhere.
    descriptor : (n, 32) uint8
        Their descriptors.
    features
        The others.
    radius : float
        Largest distance, pixels.
    max_bits : int
        Most bits in which two descriptors differ.

    Returns
    -------
    (k, 2) int
        Rows of the pairs, the most alike first.
    """
    n, m = len(expected), len(features.number)
    partner, bits, distance = np.full(n + m, -1), np.zeros(n + m, np.int64), np.zeros(n + m)
    _best_near(
        np.ascontiguousarray(expected), np.ascontiguousarray(descriptor).view(np.uint64), features.pixel,
        features.words, features.number, features.begin, features.columns, CELL, float(radius), int(max_bits),
        partner, bits, distance,
    )  # fmt: skip
    rows = np.flatnonzero(partner[:n] >= 0)
    rows = rows[partner[n + partner[rows]] == rows]
    rows = rows[np.lexsort((distance[rows], bits[rows]))]
    return np.column_stack([rows, partner[rows]])
