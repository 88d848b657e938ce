# SPDX-License-Identifier: BSD-3-Clause
"""Pairs of alike descriptors: each the best for the other, and clearly better than the second."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._numba import loop
from groma._typing import FloatArray, IntArray
from groma.gates import gate


@dataclass(frozen=True)
class MatchGates:
    """Which descriptors match."""

    ratio: float = gate(0.85, "1", "distance of the best over that of the second", "chosen on Strecha's scenes")
    distance: float = gate(0.8, "1", "largest distance of descriptors of length one", "chosen on Strecha's scenes")


MATCHES = MatchGates()
#: Rows that are compared at a time.
_BLOCK = 256
_Vectors = npt.NDArray[np.float32]


# ---------------------------------------------------------------------------------------------------------- Kernels
@loop
def _compare(alike, start, best, top, second, column_top, column_best):
    """Best and second best column of each row of a block, and the best row so far of each column."""
    for i in range(alike.shape[0]):
        one, two, at = np.float32(-2.0), np.float32(-2.0), 0
        for j in range(alike.shape[1]):
            value = alike[i, j]
            if value > two:
                if value > one:
                    one, two, at = value, one, j
                else:
                    two = value
            if value > column_top[j]:
                column_top[j], column_best[j] = value, start + i
        best[start + i], top[start + i], second[start + i] = at, one, two


# ----------------------------------------------------------------------------------------------------------- Public
def match_descriptors(first: _Vectors, second: _Vectors, gates: MatchGates = MATCHES) -> IntArray:
    """Return pairs (m, 2) of rows of two sets of descriptors of length one."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.int64)
    best, column_best = np.zeros(len(first), np.int64), np.zeros(len(second), np.int64)
    top, next_best = np.zeros((2, len(first)), np.float32)
    column_top = np.full(len(second), -2.0, np.float32)
    for start in range(0, len(first), _BLOCK):  # products of a block stay in the cache
        alike = first[start : start + _BLOCK] @ second.T
        _compare(alike, start, best, top, next_best, column_top, column_best)
    rows = np.flatnonzero(column_best[best] == np.arange(len(first)))
    far, farther = _distance(top[rows]), _distance(next_best[rows])
    good = (far <= gates.distance) & (far <= gates.ratio * farther)
    return np.column_stack([rows[good], best[rows[good]]])


def _distance(product: npt.NDArray[np.float32]) -> FloatArray:
    return np.sqrt(np.maximum(2.0 - 2.0 * product.astype(np.float64), 0.0))


__all__ = ["MATCHES", "MatchGates", "match_descriptors"]
