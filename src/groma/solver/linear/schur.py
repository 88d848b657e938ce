# SPDX-License-Identifier: BSD-3-Clause
r"""Elimination of landmarks, the reduced system, and back-substitution.

The damped normal equations

.. math:: \begin{bmatrix} H + \lambda D_c & W^\top \\ W & V + \lambda D_l \end{bmatrix}
          \begin{bmatrix} \delta_c \\ \delta_l \end{bmatrix} = -\begin{bmatrix} g_c \\ g_l \end{bmatrix},
          \qquad D = \mathrm{diag}(J^\top J)

are reduced to the kept blocks; some landmarks take a share of the damping, see :data:`LANDMARK_DAMPING`. With
:math:`N = -(V + \lambda D_l)^{-1}`, block by block,

.. math:: S = H + \lambda D_c + W^\top N W, \qquad S\,\delta_c = -(g_c + W^\top N g_l), \qquad
          \delta_l = N (g_l + W \delta_c).

Cost per landmark with n incidences: one inverse of size 3 or 4, n products ``N W`` and n(n+1)/2 block products that are
added to S. The block products dominate; they run in explicit vectors (:mod:`groma._simd`). Two landmarks
may touch the same block, so every thread adds to a copy of S (:class:`groma.problem.parallel.OrderedSums`).
"""

from __future__ import annotations

import numpy as np

from groma._numba import loop, unrolled_loop
from groma._simd import add_matvec, add_product, set_product, width, width_for
from groma._typing import FloatArray, IntArray
from groma.problem.layout import Chunk, Eliminated, Layout
from groma.problem.linearization import NormalEquations
from groma.problem.parallel import OrderedSums, Spans, sum_of
from groma.solver.linear.blocks import joined

#: Diagonal entries are damped as if they were at least this large, so that nothing is divided by zero. It is no
#: tolerance: entries change with the square of the unit of length, and what the solver does must not.
MIN_DIAGONAL = 1e-100
#: Curvatures count as at least this, and as at least this share of the squared gradient (derived from the range of
#: numbers: a ratio and its product with a curvature stay inside).
SMALLEST = 1e-200
#: Damping of landmarks by kind, relative to that of all other variables; 1 where a kind is not named. The damping is
#: measured by the diagonal, which says little about the depth of a far point: along its rays the cost is flatter by the
#: square of the angle between them, and a damping that suits the cameras holds the point back for many steps.
LANDMARK_DAMPING = {"point": 0.03}
#: A pivot below this fraction of its diagonal entry means a direction the data do not determine.
PIVOT_TOLERANCE = 1e-13

# ---------------------------------------------------------------------------------------------------------- Kernels


@unrolled_loop
def invert_blocks(V, g, damping, step, begin, end, N, h, singular, steepest, dof):
    """N = -(V + damping D)^-1 and h = N g for landmarks begin..end; undetermined directions do not move.

    The damping of landmark p is ``damping[p * step]``: one for all (step 0) or one for each (step 1). So is what is
    written: ``singular``, how many have an undetermined direction, and ``steepest``, the largest component of the
    gradient, squared over its diagonal entry of V; for all, in addition to what is there. Both are in cache here.
    """
    n = len(dof)
    L = np.zeros((n, n))
    inverse = np.zeros((n, n))
    pivots = np.zeros(n)
    count, slope = 0, 0.0 if step else steepest[0]
    for p in range(begin, end):
        v0 = p * n * n
        factor = damping[p * step]
        deficient = False
        if step:
            slope = 0.0
        for j in range(n):
            square = g[p * n + j] * g[p * n + j]
            if not square <= slope * V[v0 + j * n + j] and slope == slope:
                # What is not a number stays.
                slope = square / max(V[v0 + j * n + j], SMALLEST * max(square, 1.0))
        # V + damping D = L diag(pivots) L^T with a unit lower triangle
        for j in range(n):
            diagonal = V[v0 + j * n + j]
            diagonal += factor * max(diagonal, MIN_DIAGONAL)
            pivot = diagonal
            for k in range(j):
                pivot -= L[j, k] * L[j, k] * pivots[k]
            if pivot > PIVOT_TOLERANCE * diagonal and V[v0 + j * n + j] > 0.0:
                pivots[j] = pivot
                for i in range(j + 1, n):
                    total = V[v0 + i * n + j]
                    for k in range(j):
                        total -= L[i, k] * L[j, k] * pivots[k]
                    L[i, j] = total / pivot
            else:
                deficient = True
                pivots[j] = 0.0
                for i in range(j + 1, n):
                    L[i, j] = 0.0
        count += deficient
        if step:
            singular[p], steepest[p] = deficient, slope
        for j in range(n):  # inverse of L, column by column
            for i in range(j + 1, n):
                total = -L[i, j]
                for k in range(j + 1, i):
                    total -= L[i, k] * inverse[k, j]
                inverse[i, j] = total
        for i in range(n):
            for j in range(i, n):
                total = 0.0
                for k in range(j, n):
                    if pivots[k] > 0.0:
                        left = 1.0 if k == i else inverse[k, i]
                        right = 1.0 if k == j else inverse[k, j]
                        total -= left * right / pivots[k]
                N[v0 + i * n + j] = total
                N[v0 + j * n + i] = total
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += N[v0 + i * n + j] * g[p * n + j]
            h[p * n + i] = total
    if not step:
        singular[0], steepest[0] = singular[0] + count, slope


@loop
def _eliminate(pointer, block, W, incidence, N, h, begin, end, slots, pair_pointer, Y, S, g, dof, c_width, one):
    """S += W^T N W and g += W^T h for one class of kept blocks; W begins with the block of ``incidence``."""
    dl, dc = len(dof), len(c_width)
    w_size, s_size = dl * dc, dc * dc
    for p in range(begin, end):
        s = pair_pointer[p]
        first, last = pointer[p], pointer[p + 1]
        for k in range(first, last):
            c, at = np.int64(block[k]), (k - incidence) * w_size
            set_product(Y, 0, N, p * (dl * dl), dl, W, at, dc, dof, dof, c_width)
            add_product(g, c * dc, h, p * dl, 1, W, at, dc, dof, one, c_width)
            for m in range(k, last):
                add_product(
                    S, np.int64(slots[s]) * s_size, Y, 0, dc, W, (m - incidence) * w_size, dc, dof, c_width, c_width
                )
                s += 1


@loop
def _eliminate_cross(pointer_a, W_a, first_a, pointer_b, W_b, first_b, N, begin, end, slots, pair_pointer, Y, S,
                     dof, a_width, b_width):  # fmt: skip
    """S_ab += W_a^T N W_b for two classes of kept blocks."""
    dl, da, db = len(dof), len(a_width), len(b_width)
    for p in range(begin, end):
        s = pair_pointer[p]
        for k in range(pointer_b[p], pointer_b[p + 1]):
            set_product(Y, 0, N, p * (dl * dl), dl, W_b, (k - first_b) * (dl * db), db, dof, dof, b_width)
            for m in range(pointer_a[p], pointer_a[p + 1]):
                target = np.int64(slots[s]) * (da * db)
                add_product(S, target, W_a, (m - first_a) * (dl * da), da, Y, 0, db, dof, a_width, b_width)
                s += 1


@loop
def _add_incident_steps(pointer, block, W, delta_c, begin, end, t, dof, c_width):
    """T += W delta_c for landmarks begin..end."""
    dl, dc = len(dof), len(c_width)
    for p in range(begin, end):
        for k in range(pointer[p], pointer[p + 1]):
            add_matvec(t, p * dl, W, k * (dl * dc), delta_c, np.int64(block[k]) * dc, dof, c_width)


@unrolled_loop
def _landmark_steps(N, t, V, g, begin, end, delta, dof):
    """Delta = N t for landmarks begin..end; return delta D delta and g delta."""
    n = len(dof)
    squares, slope = 0.0, 0.0
    for p in range(begin, end):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += N[p * n * n + i * n + j] * t[p * n + j]
            delta[p * n + i] = total
            squares += max(V[p * n * n + i * n + i], MIN_DIAGONAL) * total * total
            slope += g[p * n + i] * total
    return squares, slope


# ----------------------------------------------------------------------------------------------------------- Public


class ReducedSystem:
    """The blocks of S and the right-hand side, and the way back to the landmarks."""

    def __init__(self, equations: NormalEquations) -> None:
        self.equations = equations
        self.layout: Layout = equations.layout
        layout = self.layout
        shares = len(equations.shares)
        self.N = [np.empty_like(V) for V in equations.V]
        self.h = [np.empty_like(g) for g in equations.g_landmarks]
        sizes = {
            pair: len(rows) * layout.kept[pair[0]].width * layout.kept[pair[1]].width
            for pair, (rows, _) in layout.blocks.items()
        }
        self._sums = OrderedSums(sizes, [_spans(layout, share) for share in equations.shares])
        self._last = [next((c for c in reversed(s) if c.eliminated is not None), None) for s in equations.shares]
        self._g = [[np.zeros(c.count * c.width) for c in layout.kept] for _ in range(shares)]
        widest = max([c.width for c in layout.kept], default=0)
        tallest = max([e.dof for e in layout.eliminated], default=0)
        self._Y = [np.zeros(widest * tallest) for _ in range(shares)]
        self._products = _products(layout)
        kinds = [layout.problem.variables[e.group].manifold.kind for e in layout.eliminated]
        self._landmark_damping = [LANDMARK_DAMPING.get(kind, 1.0) for kind in kinds]
        self._singular, self._steepest = np.zeros((shares, 1), np.int64), np.zeros((shares, 1))
        self.num_singular_landmarks = 0
        #: Of the last steps of the landmarks: the sums of delta D delta, with D as their damping takes it, and g delta.
        self.landmark_squares = self.landmark_slope = 0.0

    def clear(self) -> None:
        """Set all sums to zero."""
        self._sums.clear()
        for gradients in self._g:
            for g in gradients:
                g[:] = 0.0
        self._singular[:], self._steepest[:] = 0, 0.0

    def eliminate_chunk(self, share: int, chunk: Chunk, damping: float) -> None:
        """Eliminate the landmarks of one chunk of a share, whose chunks follow in their order.

        Where the equations are compact, this must follow the linearisation of the chunk: its W is there only then.
        """
        e = chunk.eliminated
        if e is None:
            return
        equations, (dof, squares, crosses) = self.equations, self._products[e]
        N, h, S, Y = self.N[e], self.h[e], self._sums.of(share), self._Y[share]
        own = np.array([damping * self._landmark_damping[e]])
        invert_blocks(
            equations.V[e], equations.g_landmarks[e], own, 0, chunk.begin, chunk.end, N, h,
            self._singular[share], self._steepest[share], dof,
        )  # fmt: skip
        for c, pointer, block, pairs, widths in squares:
            _eliminate(
                pointer, block, *equations.blocks_of_chunk(share, chunk, c), N, h, chunk.begin, chunk.end,
                *pairs, Y, S[c, c], self._g[share][c], *widths,
            )  # fmt: skip
        for a, pointer_a, b, pointer_b, pairs, widths in crosses:
            _eliminate_cross(
                pointer_a, *equations.blocks_of_chunk(share, chunk, a),
                pointer_b, *equations.blocks_of_chunk(share, chunk, b),
                N, chunk.begin, chunk.end, *pairs, Y, S[a, b], *widths,
            )  # fmt: skip
        if chunk is self._last[share]:
            self._sums.end(share)

    def eliminate(self, damping: float) -> None:
        """Eliminate all landmarks again, for another damping at the same linearisation; not where that is compact."""
        self.clear()

        def work(share: int) -> None:
            for chunk in self.equations.shares[share]:
                self.eliminate_chunk(share, chunk, damping)

        self.equations.workers.map(work, len(self.equations.shares))

    def assemble(self, damping: float) -> None:
        """Add H and the damping to what landmarks left: the blocks ``S`` and the right-hand side ``rhs``."""
        layout = self.layout
        self.num_singular_landmarks = int(self._singular.sum())
        self.S: dict[tuple[int, int], FloatArray] = {}
        for pair, S in self._sums.total().items():
            a, b = layout.kept[pair[0]].width, layout.kept[pair[1]].width
            direct = layout.num_direct[pair] * a * b
            S[:direct] += self.equations.H[pair]
            S = S.reshape(-1, a, b)
            if pair[0] == pair[1]:
                diagonal = self.diagonal(pair[0])
                blocks = S[: layout.kept[pair[0]].count]
                steps = np.arange(a)
                blocks[:, steps, steps] += damping * np.maximum(diagonal, MIN_DIAGONAL)
                held = diagonal == 0.0
                if held.any():
                    blocks[:, steps, steps] += held
            self.S[pair] = S
        reduced = [sum_of([parts[c] for parts in self._g], self.equations.workers) for c in range(len(layout.kept))]
        self.rhs = [-(a + b) for a, b in zip(self.equations.g_kept, reduced, strict=True)]

    def diagonal(self, c: int) -> FloatArray:
        """Return the diagonal of H for one class, (count, width)."""
        kept = self.layout.kept[c]
        H = self.equations.H[c, c][: kept.count * kept.width**2].reshape(kept.count, kept.width, kept.width)
        return np.einsum("nii->ni", H)

    def flat_diagonal(self) -> FloatArray:
        """Return the diagonal of H, (unknowns,)."""
        return joined(self.diagonal(c) for c in range(len(self.layout.kept)))

    def largest_landmark_slope(self) -> float:
        """Return the largest component of the landmarks' gradient over the root of its diagonal entry of V."""
        return float(np.sqrt(np.max(self._steepest)))

    def incident_products(self, delta_kept: list[FloatArray]) -> list[FloatArray]:
        """Return W delta_c for the landmarks of each eliminated group, (count * dof,)."""
        products = [np.zeros_like(g) for g in self.equations.g_landmarks]
        for e, eliminated in enumerate(self.layout.eliminated):
            for c, pointer, block, _, widths in self._products[e][1]:
                _add_incident_steps(
                    pointer, block, self.equations.W[e][c], delta_kept[c], 0, eliminated.count, products[e], *widths[:2]
                )
        return products

    def landmark_steps(self, delta_kept: list[FloatArray]) -> list[FloatArray]:
        """Back-substitute: steps of the landmarks of each eliminated group, (count * dof,)."""
        deltas = [np.empty_like(g) for g in self.equations.g_landmarks]
        sums = [g.copy() for g in self.equations.g_landmarks]

        def work(share: int) -> tuple[float, float]:
            squares, slope = 0.0, 0.0
            for chunk in self.equations.shares[share]:
                e = chunk.eliminated
                if e is None:
                    continue
                dof, incidences, _ = self._products[e]
                for c, pointer, block, _, widths in incidences:
                    _add_incident_steps(
                        pointer, block, self.equations.W[e][c], delta_kept[c], chunk.begin, chunk.end, sums[e],
                        *widths[:2],
                    )  # fmt: skip
                more = _landmark_steps(
                    self.N[e], sums[e], self.equations.V[e], self.equations.g_landmarks[e],
                    chunk.begin, chunk.end, deltas[e], dof,
                )  # fmt: skip
                squares, slope = squares + self._landmark_damping[e] * more[0], slope + more[1]
            return squares, slope

        parts = self.equations.workers.map(work, len(self.equations.shares))
        self.landmark_squares, self.landmark_slope = (sum(part[i] for part in parts) for i in range(2))
        return deltas


def _products(layout: Layout) -> list[tuple]:
    """Return of each group of landmarks its width, and the arguments of both loops that all of its chunks share."""
    count = max((int(i.pair_pointer[-1]) for e in layout.eliminated for i in e.incidences.values()), default=0)
    products = []
    for e in layout.eliminated:
        squares, crosses = [], []
        for c, i in e.incidences.items():
            sized = width_for(int(i.pair_pointer[-1]), count)
            widths = sized(e.dof), sized(layout.kept[c].width), sized(1)
            squares.append((c, i.pointer, i.block, (i.pair_slots, i.pair_pointer), widths))
        for (a, b), pairs in e.cross.items():
            sized = width_for(int(pairs[1][-1]), count)
            widths = sized(e.dof), sized(layout.kept[a].width), sized(layout.kept[b].width)
            crosses.append((a, e.incidences[a].pointer, b, e.incidences[b].pointer, pairs, widths))
        products.append((width(e.dof), squares, crosses))
    return products


def _spans(layout: Layout, share: list[Chunk]) -> dict[tuple[int, int], Spans]:
    """Return which numbers (begin, end) of each array of blocks the landmarks of a share add to, if it has any.

    Blocks that factors fill directly come first, the others in the order of the landmarks that fill them.
    """
    if all(chunk.eliminated is None for chunk in share):
        return {}
    spans = {}
    for pair, direct in layout.num_direct.items():
        begin, end = len(layout.blocks[pair][0]), direct
        for e, eliminated in enumerate(layout.eliminated):
            slots = _slots(eliminated, pair, [chunk for chunk in share if chunk.eliminated == e])
            if len(slots) and slots.max() >= direct:
                end = max(end, int(slots.max()) + 1)
                begin = min(begin, int((slots - direct).view(f"u{slots.itemsize}").min()) + direct)  # direct ones wrap
        size = layout.kept[pair[0]].width * layout.kept[pair[1]].width
        spans[pair] = [(0, direct * size), (begin * size, max(begin, end) * size)]
    return spans


def _slots(eliminated: Eliminated, pair: tuple[int, int], chunks: list[Chunk]) -> IntArray:
    """Blocks of one pair of classes that the landmarks of consecutive chunks add to."""
    if pair in eliminated.cross:
        slots, pointer = eliminated.cross[pair]
    elif pair[0] == pair[1] and pair[0] in eliminated.incidences:
        slots, pointer = eliminated.incidences[pair[0]].pair_slots, eliminated.incidences[pair[0]].pair_pointer
    else:
        return np.zeros(0, np.int32)
    return slots[pointer[chunks[0].begin] : pointer[chunks[-1].end]] if chunks else slots[:0]
