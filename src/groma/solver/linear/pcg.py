# SPDX-License-Identifier: BSD-3-Clause
"""The reduced system solved by preconditioned conjugate gradients.

The preconditioner has the inverses of the diagonal blocks and, in large systems, the motions of clusters of cameras
(:mod:`groma.solver.linear.coarse`). The iteration is stopped early: a Newton step needs few digits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property

import numpy as np

from groma._numba import loop
from groma._simd import add_matvec, width
from groma._typing import FloatArray
from groma.problem.layout import Layout
from groma.solver.linear.blocks import Blocks, add_block_products, products, split
from groma.solver.linear.coarse import CoarseSpace, coarse_space
from groma.solver.linear.contract import is_pose_graph, keeps_poses_alone, register_linear_solver
from groma.solver.linear.remote_blocks import RemoteBlocks

#: Bytes of a product with S, measured on one core.
BYTES_PER_SECOND = 6e9
#: Iterations in a step where poses alone are kept, and otherwise (calibration, planes) (cost: a step that is not solved
#: out is refused or followed by another).
POSE_ITERATIONS, OTHER_ITERATIONS = 15, 60
#: ... and where nothing is eliminated: motions between poses are hard for conjugate gradients. Cost: as above.
GRAPH_ITERATIONS = 100

# ---------------------------------------------------------------------------------------------------------- Kernels


@loop
def _invert(blocks, out, block_width):
    """Write the inverses of the first symmetric blocks to ``out``, flat; return whether all are positive definite."""
    n = len(block_width)
    L, inverse = np.zeros((n, n)), np.zeros((n, n))
    for p in range(out.shape[0] // (n * n)):
        for j in range(n):
            for i in range(j, n):
                total = blocks[p, j, i]
                for k in range(j):
                    total -= L[i, k] * L[j, k]
                if i > j:
                    L[i, j] = total / L[j, j]
                elif total > 0.0:
                    L[j, j] = np.sqrt(total)
                else:
                    return False
        for j in range(n):
            inverse[j, j] = 1.0 / L[j, j]
            for i in range(j + 1, n):
                total = 0.0
                for k in range(j, i):
                    total -= L[i, k] * inverse[k, j]
                inverse[i, j] = total / L[i, i]
        for i in range(n):
            for j in range(i, n):
                total = 0.0
                for k in range(j, n):
                    total += inverse[k, i] * inverse[k, j]
                out[(p * n + i) * n + j] = total
                out[(p * n + j) * n + i] = total
    return True


@loop
def _apply_blocks(blocks, x, y, block_width):
    """Add the product of diagonal blocks with x to y."""
    w = len(block_width)
    for i in range(x.shape[0] // w):
        add_matvec(y, i * w, blocks, i * w * w, x, i * w, block_width, block_width)


@loop
def _advance(x, r, p, Sp, b, alpha):
    """X += alpha p and r -= alpha Sp; return the value of the quadratic model at x, -(x b + x r) / 2."""
    total = 0.0
    for i in range(x.shape[0]):
        x[i] += alpha * p[i]
        r[i] -= alpha * Sp[i]
        total += x[i] * (b[i] + r[i])
    return -0.5 * total


# ----------------------------------------------------------------------------------------------------------- Public


@register_linear_solver("pcg")
class ConjugateGradients:
    """Preconditioned conjugate gradients on the blocks, and on those of other processes, if there are any."""

    name = "pcg"
    #: Stop when one more iteration improves the quadratic model by less than this share of its mean improvement.
    model_tolerance = 0.025
    #: ... and, where other blocks than cameras are kept, when the residual has fallen to this share. Planes converge in
    #: two phases, and the model seems to stand still between them.
    mixed_tolerance = 0.01
    max_iterations = 500

    def __init__(self, layout: Layout, remote: RemoteBlocks | None = None) -> None:
        self._layout, self._remote = layout, remote
        self.num_iterations = 0
        self.residual: list[FloatArray] | None = None

    @cached_property
    def _coarse(self) -> CoarseSpace | None:
        return coarse_space(self._layout, self._remote)

    def expected_seconds(self) -> float:
        """Return the time of the products with S in as many iterations as a step takes."""
        layout = self._layout
        iterations = POSE_ITERATIONS if keeps_poses_alone(layout) else OTHER_ITERATIONS
        if is_pose_graph(layout):
            iterations = GRAPH_ITERATIONS
        numbers = sum(layout.kept[a].width * layout.kept[b].width * len(i) for (a, b), (i, _) in layout.blocks.items())
        return iterations * 8 * numbers / BYTES_PER_SECOND

    def follow(self, states: Mapping[str, FloatArray]) -> None:  # noqa: D102
        if self._coarse is not None:
            self._coarse.follow(states)

    def solve(self, blocks: Blocks, rhs: list[FloatArray]) -> list[FloatArray] | None:  # noqa: D102
        layout = self._layout
        b = np.concatenate(rhs)
        x, r = np.zeros_like(b), b.copy()
        p, z, Sp = np.empty_like(b), np.empty_like(b), np.empty_like(b)
        precondition = self._preconditioner(blocks, r, z)
        if precondition is None:
            return None
        p_parts, Sp_parts = split(layout, p), split(layout, Sp)
        sums = products(layout, blocks, p_parts, Sp_parts)
        rz = rz_begin = precondition()
        p[:] = z
        model = 0.0
        mixed = len(layout.kept) > 1
        for k in range(1, self.max_iterations + 1):
            if rz <= 0.0:
                break
            Sp[:] = 0.0
            for arguments in sums:
                add_block_products(*arguments)
            if self._remote is not None:
                self._remote.add_products(p_parts, Sp_parts)
            curvature = float(p @ Sp)
            if not curvature > 0.0:
                if k == 1:
                    return None
                break
            # as in Nash and Sofer, "Assessing a search direction within a truncated-Newton method", 1990
            value = _advance(x, r, p, Sp, b, rz / curvature)
            self.num_iterations = k
            slow = k * (model - value) < -self.model_tolerance * value
            if slow and not mixed:
                break
            model = value
            rz_next = precondition()
            if slow and rz_next < self.mixed_tolerance**2 * rz_begin:
                break
            p *= rz_next / rz
            p += z
            rz = rz_next
        self.residual = split(layout, r)
        return split(layout, x) if np.isfinite(x).all() else None

    def _preconditioner(self, blocks: Blocks, r: FloatArray, z: FloatArray) -> Callable[[], float] | None:
        """Return what writes the preconditioned residual to z, and their product; None if a block is not definite."""
        layout, coarse = self._layout, self._coarse
        r_parts, z_parts = split(layout, r), split(layout, z)
        inverses = []
        for c, kept in enumerate(layout.kept):
            inverse, block_width = np.empty(kept.count * kept.width**2), width(kept.width)
            if not _invert(blocks[c, c], inverse, block_width):
                return None
            inverses.append((inverse, r_parts[c], z_parts[c], block_width))
        if coarse is not None:
            coarse.factorize(blocks[coarse.kept_class, coarse.kept_class])

        def precondition() -> float:
            z[:] = 0.0
            for arguments in inverses:
                _apply_blocks(*arguments)
            if coarse is not None:
                coarse.correct(r_parts[coarse.kept_class], z_parts[coarse.kept_class])
            return float(r @ z)

        return precondition
