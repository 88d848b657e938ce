# SPDX-License-Identifier: BSD-3-Clause
r"""The least determined directions of cameras, planes, directions and calibrations.

Points and lines that the reduced system keeps, because they are tied to landmarks that are eliminated, are not asked
for here: those that share no block with each other are eliminated as well. What is left is small in most scenes, and
then its eigenvalues are found all at once; else the smallest by inverse iteration with a sparse factorisation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.problem.layout import Layout
from groma.solver.linear.blocks import Blocks
from groma.solver.linear.fronts import Fronts
from groma.solver.linear.modes import MODES, SHIFT, Modes, smallest

if TYPE_CHECKING:
    from scipy.sparse import csc_array, csr_array

#: Maximum number of unknowns of systems that are decomposed completely (cost: time alone).
DENSE = 300
#: Directions of a landmark whose scaled information is below this share of the largest are left alone.
LANDMARK_TOLERANCE = 1e-11
#: Weight of coordinates that are held, where they cannot be taken out.
HOLD = 1e4
#: A scaled system with a smaller eigenvalue than minus this is spoilt by rounding.
NEGATIVE = 1e-6


def weak_modes(layout: Layout, S: Blocks, size: FloatArray, G: FloatArray) -> Modes:
    """Return the least determined directions of a scaled system, with the scene held.

    Parameters
    ----------
    layout : Layout
        Its kept classes.
    S : dict
        Upper blocks of the scaled system.
    size : (unknowns,) float
        What the unknowns were multiplied by.
    G : (unknowns, m) float
        Motions of the whole scene that are free, in unscaled unknowns. As many coordinates of few cameras are held, so
        that what one camera can do does not move the others.

    Returns
    -------
    Modes
        All that there are, or the smallest; zero in landmarks that the system keeps. None if the system is not one of
        squares, but for rounding.
    """
    landmarks = _lone_landmarks(layout)
    datum = _datum(layout, size, G)
    if not landmarks and layout.num_kept_unknowns > DENSE:
        return smallest(layout, Fronts(layout), {pair: S[pair] + HOLD * datum.get(pair, 0.0) for pair in S})
    if landmarks:
        values, vectors = _without(layout, S, landmarks, datum)
    else:
        values, vectors = _complete(_as_array(layout, S), _as_array(layout, datum))
    if len(values) and values[0] < -NEGATIVE:
        values, vectors = values[:0], vectors[:, :0]
    return Modes(values, vectors)


def _complete(matrix: FloatArray, held: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return all eigenvalues and eigenvectors of a small system where nothing moves along ``held``."""
    size, directions = np.linalg.eigh(held)
    free = directions[:, size < 0.5]
    values, part = np.linalg.eigh(free.T @ matrix @ free)
    return values, free @ part


def _without(
    layout: Layout, S: Blocks, landmarks: dict[int, BoolArray], datum: Blocks
) -> tuple[FloatArray, FloatArray]:
    """Return the smallest eigenvalues, or all, with landmarks eliminated; the vectors are zero there."""
    from scipy.sparse import bsr_array  # takes a quarter of a second to import

    matrix = _as_sparse(layout, S)
    rest = np.ones(layout.num_kept_unknowns, bool)
    for c, blocks in landmarks.items():
        rest[_unknowns(layout, c, blocks)] = False
    reduced = matrix[rest][:, rest]
    for c, blocks in landmarks.items():
        coupling = matrix[rest][:, _unknowns(layout, c, blocks)]
        inverse = _inverse(S[c, c][: layout.kept[c].count][blocks])
        count = len(inverse)
        middle = bsr_array((inverse, np.arange(count), np.arange(count + 1)))
        reduced = reduced - coupling @ (middle @ coupling.T)
    held = _as_sparse(layout, datum)[rest][:, rest]
    if reduced.shape[0] <= DENSE:
        values, part = _complete(reduced.toarray(), held.toarray())
    else:
        values, part = _by_iteration((reduced + HOLD * held).tocsc())
    vectors = np.zeros((len(rest), len(values)))
    vectors[rest] = part
    return values, vectors


def _datum(layout: Layout, size: FloatArray, G: FloatArray) -> Blocks:
    """Return the projections, on the diagonal, onto the held coordinates: one camera, and part of others.

    :func:`groma.solver.covariance.datum.constrained` spreads its constraints over cameras as suits the factorisation.
    The frame must be a natural one, because findings about cameras are relative to it.
    """
    datum = {(c, c): np.zeros((len(layout.blocks[c, c][0]), k.width, k.width)) for c, k in enumerate(layout.kept)}
    kinds = layout.kinds
    G, left = G * size[:, None], np.eye(G.shape[1])  # in scaled unknowns, which have no unit
    for chosen in (("pose",), tuple(set(kinds) - {"pose"})):
        while left.shape[1]:
            moved = G @ left
            strongest, where = 1e-9 * float(np.abs(G).max(initial=0.0)), None
            for c, kept in enumerate(layout.kept):
                if kinds[c] in chosen:
                    strength = np.linalg.norm(kept.blocks_of(moved).reshape(kept.count, -1), axis=1)
                    if strength.max(initial=0.0) > strongest:
                        strongest, where = float(strength.max()), (c, int(strength.argmax()))
            if where is None:
                break
            c, block = where
            U, values, Vt = np.linalg.svd(layout.kept[c].blocks_of(moved)[block])
            rank = int((values > 1e-6 * values[0]).sum())
            datum[c, c][block] += U[:, :rank] @ U[:, :rank].T  # no motion along U
            left = left @ Vt[rank:].T
    return datum


def _lone_landmarks(layout: Layout) -> dict[int, BoolArray]:
    """For each kept class of points or lines, which of its blocks (count,) share none with another landmark."""
    lone = {c: np.ones(layout.kept[c].count, bool) for c, kind in enumerate(layout.kinds) if kind in ("point", "line")}
    for (a, b), (rows, columns) in layout.blocks.items():
        if a in lone and b in lone:
            off = slice(None) if a != b else rows != columns
            lone[a][rows[off]] = False
            lone[b][columns[off]] = False
    return {c: blocks for c, blocks in lone.items() if blocks.any()}


def _unknowns(layout: Layout, c: int, blocks: BoolArray) -> IntArray:
    kept = layout.kept[c]
    return kept.start + np.flatnonzero(np.repeat(blocks, kept.width))


def _as_array(layout: Layout, S: Blocks) -> FloatArray:
    """Return all of S from its upper blocks, or those of them that are given."""
    data, places = _entries(layout, S)
    whole = np.zeros((layout.num_kept_unknowns,) * 2)
    whole[places] = data
    return whole


def _as_sparse(layout: Layout, S: Blocks) -> csr_array:
    """Return what :func:`_as_array` does, as a sparse matrix."""
    from scipy.sparse import coo_array

    return coo_array(_entries(layout, S), shape=(layout.num_kept_unknowns,) * 2).tocsr()


def _entries(layout: Layout, S: Blocks) -> tuple[FloatArray, tuple[IntArray, IntArray]]:
    """Return the numbers of S, each once, with their rows and columns."""
    data, row, column = [], [], []
    for (a, b), blocks in S.items():
        rows, columns = layout.blocks[a, b]
        first, second = layout.kept[a], layout.kept[b]
        values = blocks[: len(rows)]
        i = (first.start + first.width * rows[:, None] + np.arange(first.width))[:, :, None]
        j = (second.start + second.width * columns[:, None] + np.arange(second.width))[:, None, :]
        i, j = (np.broadcast_to(x, values.shape).reshape(-1) for x in (i, j))
        off = np.repeat((rows != columns) | (a != b), first.width * second.width)
        flat = values.reshape(-1)
        data += [flat, flat[off]]
        row += [i, j[off]]
        column += [j, i[off]]
    return np.concatenate(data), (np.concatenate(row), np.concatenate(column))


def _inverse(blocks: FloatArray) -> FloatArray:
    """Inverse of symmetric blocks, without the directions that are not determined."""
    values, vectors = np.linalg.eigh(blocks)
    good = values > LANDMARK_TOLERANCE * np.maximum(values[:, -1:], 1e-300)
    return (vectors * np.where(good, 1.0 / np.where(good, values, 1.0), 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2)


def _by_iteration(matrix: csc_array) -> tuple[FloatArray, FloatArray]:
    """Smallest eigenvalues by Lanczos iteration on the shifted inverse."""
    from scipy.sparse.linalg import eigsh

    n = int(np.diff(matrix.indptr).size)
    try:
        values, vectors = eigsh(matrix, MODES, sigma=-SHIFT, v0=np.random.default_rng(0).normal(size=n))
    except RuntimeError:  # exactly singular, or not converged
        return np.zeros(0), np.zeros((n, 0))
    order = np.argsort(values)
    return values[order], vectors[:, order]
