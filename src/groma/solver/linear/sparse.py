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
from groma.solver.linear.contract import is_pose_graph, register_linear_solver
from groma.solver.linear.dense import DENSE_FLOPS_PER_SECOND
from groma.solver.linear.fronts import Fronts


@register_linear_solver("sparse")
class Sparse:
    """Factorisation of the sparse matrix of blocks."""

    name = "sparse"
    num_iterations = 0
    residual = None

    def __init__(self, layout: Layout) -> None:
        self._layout = layout

    @cached_property
    def _factors(self) -> BlockCholesky | Fronts:
        return BlockCholesky(self._layout) if len(self._layout.kept) == 1 else Fronts(self._layout)

    def expected_seconds(self) -> float:
        """Return the time of the products of blocks; where cameras share landmarks, fill makes it hard to foresee."""
        if not (is_pose_graph(self._layout) and isinstance(self._factors, BlockCholesky)):
            return np.inf
        return 2.0 * self._factors.num_products * self._layout.kept[0].width ** 3 / DENSE_FLOPS_PER_SECOND

    def follow(self, states: Mapping[str, FloatArray]) -> None:  # noqa: D102
        pass

    def solve(self, blocks: Blocks, rhs: list[FloatArray]) -> list[FloatArray] | None:  # noqa: D102
        if not self._factors.factorize(blocks):
            return None
        x = self._factors.solve(np.concatenate(rhs))
        return split(self._layout, x) if np.isfinite(x).all() else None
