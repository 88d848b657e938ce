# SPDX-License-Identifier: BSD-3-Clause
r"""Small fronts without children, many at once.

Where points are tied to lines, every line is a block of the reduced system, and a front of its own: a few unknowns (1)
and those of the cameras that see it (2). Of such a *leaf* only the columns :math:`F_{11}, F_{21}` of its front hold
anything, so :math:`F_{22}` is not made: :math:`-L_{21}L_{21}^\top` is added to the front of the parent at once, and
:math:`Z_{22}` is read there. The formulas are those of :mod:`groma.solver.linear.fronts`.

All leaves are stored in flat arrays: unknowns, and columns of L, row by row, with pointers to those of each leaf.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._numba import kernel, loop
from groma._typing import FloatArray, IntArray
from groma.solver.linear.contract import PIVOT_TOLERANCE

# ---------------------------------------------------------------------------------------------------------- Kernels


@kernel
def _cholesky(panel, n):
    """Replace the first n rows of a panel (m, n) by their lower Cholesky factor; False if there is none."""
    for r in range(n):
        for c in range(r + 1):
            total = panel[r, c]
            for k in range(c):
                total -= panel[r, k] * panel[c, k]
            if r > c:
                panel[r, c] = total / panel[c, c]
            elif total > PIVOT_TOLERANCE * panel[r, r] and total < np.inf:
                panel[r, r] = np.sqrt(total)
            else:
                return False
        for c in range(r + 1, n):
            panel[r, c] = 0.0
    return True


@loop
def eliminate_leaves(leaves, size, first, at, entries, place, shape, values, in_parent, L, F):
    """Eliminate leaves of one parent, whose front is F; return False if one of them is not positive definite.

    ``entries`` are pointers to the blocks of each leaf: where they begin in ``values``, their first row and column in
    the front (``place``), and their height and width (``shape``).
    """
    for f in leaves:
        n, m = size[f], first[f + 1] - first[f]
        panel = L[at[f] : at[f] + m * n].reshape((m, n))
        panel[:] = 0.0
        for e in range(entries[f], entries[f + 1]):
            begin, row, column = place[e, 0], place[e, 1], place[e, 2]
            for r in range(shape[e, 0]):
                for c in range(shape[e, 1]):
                    value = values[begin + r * shape[e, 1] + c]
                    if column + c < n:
                        panel[row + r, column + c] = value
                    if row + r < n:
                        panel[column + c, row + r] = value
        if not _cholesky(panel, n):
            return False
        index = in_parent[first[f] + n : first[f + 1]]
        for r in range(n, m):
            for c in range(n):
                for k in range(c):
                    panel[r, c] -= panel[r, k] * panel[c, k]
                panel[r, c] /= panel[c, c]
            i = index[r - n]
            for s in range(n, r + 1):
                total = 0.0
                for k in range(n):
                    total += panel[r, k] * panel[s, k]
                j = index[s - n]
                F[i, j] -= total
                if i != j:
                    F[j, i] -= total
    return True


@loop
def invert_leaves(leaves, size, first, at, entries, place, shape, in_parent, L, Z, result):
    """Write the blocks of the inverse in leaves of one parent, whose part of the inverse is Z, to ``result``."""
    for f in leaves:
        n, m = size[f], first[f + 1] - first[f]
        panel = L[at[f] : at[f] + m * n].reshape((m, n))
        index = in_parent[first[f] + n : first[f + 1]]
        inverse = np.zeros((n, n))
        for c in range(n):
            for r in range(c, n):
                total = 1.0 if r == c else 0.0
                for k in range(c, r):
                    total -= panel[r, k] * inverse[k, c]
                inverse[r, c] = total / panel[r, r]
        X, columns = np.zeros((n, m - n)), np.zeros((m, n))  # (L21 L11^-1)^T, and the columns of the inverse
        for i in range(m - n):
            for c in range(n):
                for k in range(c, n):
                    X[c, i] += panel[n + i, k] * inverse[k, c]
        row = np.empty(m - n)
        for i in range(m - n):
            for j in range(m - n):
                row[j] = Z[index[i], index[j]]
            for k in range(n):
                total = 0.0
                for j in range(m - n):
                    total += row[j] * X[k, j]
                columns[n + i, k] = -total
        for r in range(n):
            for c in range(r + 1):
                total = 0.0
                for k in range(r, n):
                    total += inverse[k, r] * inverse[k, c]
                for i in range(m - n):
                    total -= X[r, i] * columns[n + i, c]
                columns[r, c] = columns[c, r] = total
        for e in range(entries[f], entries[f + 1]):
            begin, row, column = place[e, 0], place[e, 1], place[e, 2]
            for r in range(shape[e, 0]):
                for c in range(shape[e, 1]):
                    inside = column + c < n
                    value = columns[row + r, column + c] if inside else columns[column + c, row + r]
                    result[begin + r * shape[e, 1] + c] = value


@loop
def solve_leaves(leaves, size, first, at, unknowns, L, x, back):
    """Replace the unknowns (n, k) of leaves by those of L^-1 x, less what this takes from others; or of L^-T x."""
    for f in leaves:
        n, m = size[f], first[f + 1] - first[f]
        panel = L[at[f] : at[f] + m * n].reshape((m, n))
        own = unknowns[first[f] : first[f + 1]]
        for q in range(x.shape[1]):
            if not back:
                for r in range(m):
                    for k in range(min(r, n)):
                        x[own[r], q] -= panel[r, k] * x[own[k], q]
                    if r < n:
                        x[own[r], q] /= panel[r, r]
            else:
                for c in range(n - 1, -1, -1):
                    for r in range(c + 1, m):
                        x[own[c], q] -= panel[r, c] * x[own[r], q]
                    x[own[c], q] /= panel[c, c]


# ----------------------------------------------------------------------------------------------------------- Public


@dataclass
class Leaves:
    """The leaves among the fronts of a layout, in flat arrays: see the module."""

    #: (M,) numbers of the leaves among all N fronts, which the other arrays are of.
    numbers: IntArray
    #: (N,) unknowns that each eliminates, (N + 1,) pointers to its unknowns, and (N + 1,) to its columns of L.
    size: IntArray
    first: IntArray
    at: IntArray
    #: Unknowns in the reduced system, and in the front of the parent; the latter mean nothing for eliminated ones.
    unknowns: IntArray
    in_parent: IntArray
    #: (N + 1,) pointers to the blocks of each leaf, (E, 3) where these lie and (E, 2) their shapes.
    entries: IntArray
    place: IntArray
    shape: IntArray
    #: Numbers of L.
    L: FloatArray

    def __len__(self) -> int:
        return len(self.numbers)

    def eliminate(self, leaves: IntArray, values: FloatArray, F: FloatArray) -> bool:
        """Eliminate some leaves of one parent, with front F, from the values of all blocks of S."""
        return bool(
            eliminate_leaves(
                leaves, self.size, self.first, self.at, self.entries, self.place, self.shape, values, self.in_parent,
                self.L, F,
            )
        )  # fmt: skip

    def invert(self, leaves: IntArray, Z: FloatArray, result: FloatArray) -> None:
        """Write the inverse on the blocks of some leaves of one parent, with the inverse Z of its front."""
        invert_leaves(
            leaves, self.size, self.first, self.at, self.entries, self.place, self.shape, self.in_parent, self.L, Z,
            result,
        )  # fmt: skip

    def solve(self, x: FloatArray, back: bool = False) -> None:
        """Substitute forward in all leaves, or back."""
        if len(self):
            solve_leaves(self.numbers, self.size, self.first, self.at, self.unknowns, self.L, x, back)
