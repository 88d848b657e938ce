# SPDX-License-Identifier: BSD-3-Clause
r"""Factorisation of the sparse reduced system front by front, and the part of its inverse that lies on its pattern.

Blocks are eliminated in a fill-reducing order. Blocks that fill the same rows form a *front*: a small dense matrix over
the blocks it eliminates (1) and the later blocks it touches (2). Children come before parents, and

.. math:: F = S_{front} + \sum_{children} U, \qquad F_{11} = L_{11}L_{11}^\top, \quad
          L_{21} = F_{21}L_{11}^{-\top}, \quad U = F_{22} - L_{21}L_{21}^\top .

The inverse Z restricted to a front follows from that of its parent, which holds all of :math:`Z_{22}` (Takahashi's
recursion, by fronts). With :math:`X = L_{21}L_{11}^{-1}`

.. math:: Z_{21} = -Z_{22}X, \qquad Z_{11} = L_{11}^{-\top}L_{11}^{-1} + X^\top Z_{22} X .

Every block of S lies in some front, so all blocks of Z that landmarks ask for are found, and no other is ever formed.
The work is in dense products of LAPACK and BLAS, and in compiled loops over small fronts without children
(:mod:`groma.solver.linear.leaf_fronts`); for a chain of cameras it grows linearly with their number.

References
----------
Takahashi, Fagan and Chen, 1973; Erisman and Tinney, *On computing certain elements of the inverse of a sparse matrix*,
1975; Duff and Reid, *The multifrontal solution of indefinite sparse symmetric linear equations*, 1983.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from groma._rows import pointers_of
from groma._typing import BoolArray, FloatArray, IntArray
from groma.problem.layout import Layout
from groma.solver.linear.blocks import Blocks
from groma.solver.linear.contract import PIVOT_TOLERANCE
from groma.solver.linear.lapack import potrf, potri, solve_lower
from groma.solver.linear.leaf_fronts import Leaves
from groma.solver.linear.ordering import fill_reducing_order
from groma.solver.linear.visible_motion import distinct

#: A reduced system with more than this share of its blocks filled is one front (cost: time alone).
FULL_SHARE = 0.4
#: Up to this many blocks everything is one front (cost: time alone).
FEW_BLOCKS = 12
#: A front joins its parent where its columns get longer by at most this share (cost: time alone).
EXTRA_ZEROS = 0.15
#: Leaf fronts that eliminate at most this many unknowns are processed in batches (cost: time alone).
LEAF_SIZE = 8


@dataclass
class _Front:
    """Which blocks a front eliminates and touches, and where the numbers of S go."""

    #: Global numbers of the eliminated blocks, then of the later ones, each in elimination order.
    blocks: IntArray
    num_eliminated: int
    #: Unknowns of the front in the reduced system, and how many of them are eliminated.
    unknowns: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    size: int = 0
    parent: int = -1
    #: Where the later unknowns lie in the parent's front.
    in_parent: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    #: For each class pair: slots of S, and their first row and column in the front.
    entries: dict[tuple[int, int], tuple[IntArray, IntArray, IntArray]] = field(default_factory=dict)
    #: How many fronts below this one are no leaves, and which are.
    children: int = 0
    leaves: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))


class Fronts:
    """Cholesky factorisation of the blocks of one layout, with solves and the inverse on the pattern.

    Parameters
    ----------
    layout : Layout
        Its kept classes and the block pattern of the reduced system.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        first = pointers_of([c.count for c in layout.kept])
        self._widths = np.concatenate([np.full(c.count, c.width, np.int64) for c in layout.kept])
        self._starts = np.concatenate([c.start + c.width * np.arange(c.count, dtype=np.int64) for c in layout.kept])
        pairs = {
            (a, b): (first[a] + rows.astype(np.int64), first[b] + columns.astype(np.int64))
            for (a, b), (rows, columns) in layout.blocks.items()
        }
        position, fronts = _arrange(pairs, int(first[-1]), self._widths)
        self._fronts = fronts
        self._complete(position, pairs)
        self._L: dict[int, tuple[FloatArray, FloatArray]] = {}

    def _complete(self, position: IntArray, pairs: dict) -> None:
        """Number the unknowns of every front, and sort the blocks of S into the fronts; leaves into flat arrays."""
        fronts, count = self._fronts, len(position)
        lengths = np.array([len(front.blocks) for front in fronts])
        blocks, owner = np.concatenate([front.blocks for front in fronts]), np.repeat(np.arange(len(fronts)), lengths)
        starts = np.cumsum(lengths) - lengths
        numbers = np.array([front.num_eliminated for front in fronts])
        eliminated = np.arange(len(blocks)) - starts[owner] < numbers[owner]
        home = np.empty(count, np.int64)
        home[blocks[eliminated]] = owner[eliminated]
        widths = self._widths[blocks]
        local = np.cumsum(widths) - widths
        local -= local[starts][owner]
        size = np.bincount(owner[eliminated], weights=widths[eliminated], minlength=len(fronts)).astype(np.int64)
        first = pointers_of(np.bincount(owner, weights=widths).astype(np.int64))
        by_key = np.argsort(owner * count + blocks)
        keys = (owner * count + blocks)[by_key]

        def place(front: IntArray, block: IntArray) -> IntArray:
            """First unknown of blocks in fronts."""
            return local[by_key[np.searchsorted(keys, front * count + block)]]

        has_parent = numbers < lengths
        parent = np.full(len(fronts), -1)
        parent[has_parent] = home[blocks[(starts + numbers)[has_parent]]]
        above = np.zeros(len(blocks), np.int64)
        above[~eliminated] = place(parent[owner[~eliminated]], blocks[~eliminated])
        in_parent, unknowns = _ranges(above, widths), _ranges(self._starts[blocks], widths)
        children = np.bincount(parent[has_parent], minlength=len(fronts))
        is_leaf = has_parent & (children == 0) & (size <= LEAF_SIZE)
        for f in np.flatnonzero(~is_leaf):
            front, span = fronts[f], slice(int(first[f]), int(first[f + 1]))
            front.size, front.parent, front.unknowns = int(size[f]), int(parent[f]), unknowns[span]
            front.in_parent = in_parent[span][front.size :]
        order = np.flatnonzero(is_leaf)[np.argsort(parent[is_leaf], kind="stable")]
        bounds = np.searchsorted(parent[order], np.arange(len(fronts) + 1))
        for f in np.flatnonzero(np.diff(bounds)):
            fronts[f].leaves = order[bounds[f] : bounds[f + 1]]
        for f, number in enumerate(children - np.diff(bounds)):
            fronts[f].children = int(number)
        self._inner = np.flatnonzero(~is_leaf).tolist()
        pointers, places, shapes = self._sorted_into_fronts(pairs, position, home, place, is_leaf)
        at = pointers_of(np.where(is_leaf, np.diff(first) * size, 0))
        self._leaves = Leaves(order, size, first, at, unknowns, in_parent, pointers, places, shapes, np.empty(at[-1]))

    def _sorted_into_fronts(
        self,
        pairs: dict,
        position: IntArray,
        home: IntArray,
        place: Callable[[IntArray, IntArray], IntArray],
        is_leaf: BoolArray,
    ) -> tuple[IntArray, IntArray, IntArray]:
        """Give the blocks of S to the front of their first block; return those of leaves as they are stored there."""
        begin, owners, places, shapes = 0, [], [], []
        for (a, b), (rows, columns) in pairs.items():
            height, width = self._layout.kept[a].width, self._layout.kept[b].width
            front_of = np.where(position[rows] <= position[columns], home[rows], home[columns])
            row, column = place(front_of, rows), place(front_of, columns)
            mine = np.flatnonzero(is_leaf[front_of])
            owners.append(front_of[mine])
            places.append(np.column_stack([begin + mine * height * width, row[mine], column[mine]]))
            shapes.append(np.tile([height, width], (len(mine), 1)))
            begin += len(rows) * height * width
            order = np.argsort(front_of, kind="stable")
            bounds = np.searchsorted(front_of[order], np.arange(len(is_leaf) + 1))
            for f in np.flatnonzero(np.diff(bounds) * ~is_leaf):
                slots = order[bounds[f] : bounds[f + 1]]
                self._fronts[f].entries[a, b] = slots, row[slots], column[slots]
        owner = np.concatenate(owners)
        order = np.argsort(owner, kind="stable")
        pointers = np.searchsorted(owner[order], np.arange(len(is_leaf) + 1))
        return pointers, np.concatenate(places)[order], np.concatenate(shapes)[order]

    @property
    def largest(self) -> int:
        """Unknowns of the largest front."""
        return int(np.diff(self._leaves.first).max())

    def factorize(self, blocks: Blocks) -> bool:
        """Factorise S, given by its upper blocks; False if it is not positive definite."""
        self._L = {}
        updates: dict[int, list[tuple[IntArray, FloatArray]]] = {}
        values = np.concatenate([blocks[pair].reshape(-1) for pair in self._layout.blocks] if self._leaves else [[]])
        for f in self._inner:
            front = self._fronts[f]
            F = np.zeros((len(front.unknowns),) * 2)
            for (a, b), (slots, rows, columns) in front.entries.items():
                own = blocks[a, b][slots]
                r = rows[:, None, None] + np.arange(own.shape[1])[:, None]
                c = columns[:, None, None] + np.arange(own.shape[2])
                F[r, c] = own
                F[c, r] = own
            n = front.size
            smallest = PIVOT_TOLERANCE * F.diagonal()[:n]
            if len(front.leaves) and not self._leaves.eliminate(front.leaves, values, F):
                return False
            for index, U in updates.pop(f, []):
                F[np.ix_(index, index)] += U
            L, info = potrf(F[:n, :n], lower=1, clean=1)
            if info != 0 or not np.isfinite(L).all() or (L.diagonal() ** 2 <= smallest).any():
                return False
            below = solve_lower(L, F[:n, n:]).T
            if front.parent >= 0:
                updates.setdefault(front.parent, []).append((front.in_parent, F[n:, n:] - below @ below.T))
            self._L[f] = L, below
        return True

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return S^-1 times ``rhs`` (unknowns,), or its columns (unknowns, k)."""
        result = np.array(rhs, dtype=np.float64)
        x = result.reshape(len(result), -1)
        self._leaves.solve(x)
        for f, (L, below) in self._L.items():
            front = self._fronts[f]
            n = front.size
            y = solve_lower(L, x[front.unknowns[:n]])
            x[front.unknowns[:n]] = y
            x[front.unknowns[n:]] -= below @ y
        for f, (L, below) in reversed(self._L.items()):
            front = self._fronts[f]
            n = front.size
            y = x[front.unknowns[:n]] - below.T @ x[front.unknowns[n:]]
            x[front.unknowns[:n]] = solve_lower(L, y, transposed=True)
        self._leaves.solve(x, back=True)
        return result

    def inverse_on_pattern(self) -> Blocks:
        """Return the blocks of S^-1 at the places of the blocks of S."""
        layout = self._layout
        shapes = {
            (a, b): (len(rows), layout.kept[a].width, layout.kept[b].width)
            for (a, b), (rows, _) in layout.blocks.items()
        }
        values = np.empty(sum(map(math.prod, shapes.values())))
        parts = np.split(values, np.cumsum([math.prod(shape) for shape in shapes.values()])[:-1])
        result = {pair: part.reshape(shape) for part, (pair, shape) in zip(parts, shapes.items(), strict=True)}
        kept: dict[int, FloatArray] = {}
        waiting = [front.children for front in self._fronts]
        for f in reversed(self._inner):
            front, (L, below) = self._fronts[f], self._L[f]
            n = front.size
            Z = np.empty((len(front.unknowns),) * 2)
            inner, _ = potri(L, lower=1)
            inner = np.tril(inner) + np.tril(inner, -1).T
            if front.parent >= 0:
                Z22 = kept[front.parent][np.ix_(front.in_parent, front.in_parent)]
                X = solve_lower(L, below.T, transposed=True).T
                Z21 = -(Z22 @ X)
                inner = inner - X.T @ Z21
                Z[n:, n:], Z[n:, :n], Z[:n, n:] = Z22, Z21, Z21.T
                waiting[front.parent] -= 1
                if waiting[front.parent] == 0:
                    del kept[front.parent]
            Z[:n, :n] = 0.5 * (inner + inner.T)
            for (a, b), (slots, rows, columns) in front.entries.items():
                r = rows[:, None, None] + np.arange(layout.kept[a].width)[:, None]
                c = columns[:, None, None] + np.arange(layout.kept[b].width)
                result[a, b][slots] = Z[r, c]
            if len(front.leaves):
                self._leaves.invert(front.leaves, Z, values)
            if front.children:
                kept[f] = Z
        return result


def _ranges(starts: IntArray, widths: IntArray) -> IntArray:
    """Return the concatenated ranges start, ..., start + width - 1."""
    ends = np.cumsum(widths)
    return np.arange(int(ends[-1]) if len(ends) else 0) + np.repeat(starts - (ends - widths), widths)


def _arrange(pairs: dict, count: int, widths: IntArray) -> tuple[IntArray, list[_Front]]:
    """Return the place of each block in the elimination, and the fronts, children before parents."""
    rows = np.concatenate([r for r, _ in pairs.values()])
    columns = np.concatenate([c for _, c in pairs.values()])
    off = rows != columns
    rows, columns = rows[off], columns[off]
    if 2 * len(rows) > FULL_SHARE * count * count or count <= FEW_BLOCKS:
        return np.arange(count), [_Front(np.arange(count), count)]
    position = fill_reducing_order(rows, columns, count)
    return position, _supernodes(position, rows, columns, widths)


def _supernodes(position: IntArray, rows: IntArray, columns: IntArray, widths: IntArray) -> list[_Front]:
    """Fill of every column in elimination order, and columns joined where that costs little."""
    count = len(position)
    low = np.minimum(position[rows], position[columns])
    high = np.maximum(position[rows], position[columns])
    order = np.lexsort((high, low))
    low, high = low[order], high[order]
    bounds = np.searchsorted(low, np.arange(count + 1))
    structure: list[IntArray] = [np.zeros(0, np.int64)] * count
    children: list[list[int]] = [[] for _ in range(count)]
    for j in range(count):
        parts = [high[bounds[j] : bounds[j + 1]], *(structure[c] for c in children[j])]
        merged = distinct(np.concatenate(parts))
        structure[j] = merged[merged > j]
        if len(structure[j]):
            children[int(structure[j][0])].append(j)
    at = np.empty(count, np.int64)
    at[position] = np.arange(count)
    width_at = widths[at]
    columns_of: list[list[int]] = [[j] for j in range(count)]
    size_of = width_at.astype(np.int64)
    rows_of = np.array([int(width_at[s].sum()) for s in structure])
    alive: BoolArray = np.ones(count, bool)
    for j in range(count):
        if not len(structure[j]):
            continue
        p = int(structure[j][0])  # not joined to anything yet, because its parent is later
        extra = size_of[p] + rows_of[p] - rows_of[j]
        if extra <= EXTRA_ZEROS * (size_of[j] + rows_of[j]):
            columns_of[p] = columns_of[j] + columns_of[p]
            size_of[p] += size_of[j]
            alive[j] = False
    fronts = []
    for j in np.flatnonzero(alive):
        own = np.array(sorted(columns_of[j]), np.int64)
        fronts.append(_Front(at[np.concatenate([own, structure[j]])], len(own)))
    return fronts
