# SPDX-License-Identifier: BSD-3-Clause
"""Pairs of alike descriptors: each the best for the other, and clearly better than the second."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.gates import gate


@dataclass(frozen=True)
class MatchGates:
    """Which descriptors match."""

    ratio: float = gate(0.85, "1", "distance of the best over that of the second", "chosen on Strecha's scenes")
    distance: float = gate(0.8, "1", "largest distance of descriptors of length one", "chosen on Strecha's scenes")


MATCHES = MatchGates()
_Vectors = npt.NDArray[np.float32]


def match_descriptors(first: _Vectors, second: _Vectors, gates: MatchGates = MATCHES) -> IntArray:
    """Return pairs (m, 2) of rows of two sets of descriptors of length one."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.int64)
    alike = first @ second.T
    best = alike.argmax(axis=1)
    rows = np.arange(len(first))
    top = alike[rows, best].copy()
    mutual = alike.argmax(axis=0)[best] == rows
    rows = rows[mutual]
    alike[rows, best[rows]] = -1.0
    next_best = alike[rows].max(axis=1)
    far, farther = _distance(top[rows]), _distance(next_best)
    good = (far <= gates.distance) & (far <= gates.ratio * farther)
    return np.column_stack([rows[good], best[rows[good]]])


def _distance(product: npt.NDArray[np.float32]) -> FloatArray:
    return np.sqrt(np.maximum(2.0 - 2.0 * product.astype(np.float64), 0.0))


__all__ = ["MATCHES", "MatchGates", "match_descriptors"]
