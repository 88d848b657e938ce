# SPDX-License-Identifier: BSD-3-Clause
"""The reduced system solved by a dense Cholesky factorisation."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np

from groma._typing import FloatArray
from groma.problem.layout import Layout
from groma.solver.linear.blocks import Blocks, split
from groma.solver.linear.contract import PIVOT_TOLERANCE, keeps_poses_alone, register_linear_solver
from groma.solver.linear.lapack import potrf, potrs

#: Flops of a factorisation, measured on one core.
DENSE_FLOPS_PER_SECOND = 2.5e10
#: Up to this many unknowns a dense factorisation costs little, and is exact: where poses alone are kept, and otherwise
#: (cost: time alone).
DENSE_POSE_UNKNOWNS, DENSE_OTHER_UNKNOWNS = 360, 1000


@register_linear_solver("dense")
class Dense:
    """Cholesky factorisation of the full matrix."""

    name = "dense"
    num_iterations = 0
    residual = None

    def __init__(self, layout: Layout) -> None:
        self._layout = layout

    @cached_property
    def _matrix(self) -> FloatArray:
        return np.zeros((self._layout.num_kept_unknowns,) * 2)

    def expected_seconds(self) -> float:  # noqa: D102
        unknowns = self._layout.num_kept_unknowns
        small = DENSE_POSE_UNKNOWNS if keeps_poses_alone(self._layout) else DENSE_OTHER_UNKNOWNS
        return 0.0 if unknowns <= small else unknowns**3 / 3 / DENSE_FLOPS_PER_SECOND

    def follow(self, states: Mapping[str, FloatArray]) -> None:  # noqa: D102
        pass

    def solve(self, blocks: Blocks, rhs: list[FloatArray]) -> list[FloatArray] | None:  # noqa: D102
        self._matrix[:] = 0.0
        self.fill(blocks, self._matrix)
        smallest = PIVOT_TOLERANCE * self._matrix.diagonal()
        # the upper triangle in C order is the lower triangle of the transpose, which LAPACK takes without a copy
        factor, info = potrf(self._matrix.T, lower=1, overwrite_a=1, clean=0)
        if info != 0 or (factor.diagonal() ** 2 <= smallest).any():
            return None
        x, info = potrs(factor, np.concatenate(rhs), lower=1)
        return split(self._layout, x) if np.isfinite(x).all() else None

    def fill(self, blocks: Blocks, M: FloatArray) -> None:
        """Write the blocks into the upper triangle of M (unknowns, unknowns)."""
        layout = self._layout
        for (a, b), S in blocks.items():
            first, second = layout.kept[a], layout.kept[b]
            part = M[first.start :, second.start :][: first.count * first.width, : second.count * second.width]
            rows, columns = layout.blocks[a, b]
            part.reshape(first.count, first.width, second.count, second.width)[rows, :, columns] = S
