# SPDX-License-Identifier: BSD-3-Clause
r"""Cholesky factorisation of a sparse reduced system whose blocks all have one size.

Blocks are eliminated in a fill-reducing order. The factor is made row by row: row i of

.. math:: L_{ii} L_{ii}^\top = S_{ii} - \sum_k L_{ik} L_{ik}^\top, \qquad
          L_{ik} = \Big(S_{ik} - \sum_{j<k} L_{ij} L_{kj}^\top\Big) L_{kk}^{-\top}

is not zero at the blocks k that are reached in the elimination tree from the blocks of S in that row. All products are
those of two small square blocks, in explicit vectors (:mod:`groma._simd`). For cameras along a path the factor, and the
time to find it, grow linearly with their number.

T. A. Davis, *Direct Methods for Sparse Linear Systems*, SIAM, 2006, sections 4.1 to 4.7, here with blocks.
"""

from __future__ import annotations

import numpy as np

from groma._numba import kernel, loop
from groma._rows import pointers_of
from groma._simd import add_matvec, add_product, set_product, width
from groma._typing import FloatArray, IntArray
from groma.problem.layout import Layout
from groma.problem.sorting import argsort_by
from groma.solver.linear.blocks import Blocks
from groma.solver.linear.contract import PIVOT_TOLERANCE
from groma.solver.linear.ordering import fill_reducing_order

# ---------------------------------------------------------------------------------------------------------- Kernels


@loop
def _tree(pointer, column, parent):
    """Write the parent of each row in the elimination tree; ``column`` holds the blocks left of the diagonal by row."""
    n = parent.shape[0]
    ancestor = np.full(n, -1, np.int64)
    for i in range(n):
        parent[i] = -1
        for s in range(pointer[i], pointer[i + 1]):
            k = np.int64(column[s])
            while k >= 0 and k < i:
                above = ancestor[k]
                ancestor[k] = i
                if above < 0:
                    parent[k] = i
                k = above


@kernel
def _reach(pointer, column, parent, i, mark, stack, path):
    """Write the columns of row i of L to the end of ``stack``, children before parents; return their start."""
    n = parent.shape[0]
    top = n
    mark[i] = i
    for s in range(pointer[i], pointer[i + 1]):
        k, length = np.int64(column[s]), 0
        while mark[k] != i:
            path[length] = k
            length += 1
            mark[k] = i
            k = parent[k]
        while length > 0:
            length -= 1
            top -= 1
            stack[top] = path[length]
    return top


@loop
def _count(pointer, column, parent, count):
    """Add to ``count`` the blocks below the diagonal of every column of L; return the products of blocks to form it."""
    n = parent.shape[0]
    mark, stack, path = np.full(n, -1, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    products = 0
    for i in range(n):
        top = _reach(pointer, column, parent, i, mark, stack, path)
        for t in range(top, n):
            count[stack[t]] += 1
            products += count[stack[t]] + 1
    return products


@loop
def _factorize(pointer, column, slot, flipped, diagonal, parent, S, first, rows, M, D, w):
    """Write the blocks of L, transposed, by column to M, and -L_ii^-T to D; False if S is not positive definite."""
    n, b = parent.shape[0], len(w)
    size = b * b
    mark, stack, path = np.full(n, -1, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    filled = np.zeros(n, np.int64)
    X = np.zeros(n * size)  # minus the blocks of the present row, transposed, less what is eliminated so far
    L, inverse = np.zeros((b, b)), np.zeros((b, b))
    for i in range(n):
        for s in range(pointer[i], pointer[i + 1]):
            x, at = np.int64(column[s]) * size, np.int64(slot[s]) * size
            for r in range(b):
                for c in range(b):
                    X[x + r * b + c] = -S[at + (c * b + r if flipped[s] else r * b + c)]
        for k in range(size):
            X[i * size + k] = -S[np.int64(diagonal[i]) * size + k]
        top = _reach(pointer, column, parent, i, mark, stack, path)
        for t in range(top, n):
            k = stack[t]
            new = (first[k] + filled[k]) * size
            set_product(M, new, D, k * size, b, X, k * size, b, w, w, w)
            for e in range(first[k], first[k] + filled[k]):
                add_product(X, np.int64(rows[e]) * size, M, e * size, b, M, new, b, w, w, w)
            add_product(X, i * size, M, new, b, M, new, b, w, w, w)
            rows[first[k] + filled[k]] = i
            filled[k] += 1
            for e in range(size):
                X[k * size + e] = 0.0
        for r in range(b):
            for c in range(r + 1):
                total = -X[i * size + r * b + c]
                for k in range(c):
                    total -= L[r, k] * L[c, k]
                if r > c:
                    L[r, c] = total * inverse[c, c]
                elif total > PIVOT_TOLERANCE * S[np.int64(diagonal[i]) * size + r * b + r]:
                    L[r, r] = np.sqrt(total)
                    inverse[r, r] = 1.0 / L[r, r]
                else:
                    return False
        for c in range(b):
            for r in range(c + 1, b):
                total = 0.0
                for k in range(c, r):
                    total -= L[r, k] * inverse[k, c]
                inverse[r, c] = total * inverse[r, r]
        for r in range(b):
            for c in range(b):
                D[i * size + r * b + c] = -inverse[c, r] if c >= r else 0.0
        for k in range(size):
            X[i * size + k] = 0.0
    return True


@loop
def _solve(first, rows, M, D, x, w, one):
    """Replace x by S^-1 x."""
    n, b = first.shape[0] - 1, len(w)
    size = b * b
    y = np.zeros(n * b)
    for k in range(n):  # y = -L^-1 x
        add_product(y, k * b, x, k * b, 1, D, k * size, b, w, one, w)
        for e in range(first[k], first[k + 1]):
            add_product(x, np.int64(rows[e]) * b, y, k * b, 1, M, e * size, b, w, one, w)
    for k in range(n - 1, -1, -1):  # x = -L^-T y
        for e in range(first[k], first[k + 1]):
            add_matvec(y, k * b, M, e * size, x, np.int64(rows[e]) * b, w, w)
        for r in range(b):
            x[k * b + r] = 0.0
        add_matvec(x, k * b, D, k * size, y, k * b, w, w)


# ----------------------------------------------------------------------------------------------------------- Public


class BlockCholesky:
    """Order and structure of the factor of one layout with one class of kept blocks; factorised once per step."""

    def __init__(self, layout: Layout) -> None:
        (kept,) = layout.kept
        self._width, count = kept.width, kept.count
        blocks_row, blocks_column = (index.astype(np.int64) for index in layout.blocks[0, 0])
        off = np.flatnonzero(blocks_row != blocks_column)
        position = fill_reducing_order(blocks_row[off], blocks_column[off], count)
        self._position = position
        a, b = position[blocks_row[off]], position[blocks_column[off]]
        row, column = np.maximum(a, b), np.minimum(a, b)
        order = argsort_by(((row, count), (column, count)), len(off))
        self._pointer = pointers_of(np.bincount(row, minlength=count))
        self._column = column[order].astype(np.int32)
        self._slot = off[order].astype(np.int32)
        #: Whether a block of S stands transposed above the diagonal of the ordered matrix.
        self._flipped = np.ascontiguousarray(a[order] > b[order])
        self._diagonal = np.empty(count, np.int32)
        self._diagonal[position[blocks_row[blocks_row == blocks_column]]] = np.flatnonzero(blocks_row == blocks_column)
        self._parent: IntArray = np.empty(count, np.int64)
        _tree(self._pointer, self._column, self._parent)
        below = np.zeros(count, np.int64)
        #: Products of two blocks that a factorisation takes.
        self.num_products = int(_count(self._pointer, self._column, self._parent, below))
        self._first = pointers_of(below)
        self._rows = np.empty(self._first[-1], np.int32)
        self._M: FloatArray = np.empty(0)
        self._D: FloatArray = np.empty(0)

    @property
    def num_blocks(self) -> int:
        """Blocks of the factor, with the diagonal."""
        return len(self._rows) + len(self._parent)

    def factorize(self, blocks: Blocks) -> bool:
        """Factorise S, given by its upper blocks; False if it is not positive definite."""
        size = self._width**2
        if not len(self._D):
            self._M, self._D = np.empty(len(self._rows) * size), np.empty(len(self._parent) * size)
        return bool(
            _factorize(
                self._pointer, self._column, self._slot, self._flipped, self._diagonal, self._parent,
                blocks[0, 0].reshape(-1), self._first, self._rows, self._M, self._D, width(self._width),
            )
        )  # fmt: skip

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return S^-1 rhs, flat, in the order of the layout."""
        x = np.empty((len(self._parent), self._width))
        x[self._position] = rhs.reshape(x.shape)
        flat = x.reshape(-1)
        _solve(self._first, self._rows, self._M, self._D, flat, width(self._width), width(1))
        return flat.reshape(x.shape)[self._position].reshape(-1)
