# SPDX-License-Identifier: BSD-3-Clause
"""Pairs of alike descriptors: each the best for the other, and clearly better than the second; or near a place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._numba import loop, unrolled_loop
from groma._rows import distinct, pointers_of
from groma._typing import FloatArray, IntArray
from groma.execution import map_ranges
from groma.gates import gate


@dataclass(frozen=True)
class MatchGates:
    """Which descriptors match."""

    ratio: float = gate(0.85, "1", "distance of the best over that of the second", "chosen on Strecha's scenes")
    distance: float = gate(0.8, "1", "largest distance of descriptors of length one", "chosen on Strecha's scenes")


MATCHES = MatchGates()
#: Rows that one thread compares, and rows and columns that are compared at a time (cost: the result does not depend on
#: them).
_OF_THREAD, _ROWS, _COLUMNS = 1024, 256, 512
Vectors = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]


# ---------------------------------------------------------------------------------------------------------- Kernels
@loop
def _compare_far(alike, row, column, places, pixels, square, top):
    """The best so far of each row of a block among pixels that are farther from its place than some distance."""
    for i in range(alike.shape[0]):
        one, u, v = top[row + i], places[row + i, 0], places[row + i, 1]
        for begin in range(0, alike.shape[1], 64):
            end = min(begin + 64, alike.shape[1])
            more = np.int32(0)
            for j in range(begin, end):
                more += np.int32(alike[i, j] > one)
            if more == 0:
                continue
            for j in range(begin, end):
                away = (pixels[column + j, 0] - u) ** 2 + (pixels[column + j, 1] - v) ** 2
                if alike[i, j] > one and away > square:
                    one = alike[i, j]
        top[row + i] = one


@unrolled_loop
def _lengths(descriptors, out):
    for i in range(descriptors.shape[0]):
        square = np.int32(0)
        for j in range(descriptors.shape[1]):
            square += np.int32(descriptors[i, j]) * np.int32(descriptors[i, j])
        out[i] = max(np.sqrt(np.float64(square)), 1e-6)


@unrolled_loop
def _near(
    expected,
    rows_of_first,
    first,
    first_length,
    cell_begin,
    cell_point,
    cells,
    side,
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
        u, v, own = expected[i, 0], expected[i, 1], rows_of_first[i]
        right = max(min(int(np.floor((u + reach) / side)) + 2, cells[0]), 0)
        left = min(max(int(np.floor((u - reach) / side)) + 1, 0), right)
        top, bottom = int(np.floor((v - reach) / side)) + 1, int(np.floor((v + reach) / side)) + 2
        for y in range(max(top, 0), min(bottom, cells[1])):
            for at in range(cell_begin[y * cells[0] + left], cell_begin[y * cells[0] + right]):
                k = cell_point[at]
                if (pixels[k, 0] - u) ** 2 + (pixels[k, 1] - v) ** 2 > reach * reach:
                    continue
                product = np.int32(0)
                for j in range(first.shape[1]):
                    product += np.int32(first[own, j]) * np.int32(second[k, j])
                cosine = product / (first_length[own] * second_length[k])
                if cosine < least:
                    continue
                if count < rows.shape[0]:
                    rows[count], columns[count] = i, k
                    distance[count] = np.sqrt(max(2.0 - 2.0 * cosine, 0.0))
                count += 1
    return count


# ----------------------------------------------------------------------------------------------------------- Public
def match_descriptors(first: Vectors, second: Vectors) -> IntArray:
    """Return pairs (m, 2) of rows of two sets of descriptors of length one."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.int64)
    best, far, farther = _nearest_two(first, second)
    rows = np.flatnonzero((far <= MATCHES.distance) & (far <= MATCHES.ratio * farther))
    columns, which = distinct(best[rows], len(second))
    mutual = _nearest_two(second[columns], first)[0][which] == rows
    return np.column_stack([rows[mutual], best[rows[mutual]]])


def _nearest_two(first: Vectors, second: Vectors) -> tuple[IntArray, FloatArray, FloatArray]:
    """The nearest of a second set of vectors for each of a first one, its distance, and that of the next."""
    best, top = np.empty(len(first), np.int64), np.empty((2, len(first)), np.float32)

    def compare(part: slice) -> None:
        products = np.empty((_ROWS, len(second)), np.float32)  # new memory for each block takes longer than they do
        for row in range(part.start, part.stop, _ROWS):
            rows = slice(row, min(row + _ROWS, part.stop))
            alike = np.matmul(first[rows], second.T, out=products[: rows.stop - row])
            best[rows] = alike.argmax(axis=1)
            at = np.arange(len(alike)), best[rows]
            top[0, rows], alike[at] = alike[at], -2.0
            top[1, rows] = alike.max(axis=1)

    map_ranges(compare, len(first), _OF_THREAD)
    return best, *_distance(top)


def alike_elsewhere(
    first: Vectors, places: FloatArray, second: Vectors, pixels: FloatArray, beyond: float
) -> FloatArray:
    """Distances (n,) from descriptors of length one to the most alike in an image that are farther from where it would
    see them than so many pixels; two where there is none.

    Parameters
    ----------
    first, places : (n, 128), (n, 2)
        Descriptors, and where the image would see them; infinite where it would not.
    second, pixels : (m, 128), (m, 2)
        Of the image.
    beyond
        Distance of another place, pixels.
    """
    top = np.full(len(first), -1.0, np.float32)
    for row in range(0, len(first), _ROWS):
        for column in range(0, len(second), _COLUMNS):
            alike = first[row : row + _ROWS] @ second[column : column + _COLUMNS].T
            _compare_far(alike, row, column, places, pixels, beyond**2, top)
    return _distance(top)


def lengths_of(descriptors: Bytes) -> FloatArray:
    """Lengths (n,) of descriptors."""
    out = np.empty(len(descriptors))
    _lengths(descriptors, out)
    return out


def pairs_near(
    expected: FloatArray,
    rows_of_first: IntArray,
    first: tuple[Bytes, FloatArray],
    pixels: FloatArray,
    second: Bytes,
    reach: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs of descriptors that are alike, of places that are expected near pixels of an image.

    Parameters
    ----------
    expected, rows_of_first : (n, 2), (n,)
        Places, and their rows in ``first``.
    first : (F, 128), (F,)
        Descriptors and their lengths.
    pixels, second : (m, 2), (m, 128)
        Of the image.
    reach
        Distance that is near, pixels.

    Returns
    -------
    (k,) int, (k,) int, (k,) float
        Rows of both, and the distances of the descriptors as vectors of length one.
    """
    low, side = pixels.min(axis=0), 2.0 * reach
    here, there = expected - low, np.ascontiguousarray(pixels - low)
    cell = np.floor(there / side).astype(np.int64) + 1
    cells = cell.max(axis=0) + 2
    number = cell[:, 1] * cells[0] + cell[:, 0]
    order = np.argsort(number, kind="stable")
    begin = pointers_of(np.bincount(number, minlength=int(cells[0] * cells[1])))
    least, room = 1.0 - 0.5 * MATCHES.distance**2, 4 * len(here)
    while True:
        rows, columns, far = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room)
        count = _near(
            np.ascontiguousarray(here), rows_of_first, *first, begin, order, cells, side, reach, there, second,
            lengths_of(second), least, rows, columns, far,
        )  # fmt: skip
        if count <= room:
            return rows[:count], columns[:count], far[:count]
        room = count


def _distance(product: npt.NDArray[np.float32]) -> FloatArray:
    return np.sqrt(np.maximum(2.0 - 2.0 * product.astype(np.float64), 0.0))
