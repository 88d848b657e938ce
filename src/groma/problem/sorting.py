# SPDX-License-Identifier: BSD-3-Clause
"""Linear-time sorting and lookups on index arrays, used once when a problem is laid out."""

from __future__ import annotations

import numpy as np

from groma._numba import kernel, loop
from groma._rows import pointers_of
from groma._typing import IntArray

# ---------------------------------------------------------------------------------------------------------- Kernels


@loop
def _counting_argsort(keys, num_keys, order, result):
    """Stable order of keys[order], or of keys where ``order`` is empty; one pass to count, one to place."""
    start = np.zeros(num_keys + 1, np.int64)
    for i in range(keys.shape[0]):
        start[keys[i] + 1] += 1
    for k in range(num_keys):
        start[k + 1] += start[k]
    given = order.shape[0] > 0
    for j in range(keys.shape[0]):
        i = order[j] if given else np.int32(j)
        k = keys[i]
        result[start[k]] = i
        start[k] += 1


@kernel
def _line_of(keys, row, column, num_columns):
    """Line of the hash table where a pair lies: the one that has its key, or the free one where it belongs.

    Eight neighbouring columns of a row share a line, because a landmark's cameras are often neighbours.
    """
    mask = keys.shape[0] - 1
    key = row * ((num_columns >> 3) + 1) + (column >> 3)
    h = ((((key ^ (key >> 31)) & 0x7FFFFFFF) * 0x4F6CDD1D) >> 17) & mask
    while keys[h] >= 0 and keys[h] != key:
        h = (h + 1) & mask
    return h


@loop
def _pair_slots(pointer_a, column_a, pointer_b, column_b, same, begin, pair_pointer, num_columns, keys, lines,
                first, second, slots, count, taken):  # fmt: skip
    """Slot of every pair of a row's columns; new pairs get the next free number.

    The columns are those of one class, pairs k <= l (``same``; both lists are then the same), or of two, b in the outer
    loop. Returns the row where the table was full, else the number of rows; the count; lines taken.
    """
    limit = first.shape[0]
    for p in range(begin, pointer_a.shape[0] - 1):
        s = pair_pointer[p]
        for k in range(pointer_b[p], pointer_b[p + 1]):
            for m in range(k if same else pointer_a[p], pointer_a[p + 1]):
                row, column = np.int64(column_a[m]), np.int64(column_b[k])
                if same:
                    row, column = column, row
                h = _line_of(keys, row, column, num_columns)
                if keys[h] < 0:
                    if 2 * taken >= keys.shape[0]:
                        return p, count, taken
                    keys[h] = row * ((num_columns >> 3) + 1) + (column >> 3)
                    taken += 1
                slot = lines[h, column & 7]
                if slot < 0:
                    if count == limit:
                        return p, count, taken
                    slot = count
                    lines[h, column & 7] = slot
                    first[count] = row
                    second[count] = column
                    count += 1
                slots[s] = slot
                s += 1
    return pointer_a.shape[0] - 1, count, taken


# ----------------------------------------------------------------------------------------------------------- Public


def argsort_by(keys: tuple[tuple[IntArray, int], ...], count: int) -> IntArray:
    """Return the stable order (count,) by several keys, the first the most significant.

    Each key is an array of integers in ``0..n-1`` with its ``n``; the cost is linear in ``count`` and in each ``n``.
    """
    order = np.empty(0, np.int32)
    for key, num_keys in reversed(keys):
        result = np.empty(count, np.int32)
        _counting_argsort(np.ascontiguousarray(key, np.int32), num_keys, order, result)
        order = result
    return order


def first_and_last(groups: IntArray, values: IntArray, num_groups: int, num_values: int) -> tuple[IntArray, IntArray]:
    """Return the smallest and the largest value of each group; groups without values get ``num_values - 1`` and 0."""
    first = np.full(num_groups, max(num_values - 1, 0), np.int32)
    last = np.zeros(num_groups, np.int32)
    np.minimum.at(first, groups, values)
    np.maximum.at(last, groups, values)
    return first, last


def distinct_pairs(groups: IntArray, values: IntArray, num_groups: int) -> tuple[IntArray, IntArray, IntArray]:
    """Number the distinct pairs of sorted input: slot of each entry, row pointer by group, value of each slot."""
    is_new = np.ones(len(groups), bool)
    is_new[1:] = (groups[1:] != groups[:-1]) | (values[1:] != values[:-1])
    slot = np.cumsum(is_new, dtype=np.int32)
    slot -= 1
    first = np.flatnonzero(is_new)
    pointer = pointers_of(np.bincount(groups[first], minlength=num_groups))
    return slot, pointer, values[first].astype(np.int32)


class PairTable:
    """Consecutive numbers for the block pairs (row, column) that occur, in the order of their first use.

    A hash table that grows, so that memory and time follow the pairs that occur and not all that are possible.
    """

    def __init__(self, num_rows: int, num_columns: int) -> None:
        self._num_columns = num_columns
        self._first = self._second = np.empty(0, np.int32)
        self.count = 0
        self._make(max(64, 8 * num_rows), max(64, 4 * num_rows))

    def _make(self, num_pairs: int, num_lines: int) -> None:
        """Make room for so many pairs, and for so many lines of the hash table; a power of two."""
        known = self.pairs()
        self._first, self._second = np.empty(num_pairs, np.int32), np.empty(num_pairs, np.int32)
        self.count = self._taken = 0
        num_lines = 1 << (num_lines - 1).bit_length()
        self._keys, self._lines = np.full(num_lines, -1, np.int64), np.full((num_lines, 8), -1, np.int32)
        if len(known[0]):
            self.add_list(*known)

    def add_list(self, rows: IntArray, columns: IntArray) -> IntArray:
        """Return the slot of each listed pair."""
        pointer = np.arange(len(rows) + 1)
        return self.add_cross(pointer, rows, pointer, columns)[0]

    def add_pairs(self, pointer: IntArray, column: IntArray) -> tuple[IntArray, IntArray]:
        """Return (slots, pointer) of all pairs k <= l within each row of a compressed list."""
        length = np.diff(pointer)
        return self._add(pointer, column, pointer, column, length * (length + 1) // 2, True)

    def add_cross(
        self, pointer_a: IntArray, column_a: IntArray, pointer_b: IntArray, column_b: IntArray
    ) -> tuple[IntArray, IntArray]:
        """Return (slots, pointer) of all pairs between the rows of two compressed lists."""
        return self._add(pointer_a, column_a, pointer_b, column_b, np.diff(pointer_a) * np.diff(pointer_b), False)

    def _add(
        self, pointer_a: IntArray, column_a: IntArray, pointer_b: IntArray, column_b: IntArray, lengths: IntArray,
        same: bool,
    ) -> tuple[IntArray, IntArray]:  # fmt: skip
        pair_pointer = pointers_of(lengths)
        slots = np.empty(pair_pointer[-1], np.int32)
        done = 0
        while done < len(lengths):
            done, self.count, self._taken = _pair_slots(
                pointer_a, column_a, pointer_b, column_b, same, done, pair_pointer, self._num_columns, self._keys,
                self._lines, self._first, self._second, slots, self.count, self._taken,
            )  # fmt: skip
            if done < len(lengths):
                full = self.count == len(self._first)
                crowded = 2 * self._taken >= len(self._keys)
                self._make(len(self._first) * (2 if full else 1), len(self._keys) * (2 if crowded else 1))
        return slots, pair_pointer

    def pairs(self) -> tuple[IntArray, IntArray]:
        """Return (rows, columns) of the slots, in slot order."""
        return self._first[: self.count].copy(), self._second[: self.count].copy()
