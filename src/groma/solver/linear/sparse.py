# SPDX-License-Identifier: BSD-3-Clause
"""The reduced system solved by a sparse factorisation with a fill-reducing symmetric ordering.

Block by block where all have one size (:mod:`groma.solver.linear.block_cholesky`), else by numbers (SuperLU).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.problem.layout import Layout
from groma.solver.linear.block_cholesky import BlockCholesky
from groma.solver.linear.blocks import Blocks, split
from groma.solver.linear.contract import PIVOT_TOLERANCE, LinearSolver, is_pose_graph, register_linear_solver
from groma.solver.linear.dense import DENSE_FLOPS_PER_SECOND

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix


@register_linear_solver("sparse")
def sparse(layout: Layout) -> LinearSolver:
    """Return the sparse solver that suits a layout."""
    return SparseBlocks(layout) if len(layout.kept) == 1 else SparseMatrix(layout)


class SparseBlocks:
    """Factorisation of the sparse matrix of blocks, where all have one size."""

    name = "sparse"
    num_iterations = 0
    residual = None

    def __init__(self, layout: Layout) -> None:
        self._layout = layout

    @cached_property
    def _cholesky(self) -> BlockCholesky:
        return BlockCholesky(self._layout)

    def expected_seconds(self) -> float:
        """Return the time of the products of blocks; where cameras share landmarks, fill makes it hard to foresee."""
        if not is_pose_graph(self._layout):
            return np.inf
        return 2.0 * self._cholesky.num_products * self._layout.kept[0].width ** 3 / DENSE_FLOPS_PER_SECOND

    def follow(self, states: Mapping[str, FloatArray]) -> None:  # noqa: D102
        pass

    def solve(self, blocks: Blocks, rhs: list[FloatArray]) -> list[FloatArray] | None:  # noqa: D102
        if not self._cholesky.factorize(blocks[0, 0]):
            return None
        x = self._cholesky.solve(rhs[0])
        return [x] if np.isfinite(x).all() else None


class SparseMatrix:
    """Factorisation of the scalar sparse matrix."""

    name = "sparse"
    num_iterations = 0
    residual = None

    def __init__(self, layout: Layout) -> None:
        self._layout = layout

    def expected_seconds(self) -> float:  # noqa: D102
        return np.inf

    def follow(self, states: Mapping[str, FloatArray]) -> None:  # noqa: D102
        pass

    @cached_property
    def _pattern(self) -> tuple[csc_matrix, IntArray]:
        """The matrix, and which number of the blocks each of its entries is."""
        from scipy.sparse import csc_matrix  # takes a quarter of a second to import

        layout = self._layout
        n = layout.num_kept_unknowns
        rows_of, columns_of, source = [], [], []
        position = 0
        for a, b in layout.blocks:
            rows, columns = layout.blocks[a, b]
            wa, wb = layout.kept[a].width, layout.kept[b].width
            r = layout.kept[a].start + rows[:, None, None] * wa + np.arange(wa)[None, :, None]
            c = layout.kept[b].start + columns[:, None, None] * wb + np.arange(wb)[None, None, :]
            r, c = (np.broadcast_to(x, (len(rows), wa, wb)).reshape(-1) for x in (r, c))
            s = position + np.arange(len(r))
            position += len(r)
            upper = r <= c
            r, c, s = r[upper], c[upper], s[upper]
            off = r != c
            rows_of += [r, c[off]]
            columns_of += [c, r[off]]
            source += [s, s[off]]
        r, c, s = np.concatenate(rows_of), np.concatenate(columns_of), np.concatenate(source)
        matrix = csc_matrix((s + 1.0, (r, c)), shape=(n, n))
        matrix.sort_indices()
        return matrix, (matrix.data - 1).astype(np.int64)

    def solve(self, blocks: Blocks, rhs: list[FloatArray]) -> list[FloatArray] | None:  # noqa: D102
        from scipy.sparse.linalg import splu

        matrix, source = self._pattern
        matrix.data = np.concatenate([blocks[pair].reshape(-1) for pair in self._layout.blocks])[source]
        try:
            factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError:  # exactly singular
            return None
        if (factor.U.diagonal() <= PIVOT_TOLERANCE * matrix.diagonal()[np.argsort(factor.perm_c)]).any():
            return None
        x = factor.solve(np.concatenate(rhs))
        return split(self._layout, x) if np.isfinite(x).all() else None
