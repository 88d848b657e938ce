# SPDX-License-Identifier: BSD-3-Clause
r"""The reduced system in units in which its diagonal is one, and the directions it determines least.

With :math:`d = \sqrt{\mathrm{diag}\,S}` the scaled system :math:`S' = S/(d\,d^\top)` has eigenvalues that can be
compared with one, whatever the units of angles, lengths and focal lengths. An eigenvalue near zero is a combination
of unknowns that the data do not determine: its *mode*.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.problem.layout import Layout
from groma.solver.linear.blocks import Blocks, product
from groma.solver.linear.fronts import Fronts

#: Eigenvalues of the scaled system below this count as zero: rounding reaches about 1e-13.
NULL_TOLERANCE = 1e-11
#: Added to the diagonal while modes are sought; raised by tens until the factorisation succeeds (cost: accuracy of
#: modes that are nearly zero anyhow).
SHIFT, MAX_SHIFT = 1e-10, 1e-5
#: Modes sought at a time, and rounds of inverse iteration (cost: time and memory).
MODES, ROUNDS = 16, 4


@dataclass(frozen=True)
class Modes:
    """Smallest eigenvalues of the scaled system, ascending, and their eigenvectors (unknowns, k) of unit length."""

    values: FloatArray
    vectors: FloatArray

    @property
    def num_null(self) -> int:
        """Number of eigenvalues that count as zero; all of them if there may be more."""
        return int((self.values < NULL_TOLERANCE).sum())


def scaled(layout: Layout, S: Blocks) -> tuple[Blocks, FloatArray]:
    """Return S with a diagonal of ones, and the square root (unknowns,) of its diagonal."""
    size = np.ones(layout.num_kept_unknowns)
    for c, kept in enumerate(layout.kept):
        diagonal = np.einsum("nii->ni", S[c, c][: kept.count]).reshape(-1)
        size[kept.unknowns] = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    return divided(layout, S, size), size


def divided(layout: Layout, S: Blocks, size: FloatArray) -> Blocks:
    """Divide every block by the sizes of its rows and of its columns."""
    parts = [kept.blocks_of(size) for kept in layout.kept]
    result = {}
    for (a, b), values in S.items():
        rows, columns = layout.blocks[a, b]
        result[a, b] = values / parts[a][rows][:, :, None] / parts[b][columns][:, None, :]
    return result


def smallest(layout: Layout, fronts: Fronts, S: Blocks, count: int = MODES) -> Modes:
    """Find the smallest eigenvalues of a scaled system by inverse subspace iteration."""
    n = layout.num_kept_unknowns
    count = min(count, n)
    X = np.linalg.qr(np.random.default_rng(0).normal(size=(n, count)))[0]
    shift = SHIFT
    while not fronts.factorize(_shifted(layout, S, shift)):
        shift *= 10.0  # cost: accuracy, see above
        if shift > MAX_SHIFT:  # not a positive matrix at all: a degenerate linearisation
            return Modes(np.zeros(0), np.zeros((n, 0)))
    for _ in range(ROUNDS if count < n else 1):
        X = np.linalg.qr(fronts.solve(X))[0]
    SX = np.column_stack([product(layout, S, X[:, k]) for k in range(count)])
    values, vectors = np.linalg.eigh(0.5 * (X.T @ SX + SX.T @ X))
    return Modes(values, X @ vectors)


def _shifted(layout: Layout, S: Blocks, shift: float) -> Blocks:
    result = dict(S)
    for c, kept in enumerate(layout.kept):
        blocks = S[c, c].copy()
        steps = np.arange(kept.width)
        blocks[: kept.count, steps, steps] += shift
        result[c, c] = blocks
    return result
