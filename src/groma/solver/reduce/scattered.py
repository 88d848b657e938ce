# SPDX-License-Identifier: BSD-3-Clause
"""Blocks of the reduced system that stay with the shards they come from.

With very many cameras the reduced system is too much for every process. Conjugate gradients need no more of it than
products with vectors. So what a shard leaves behind when its landmarks are eliminated stays where it is: each process
multiplies the blocks of its own shards, and one sum of a vector completes the product. Blocks on the diagonal, for
which there is room everywhere, are summed at once (:mod:`groma.solver.reduce.shared_system`).

Sums over shards are exact (:mod:`groma.solver.reduce.exact_sums`), so the product does not depend on who has which.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from groma._simd import width
from groma._typing import ComplexArray, FloatArray, IntArray
from groma.solver.linear.blocks import add_block_products
from groma.solver.linear.coarse import coarse_products
from groma.solver.reduce import exact_sums
from groma.solver.reduce.contract import Reducer

#: Blocks (n, r, c) of a shard off the diagonal, between two classes: rows and columns above it.
Scattered = tuple[int, int, IntArray, IntArray, FloatArray]


class ScatteredBlocks:
    """Blocks off the diagonal, by shard; a :class:`groma.solver.linear.remote_blocks.RemoteBlocks`.

    Parameters
    ----------
    sizes : list of (int, int)
        Number and width of the blocks on the diagonal, by class.
    reducer : Reducer
        All processes.
    """

    def __init__(self, sizes: Sequence[tuple[int, int]], reducer: Reducer) -> None:
        self._sizes, self._reducer = sizes, reducer
        self._shards: list[list[Scattered]] = []
        self._pairs: dict[int, tuple[IntArray, IntArray]] = {}

    def clear(self) -> None:
        """Forget all blocks; which there are stays known."""
        self._shards = []

    def begin_shard(self) -> None:
        """Take the next blocks as those of another shard."""
        self._shards.append([])

    def keep(self, a: int, b: int, rows: IntArray, columns: IntArray, blocks: FloatArray) -> None:
        """Keep blocks of the shard."""
        if len(rows):
            row, column = (np.ascontiguousarray(index, np.int32) for index in (rows, columns))
            self._shards[-1].append((a, b, row, column, np.ascontiguousarray(blocks)))

    def pairs(self, c: int) -> tuple[IntArray, IntArray]:
        """Return rows and columns of the blocks within a class that any process has; called by all at once."""
        if c not in self._pairs:
            count = self._sizes[c][0]
            own = [rows.astype(np.int64) * count + columns for shard in self._shards for a, b, rows, columns, _ in shard
                   if a == b == c]  # fmt: skip
            number = self._reducer.union(np.unique(np.concatenate([np.zeros(0, np.int64), *own])))
            rows, columns = np.divmod(number, count)
            self._pairs[c] = rows.astype(np.int32), columns.astype(np.int32)
        return self._pairs[c]

    def add_products(self, x: list[FloatArray], y: list[FloatArray]) -> None:
        """Add the products of all blocks, and of their mirror images, with x to y, by class and flat."""
        total, part = np.zeros(sum(map(len, x)), complex), np.empty(sum(map(len, x)))
        of_class = np.split(part, np.cumsum([len(one) for one in x])[:-1])
        for shard in self._shards:
            part[:] = 0.0
            for a, b, rows, columns, blocks in shard:
                widths = width(self._sizes[a][1]), width(self._sizes[b][1]), width(1)
                add_block_products(blocks, rows, columns, a == b, x[a], x[b], of_class[a], of_class[b], *widths)
            exact_sums.add(total, part)
        for own, more in zip(y, np.split(self._sum(total), np.cumsum([len(one) for one in x])[:-1]), strict=True):
            own += more

    def coarse(self, c: int, cluster: IntArray, P: FloatArray) -> FloatArray:
        """Return what the blocks within a class add to :func:`groma.solver.linear.coarse.coarse_products`."""
        total = np.zeros((7 * (int(cluster.max()) + 1)) ** 2, complex)
        for shard in self._shards:
            for a, b, rows, columns, blocks in shard:
                if a == b == c:
                    exact_sums.add(total, coarse_products(blocks, rows, columns, cluster, P))
        return self._sum(total)

    def _sum(self, total: ComplexArray) -> FloatArray:
        return exact_sums.rounded(self._reducer.sum(total))
