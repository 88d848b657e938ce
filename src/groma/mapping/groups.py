# SPDX-License-Identifier: BSD-3-Clause
"""Rows grouped by their owner, and distinct pairs: sorting one key is many times faster than sorting rows."""

from __future__ import annotations

import numpy as np

from groma._rows import pointers_of
from groma._typing import IntArray
from groma.problem.sorting import argsort_by


def grouped(owner: IntArray, count: int) -> tuple[IntArray, IntArray]:
    """Rows (N,) sorted by their owner, stably, and pointers (count + 1,) to those of each owner."""
    order = argsort_by(((owner, count),), len(owner))
    return order, pointers_of(np.bincount(owner, minlength=count))


def distinct_pairs(first: IntArray, second: IntArray) -> tuple[IntArray, IntArray]:
    """Distinct pairs (M, 2) of numbers from zero, sorted by the first and then by the second, and their counts (M,)."""
    size = np.int64(second.max(initial=0)) + 1
    keys, counts = np.unique(first.astype(np.int64) * size + second, return_counts=True)
    return np.column_stack([keys // size, keys % size]), counts


def num_distinct(owner: IntArray, member: IntArray, count: int) -> IntArray:
    """(count,) how many different members each owner has, such as the images that see a landmark."""
    pairs, _ = distinct_pairs(owner, member)
    return np.bincount(pairs[:, 0], minlength=count)
