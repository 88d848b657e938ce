# SPDX-License-Identifier: BSD-3-Clause
"""The reduced system solved by a sparse factorisation with a fill-reducing symmetric ordering.

Block by block where all have one size (:mod:`groma.solver.linear.block_cholesky`), else front by front
(:mod:`groma.solver.linear.fronts`).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np

from groma._typing import FloatArray
from groma.problem.layout import Layout
from groma.solver.linear.block_cholesky import BlockCholesky
from groma.solver.linear.blocks import Blocks, split
from groma.solver.linear.contract import LinearSolver, is_pose_graph, register_linear_solver
from groma.solver.linear.dense import DENSE_FLOPS_PER_SECOND
from groma.solver.linear.fronts import Fronts


@register_linear_solver("sparse")
def sparse(layout: Layout) -> LinearSolver:
    """Return the sparse solver that suits a layout."""
    return SparseBlocks(layout) if len(layout.kept) == 1 else SparseFronts(layout)


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


class SparseFronts:
    """Factorisation front by front, where blocks have several sizes."""

    name = "sparse"
    num_iterations = 0
    residual = None

    def __init__(self, layout: Layout) -> None:
        self._layout = layout

    @cached_property
    def _fronts(self) -> Fronts:
        return Fronts(self._layout)

    def expected_seconds(self) -> float:  # noqa: D102
        return np.inf

    def follow(self, states: Mapping[str, FloatArray]) -> None:  # noqa: D102
        pass

    def solve(self, blocks: Blocks, rhs: list[FloatArray]) -> list[FloatArray] | None:  # noqa: D102
        if not self._fronts.factorize(blocks):
            return None
        x = self._fronts.solve(np.concatenate(rhs)[:, None])[:, 0]
        return split(self._layout, x) if np.isfinite(x).all() else None
