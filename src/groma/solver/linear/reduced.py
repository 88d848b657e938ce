# SPDX-License-Identifier: BSD-3-Clause
"""Three ways to solve the reduced system S x = b.

``dense``
    Cholesky (LAPACK). Best for small systems.
``sparse``
    Direct factorisation with a fill-reducing symmetric ordering: block by block where all have one size
    (:mod:`groma.solver.linear.block_cholesky`), else by numbers (SuperLU). Best for graphs of poses.
``pcg``
    Conjugate gradients, preconditioned with the inverses of the diagonal blocks and, in large systems, with the motions
    of clusters of cameras (:mod:`groma.solver.linear.coarse`). Stopped early: a Newton step needs few digits. Best for
    large systems.

Each solver is made once per layout and called once per step. It returns None when S is not positive definite; the
caller then raises the damping.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from scipy.linalg import get_lapack_funcs

from groma._numba import loop
from groma._simd import add_matvec, add_product, width
from groma._typing import FloatArray
from groma.problem.layout import Layout
from groma.solver.linear.block_cholesky import BlockCholesky
from groma.solver.linear.coarse import coarse_space

Blocks = dict[tuple[int, int], FloatArray]

#: Rates that choose between dense and pcg, measured on one core: flops of a dense factorisation, bytes of a product.
DENSE_FLOPS_PER_SECOND = 2.5e10
BYTES_PER_SECOND = 6e9
#: Iterations of conjugate gradients in a step where poses alone are kept, and otherwise (calibration, planes).
POSE_ITERATIONS, OTHER_ITERATIONS = 15, 60
#: ... and where nothing is eliminated: motions between poses are hard for conjugate gradients.
GRAPH_ITERATIONS = 100
#: Up to this many unknowns a dense factorisation costs little, and is exact: where poses alone are kept, and otherwise.
DENSE_POSE_UNKNOWNS, DENSE_OTHER_UNKNOWNS = 360, 1000

# ---------------------------------------------------------------------------------------------------------- Kernels


@loop
def _scatter(blocks, rows, columns, row_start, column_start, M):
    """Write the blocks into the upper triangle of M."""
    n, a, b = blocks.shape
    for i in range(n):
        r, c = row_start + np.int64(rows[i]) * a, column_start + np.int64(columns[i]) * b
        for k in range(a):
            for m in range(b):
                M[r + k, c + m] = blocks[i, k, m]


@loop
def _multiply(blocks, rows, columns, same_class, x_row, x_column, y_row, y_column, a_width, b_width, one):
    """Add S x to y for the blocks of one class pair, and their mirror images below the diagonal."""
    a, b = len(a_width), len(b_width)
    flat = blocks.reshape(blocks.size)
    for i in range(rows.shape[0]):
        r, c = np.int64(rows[i]), np.int64(columns[i])
        add_matvec(y_row, r * a, flat, i * a * b, x_column, c * b, a_width, b_width)
        if not same_class or r != c:
            add_product(y_column, c * b, x_row, r * a, 1, flat, i * a * b, b, a_width, one, b_width)


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


class LinearSolver(Protocol):
    """Solves S x = b for the blocks of one layout."""

    name: str

    def follow(self, states: Mapping[str, FloatArray]) -> None:
        """Take notice of the states at which the next systems are formed."""
        ...

    def solve(self, blocks: Blocks, rhs: list[FloatArray]) -> list[FloatArray] | None:
        """Return x by class, flat, or None when S is not positive definite."""
        ...


def choose(layout: Layout, name: str) -> LinearSolver:
    """Return the solver called ``name``; ``auto`` takes what should be faster for this size and fill."""
    if name == "auto":
        unknowns = layout.num_kept_unknowns
        stored = sum(
            layout.kept[a].width * layout.kept[b].width * len(rows) for (a, b), (rows, _) in layout.blocks.items()
        )
        variables = layout.problem.variables
        members = [member for kept in layout.kept for member in kept.members]
        poses_alone = all(variables[member.group].manifold.kind == "pose" for member in members)
        iterations = POSE_ITERATIONS if poses_alone else OTHER_ITERATIONS
        small = unknowns <= (DENSE_POSE_UNKNOWNS if poses_alone else DENSE_OTHER_UNKNOWNS)
        if not small and poses_alone and not layout.eliminated and len(layout.kept) == 1:
            sparse = SparseBlocks(layout)
            if sparse.flops / DENSE_FLOPS_PER_SECOND < GRAPH_ITERATIONS * 8 * stored / BYTES_PER_SECOND:
                return sparse
        dense_seconds = unknowns**3 / 3 / DENSE_FLOPS_PER_SECOND
        pcg_seconds = iterations * 8 * stored / BYTES_PER_SECOND
        name = "dense" if small or dense_seconds < pcg_seconds else "pcg"
    sparse = SparseBlocks if len(layout.kept) == 1 else Sparse
    return {"dense": Dense, "sparse": sparse, "pcg": ConjugateGradients}[name](layout)


def multiply(layout: Layout, blocks: Blocks, x: list[FloatArray]) -> list[FloatArray]:
    """Return the product of a symmetric block matrix, given by its upper blocks, with x; both by class and flat.

    A class pair may hold fewer blocks than the layout lists; they are then the first ones.
    """
    y = [np.zeros_like(part) for part in x]
    for product in _products(layout, blocks, x, y):
        _multiply(*product)
    return y


def _products(layout: Layout, blocks: Blocks, x: list[FloatArray], y: list[FloatArray]) -> list[tuple]:
    """Return the arguments of :func:`_multiply` that add the product of the blocks with x to y."""
    products = []
    for (a, b), S in blocks.items():
        rows, columns = (index[: len(S)] for index in layout.blocks[a, b])
        widths = width(layout.kept[a].width), width(layout.kept[b].width), width(1)
        products.append((S, rows, columns, a == b, x[a], x[b], y[a], y[b], *widths))
    return products


def _split(layout: Layout, x: FloatArray) -> list[FloatArray]:
    """Return the parts of a flat vector by class, without a copy."""
    return [x[c.start : c.start + c.count * c.width] for c in layout.kept]


class _Stateless:
    """A solver that needs to know nothing but the system."""

    def follow(self, states: Mapping[str, FloatArray]) -> None:
        pass


class Dense(_Stateless):
    """Cholesky factorisation of the full matrix."""

    name = "dense"

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        n = layout.num_kept_unknowns
        self._M = np.zeros((n, n))

    def solve(self, blocks: Blocks, rhs: list[FloatArray]) -> list[FloatArray] | None:  # noqa: D102
        self._M[:] = 0.0
        self.fill(blocks, self._M)
        # the upper triangle in C order is the lower triangle of the transpose, which LAPACK takes without a copy
        potrf, potrs = get_lapack_funcs(("potrf", "potrs"), (self._M,))
        factor, info = potrf(self._M.T, lower=1, overwrite_a=1, clean=0)
        if info != 0:
            return None
        x, info = potrs(factor, np.concatenate(rhs), lower=1)
        return _split(self._layout, x) if np.isfinite(x).all() else None

    def fill(self, blocks: Blocks, M: FloatArray) -> None:
        """Write the blocks into the upper triangle of M (unknowns, unknowns)."""
        layout = self._layout
        for (a, b), S in blocks.items():
            rows, columns = layout.blocks[a, b]
            _scatter(S, rows, columns, layout.kept[a].start, layout.kept[b].start, M)


class SparseBlocks(_Stateless):
    """Factorisation of the sparse matrix of blocks, where all have one size."""

    name = "sparse"

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._cholesky = BlockCholesky(layout)

    @property
    def flops(self) -> float:
        """Floating point operations of a factorisation."""
        return 2.0 * self._cholesky.num_products * self._layout.kept[0].width ** 3

    def solve(self, blocks: Blocks, rhs: list[FloatArray]) -> list[FloatArray] | None:  # noqa: D102
        if not self._cholesky.factorize(blocks[0, 0]):
            return None
        x = self._cholesky.solve(rhs[0])
        return [x] if np.isfinite(x).all() else None


class Sparse(_Stateless):
    """Factorisation of the scalar sparse matrix."""

    name = "sparse"

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        n = layout.num_kept_unknowns
        rows_of, columns_of, source = [], [], []
        position = 0
        self._order = list(layout.blocks)
        for a, b in self._order:
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
        matrix = scipy.sparse.csc_matrix((s + 1.0, (r, c)), shape=(n, n))
        matrix.sort_indices()
        self._source = (matrix.data - 1).astype(np.int64)
        self._matrix = matrix

    def solve(self, blocks: Blocks, rhs: list[FloatArray]) -> list[FloatArray] | None:  # noqa: D102
        values = np.concatenate([blocks[pair].reshape(-1) for pair in self._order])
        self._matrix.data = values[self._source]
        try:
            factor = scipy.sparse.linalg.splu(
                self._matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError:  # exactly singular
            return None
        x = factor.solve(np.concatenate(rhs))
        return _split(self._layout, x) if np.isfinite(x).all() else None


class ConjugateGradients:
    """Preconditioned conjugate gradients on the blocks."""

    name = "pcg"
    #: Stop when one more iteration improves the quadratic model by less than this share of its mean improvement.
    model_tolerance = 0.025
    #: ... and, where other blocks than cameras are kept, when the residual has fallen to this share. Planes converge in
    #: two phases, and the model seems to stand still between them.
    mixed_tolerance = 0.01
    max_iterations = 500

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._coarse = coarse_space(layout)
        self.num_iterations = 0
        #: b - S x of the last solve, by class.
        self.residual: list[FloatArray] = []

    def follow(self, states: Mapping[str, FloatArray]) -> None:  # noqa: D102
        if self._coarse is not None:
            self._coarse.follow(states)

    def solve(self, blocks: Blocks, rhs: list[FloatArray]) -> list[FloatArray] | None:  # noqa: D102
        layout, coarse = self._layout, self._coarse
        b = np.concatenate(rhs)
        x, r = np.zeros_like(b), b.copy()
        p, z, Sp = np.empty_like(b), np.empty_like(b), np.empty_like(b)
        r_parts, z_parts = _split(layout, r), _split(layout, z)
        inverses = []
        for c, kept in enumerate(layout.kept):
            inverse, block_width = np.empty(kept.count * kept.width**2), width(kept.width)
            if not _invert(blocks[c, c], inverse, block_width):
                return None
            inverses.append((inverse, r_parts[c], z_parts[c], block_width))
        if coarse is not None:
            coarse.factorize(blocks[coarse.kept_class, coarse.kept_class])
        products = _products(layout, blocks, _split(layout, p), _split(layout, Sp))

        def precondition() -> float:
            """Write the preconditioned residual to z and return their product."""
            z[:] = 0.0
            for arguments in inverses:
                _apply_blocks(*arguments)
            if coarse is not None:
                coarse.correct(r_parts[coarse.kept_class], z_parts[coarse.kept_class])
            return float(r @ z)

        rz = rz_begin = precondition()
        p[:] = z
        model = 0.0
        mixed = len(layout.kept) > 1
        for k in range(1, self.max_iterations + 1):
            if rz <= 0.0:
                break
            Sp[:] = 0.0
            for arguments in products:
                _multiply(*arguments)
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
        self.residual = r_parts
        return _split(layout, x) if np.isfinite(x).all() else None
