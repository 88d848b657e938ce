# SPDX-License-Identifier: BSD-3-Clause
"""Linear-time sorting and lookups on index arrays, used once when a problem is laid out."""

from __future__ import annotations

import numpy as np

from groma._numba import loop
from groma._typing import IntArray

# ---------------------------------------------------------------------------------------------------------- Kernels


@loop
def _counting_argsort(keys, num_keys, order, result):
    """Stable order of keys[order]; one pass to count, one to place."""
    start = np.zeros(num_keys + 1, np.int64)
    for i in range(keys.shape[0]):
        start[keys[i] + 1] += 1
    for k in range(num_keys):
        start[k + 1] += start[k]
    for j in range(order.shape[0]):
        i = order[j]
        k = keys[i]
        result[start[k]] = i
        start[k] += 1


@loop
def _first_and_last(groups, values, first, last):
    for i in range(groups.shape[0]):
        g, v = groups[i], values[i]
        if v < first[g]:
            first[g] = v
        if v > last[g]:
            last[g] = v


@loop
def _merge_runs(groups, values, slot, pointer, value_of_slot):
    """Number the distinct (group, value) pairs of input sorted by both; return how many there are."""
    count = 0
    previous_group, previous_value = -1, -1
    for i in range(groups.shape[0]):
        g, v = np.int64(groups[i]), np.int64(values[i])
        if g != previous_group or v != previous_value:
            value_of_slot[count] = v
            pointer[g + 1] += 1
            count += 1
            previous_group, previous_value = g, v
        slot[i] = count - 1
    for g in range(pointer.shape[0] - 1):
        pointer[g + 1] += pointer[g]
    return count


@loop
def _pair_slots(pointer, column, pair_pointer, table, slots, count):
    """Slot of every pair k <= l of a row's columns; new pairs get the next free number."""
    for p in range(pointer.shape[0] - 1):
        s = pair_pointer[p]
        for k in range(pointer[p], pointer[p + 1]):
            for m in range(k, pointer[p + 1]):
                t = table[column[k], column[m]]
                if t < 0:
                    t = count
                    table[column[k], column[m]] = t
                    count += 1
                slots[s] = t
                s += 1
    return count


@loop
def _cross_slots(pointer_a, column_a, pointer_b, column_b, pair_pointer, table, slots, count):
    """Slot of every pair (a, b) of a row's columns in two classes; b is the outer loop."""
    for p in range(pointer_a.shape[0] - 1):
        s = pair_pointer[p]
        for k in range(pointer_b[p], pointer_b[p + 1]):
            for m in range(pointer_a[p], pointer_a[p + 1]):
                t = table[column_a[m], column_b[k]]
                if t < 0:
                    t = count
                    table[column_a[m], column_b[k]] = t
                    count += 1
                slots[s] = t
                s += 1
    return count


@loop
def _list_slots(first, second, table, slots, count):
    """Slot of each listed pair (first, second)."""
    for i in range(first.shape[0]):
        t = table[first[i], second[i]]
        if t < 0:
            t = count
            table[first[i], second[i]] = t
            count += 1
        slots[i] = t
    return count


# ----------------------------------------------------------------------------------------------------------- Public


def argsort_by(keys: tuple[tuple[IntArray, int], ...], count: int) -> IntArray:
    """Return the stable order (count,) by several keys, the first the most significant.

    Each key is an array of integers in ``0..n-1`` with its ``n``; the cost is linear in ``count`` and in each ``n``.
    """
    order = np.arange(count, dtype=np.int64)
    for key, num_keys in reversed(keys):
        result = np.empty(count, np.int64)
        _counting_argsort(key, num_keys, order, result)
        order = result
    return order


def first_and_last(groups: IntArray, values: IntArray, num_groups: int, num_values: int) -> tuple[IntArray, IntArray]:
    """Return the smallest and the largest value of each group; groups without values get ``num_values - 1`` and 0."""
    first = np.full(num_groups, max(num_values - 1, 0), np.int32)
    last = np.zeros(num_groups, np.int32)
    _first_and_last(groups, values, first, last)
    return first, last


def distinct_pairs(groups: IntArray, values: IntArray, num_groups: int) -> tuple[IntArray, IntArray, IntArray]:
    """Number the distinct pairs of sorted input: slot of each entry, row pointer by group, value of each slot."""
    slot = np.empty(len(groups), np.int64)
    pointer = np.zeros(num_groups + 1, np.int64)
    value_of_slot = np.empty(len(groups), np.int32)
    count = _merge_runs(groups, values, slot, pointer, value_of_slot)
    return slot, pointer, value_of_slot[:count].copy()


class PairTable:
    """Consecutive numbers for the block pairs (row, column) that occur, in the order of their first use."""

    def __init__(self, num_rows: int, num_columns: int) -> None:
        self._table = np.full((num_rows, num_columns), -1, np.int32)
        self.count = 0

    def add_list(self, rows: IntArray, columns: IntArray) -> IntArray:
        """Return the slot of each listed pair."""
        slots = np.empty(len(rows), np.int32)
        self.count = _list_slots(rows, columns, self._table, slots, self.count)
        return slots

    def add_pairs(self, pointer: IntArray, column: IntArray) -> tuple[IntArray, IntArray]:
        """Return (slots, pointer) of all pairs k <= l within each row of a compressed list."""
        length = np.diff(pointer)
        pair_pointer = np.concatenate([[0], np.cumsum(length * (length + 1) // 2)])
        slots = np.empty(pair_pointer[-1], np.int32)
        self.count = _pair_slots(pointer, column, pair_pointer, self._table, slots, self.count)
        return slots, pair_pointer

    def add_cross(
        self, pointer_a: IntArray, column_a: IntArray, pointer_b: IntArray, column_b: IntArray
    ) -> tuple[IntArray, IntArray]:
        """Return (slots, pointer) of all pairs between the rows of two compressed lists."""
        pair_pointer = np.concatenate([[0], np.cumsum(np.diff(pointer_a) * np.diff(pointer_b))])
        slots = np.empty(pair_pointer[-1], np.int32)
        self.count = _cross_slots(
            pointer_a, column_a, pointer_b, column_b, pair_pointer, self._table, slots, self.count
        )
        return slots, pair_pointer

    def pairs(self) -> tuple[IntArray, IntArray]:
        """Return (rows, columns) of the slots, in slot order."""
        rows, columns = np.nonzero(self._table >= 0)
        order = np.argsort(self._table[rows, columns])
        return rows[order].astype(np.int32), columns[order].astype(np.int32)
