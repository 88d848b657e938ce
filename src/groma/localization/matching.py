# SPDX-License-Identifier: BSD-3-Clause
"""Pairs of alike descriptors: each the best for the other, and clearly better than the second; or near a place."""

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
#: Rows and columns that are compared at a time: their products stay in the cache (cost: the result does not depend on
#: it).
_ROWS, _COLUMNS = 128, 2048
Vectors = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]


# ---------------------------------------------------------------------------------------------------------- Kernels
@loop
def _compare(alike, row, column, best, top, second, column_top, column_best):
    """Best and second best so far of each row of a block, and the best so far of each column."""
    for i in range(alike.shape[0]):
        one, two, at = top[row + i], second[row + i], best[row + i]
        for j in range(alike.shape[1]):
            value = alike[i, j]
            if value > two:
                if value > one:
                    one, two, at = value, one, column + j
                else:
                    two = value
            if value > column_top[column + j]:
                column_top[column + j], column_best[column + j] = value, row + i
        best[row + i], top[row + i], second[row + i] = at, one, two


@loop
def _near(
    expected,
    first,
    first_length,
    cell_begin,
    cell_point,
    cells,
    reach,
    pixels,
    second,
    second_length,
    least,
    rows,
    columns,
    distance,
):
    """Pairs of places and pixels within a reach whose descriptors' cosine is large enough.

    The number of them that is returned may be more than the arrays hold.
    """
    count = 0
    for i in range(expected.shape[0]):
        u, v = expected[i, 0], expected[i, 1]
        column, row = int(np.floor(u / reach)) + 1, int(np.floor(v / reach)) + 1
        for y in range(max(row - 1, 0), min(row + 2, cells[1])):
            for x in range(max(column - 1, 0), min(column + 2, cells[0])):
                for at in range(cell_begin[y * cells[0] + x], cell_begin[y * cells[0] + x + 1]):
                    k = cell_point[at]
                    if (pixels[k, 0] - u) ** 2 + (pixels[k, 1] - v) ** 2 > reach * reach:
                        continue
                    product = np.int32(0)
                    for j in range(first.shape[1]):
                        product += np.int32(first[i, j]) * np.int32(second[k, j])
                    cosine = product / (first_length[i] * second_length[k])
                    if cosine < least:
                        continue
                    if count < rows.shape[0]:
                        rows[count], columns[count] = i, k
                        distance[count] = np.sqrt(max(2.0 - 2.0 * cosine, 0.0))
                    count += 1
    return count


# ----------------------------------------------------------------------------------------------------------- Public
def match_descriptors(first: Vectors, second: Vectors, gates: MatchGates = MATCHES) -> IntArray:
    """Return pairs (m, 2) of rows of two sets of descriptors of length one."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.int64)
    best, column_best = np.zeros(len(first), np.int64), np.zeros(len(second), np.int64)
    top, next_best = np.full((2, len(first)), -2.0, np.float32)
    column_top = np.full(len(second), -2.0, np.float32)
    for row in range(0, len(first), _ROWS):
        for column in range(0, len(second), _COLUMNS):
            alike = first[row : row + _ROWS] @ second[column : column + _COLUMNS].T
            _compare(alike, row, column, best, top, next_best, column_top, column_best)
    rows = np.flatnonzero(column_best[best] == np.arange(len(first)))
    far, farther = _distance(top[rows]), _distance(next_best[rows])
    good = (far <= gates.distance) & (far <= gates.ratio * farther)
    return np.column_stack([rows[good], best[rows[good]]])


def pairs_near(
    expected: FloatArray, first: Bytes, pixels: FloatArray, second: Bytes, reach: float, gates: MatchGates = MATCHES
) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs of descriptors that are alike, of places that are expected (n, 2) near pixels (m, 2) of an image.

    Returns
    -------
    (k,) int, (k,) int, (k,) float
        Rows of both, and the distances of the descriptors as vectors of length one.
    """
    low = pixels.min(axis=0)
    here, there = expected - low, np.ascontiguousarray(pixels - low)
    cell = np.floor(there / reach).astype(np.int64) + 1
    cells = cell.max(axis=0) + 2
    number = cell[:, 1] * cells[0] + cell[:, 0]
    order = np.argsort(number, kind="stable")
    begin = np.searchsorted(number[order], np.arange(int(cells[0] * cells[1]) + 1))
    lengths = [
        np.maximum(np.linalg.norm(one.astype(np.float32), axis=1), 1e-6).astype(np.float64) for one in (first, second)
    ]
    least, room = 1.0 - 0.5 * gates.distance**2, 4 * len(here)
    while True:
        rows, columns, far = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room)
        count = _near(
            np.ascontiguousarray(here), first, lengths[0], begin, order, cells, reach, there, second, lengths[1], least,
            rows, columns, far,
        )  # fmt: skip
        if count <= room:
            return rows[:count], columns[:count], far[:count]
        room = count


def _distance(product: npt.NDArray[np.float32]) -> FloatArray:
    return np.sqrt(np.maximum(2.0 - 2.0 * product.astype(np.float64), 0.0))


__all__ = ["MATCHES", "Bytes", "MatchGates", "Vectors", "match_descriptors", "pairs_near"]
