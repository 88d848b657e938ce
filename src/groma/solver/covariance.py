# SPDX-License-Identifier: BSD-3-Clause
r"""Marginal covariances of the variables of a solved problem.

With the reduced system S of the undamped normal equations (see :mod:`groma.solver.schur`) the covariance of the kept
blocks is :math:`\Sigma_c = S^{-1}`, and that of a landmark, with :math:`B = V^{-1} W`,

.. math:: \Sigma_l = V^{-1} + B\,\Sigma_c\,B^\top .

Every covariance refers to the increments of the chart the variable is stored in, and to unit weight: the square root
information of the factors must be that of the noise. Weights of robust losses count as they are at the solution.

Gauge. When the scene is free to move, S is singular. Either hold variables constant, or take ``gauge="inner"``: the
covariance of least trace among all choices of frame and scale, :math:`\Sigma_c = (S + G G^\top)^{-1} - G G^\top` with
G an orthonormal basis of the free world motions, restricted to the kept blocks.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from groma._numba import loop
from groma._typing import FloatArray, IntArray
from groma.errors import InputError, ProblemError
from groma.problem._parallel import Workers
from groma.problem.gauge import gauge_directions
from groma.problem.lay_out import lay_out
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.problem import Problem
from groma.solver.linear import Dense
from groma.solver.schur import ReducedSystem

#: A world motion counts as free when the cost it causes is below this fraction of what its size would suggest.
FREE_TOLERANCE = 1e-9

# ---------------------------------------------------------------------------------------------------------- Kernels


@loop
def _add_landmark_covariances(
    landmarks, N, dl, pointer_a, block_a, W_a, start_a, da, pointer_b, block_b, W_b, start_b, db, sigma, out
):
    """Out += (N W_a) Sigma_ab (N W_b)^T for the listed landmarks."""
    left, right = np.zeros((dl, da)), np.zeros((dl, db))
    for i in range(landmarks.shape[0]):
        p = landmarks[i]
        for k in range(pointer_a[p], pointer_a[p + 1]):
            for r in range(dl):
                for c in range(da):
                    total = 0.0
                    for m in range(dl):
                        total += N[(p * dl + r) * dl + m] * W_a[(k * dl + m) * da + c]
                    left[r, c] = total
            row = start_a + block_a[k] * da
            for q in range(pointer_b[p], pointer_b[p + 1]):
                for r in range(dl):
                    for c in range(db):
                        total = 0.0
                        for m in range(dl):
                            total += N[(p * dl + r) * dl + m] * W_b[(q * dl + m) * db + c]
                        right[r, c] = total
                column = start_b + block_b[q] * db
                for r in range(dl):
                    for s in range(dl):
                        total = 0.0
                        for c in range(da):
                            for e in range(db):
                                total += left[r, c] * sigma[row + c, column + e] * right[s, e]
                        out[i, r, s] += total


# ----------------------------------------------------------------------------------------------------------- Public


class Covariances:
    """Marginal covariances at the states of a problem.

    Parameters
    ----------
    problem
        A problem at its solution.
    gauge
        ``"held"``: the variables held constant fix the frame; ``"inner"``: inner constraints on the kept blocks.
    eliminate
        As for :func:`groma.solver.levenberg_marquardt.solve`.

    Raises
    ------
    ProblemError
        If the normal equations are rank deficient in the chosen gauge.
    """

    def __init__(self, problem: Problem, gauge: str = "held", eliminate: str | tuple[str, ...] = "auto") -> None:
        if gauge not in ("held", "inner"):
            raise InputError(f"gauge must be 'held' or 'inner'; got {gauge!r}.")
        self.problem = problem
        self._layout = layout = lay_out(problem, eliminate)
        states = to_solver_order(layout)
        self._equations = NormalEquations(layout, Workers(1))
        self._system = ReducedSystem(self._equations)
        self._equations.linearize(states, self._equations.prepare(states))
        self._system.eliminate(0.0)
        self._position = {e.group: np.argsort(e.order) for e in layout.eliminated}
        self._sigma = self._kept_covariance(gauge) if layout.kept else np.zeros((0, 0))

    def _kept_covariance(self, gauge: str) -> FloatArray:
        layout = self._layout
        self._system.assemble(0.0)
        S = np.zeros((layout.num_kept_unknowns,) * 2)
        Dense(layout).fill(self._system.S, S)
        S = np.triu(S) + np.triu(S, 1).T
        held = np.concatenate([self._system.diagonal(c).reshape(-1) == 0.0 for c in range(len(layout.kept))])
        scale = np.sqrt(np.maximum(np.diag(S), 1e-300))
        G = free_motions(layout, self._system, S)
        if gauge == "inner":
            S = S + (scale**2).mean() * G @ G.T
        scaled = S / scale[:, None] / scale[None, :]
        values, vectors = scipy.linalg.eigh(scaled)
        tolerance = len(S) * 1e-14 * max(values.max(initial=0.0), 1e-300)
        deficiency = int((values < max(tolerance, 1e-12)).sum())
        if deficiency:
            free = G.shape[1] if gauge == "held" else 0
            what = f"; {free} of them are motions of the whole scene" if free else ""
            raise ProblemError(
                f"The normal equations are rank deficient by {deficiency}{what}. Hold variables constant, pass "
                "gauge='inner', or add priors."
            )
        sigma = (vectors / values) @ vectors.T / scale[:, None] / scale[None, :]
        if gauge == "inner":
            sigma = sigma - (G @ G.T) / (scale**2).mean()
        sigma[held] = 0.0
        sigma[:, held] = 0.0
        return sigma

    def of(self, group: str, index: IntArray | int | None = None) -> FloatArray:
        """Return the covariances (len(index), dof, dof) of variables of a group; all of them by default.

        Variables held constant have covariance zero.
        """
        if group not in self.problem.variables:
            raise InputError(f"There is no group {group!r}; the problem has {sorted(self.problem.variables)}.")
        variables = self.problem.variables[group]
        index = np.arange(len(variables)) if index is None else np.atleast_1d(np.asarray(index))
        if len(index) and (index.min() < 0 or index.max() >= len(variables)):
            raise InputError(
                f"Group {group!r} has variables 0 to {len(variables) - 1}; asked for {index.tolist()[:5]}."
            )
        dof = variables.manifold.dof
        for c in self._layout.kept:
            for member in c.members:
                if member.group == group:
                    start = c.start + member.blocks(index) * c.width + member.offset
                    rows = start[:, None] + np.arange(dof)
                    return self._sigma[rows[:, :, None], rows[:, None, :]]
        for e, eliminated in enumerate(self._layout.eliminated):
            if eliminated.group == group:
                return self._of_landmarks(e, self._position[group][index])
        return np.zeros((len(index), dof, dof))

    def _of_landmarks(self, e: int, landmarks: IntArray) -> FloatArray:
        layout, equations = self._layout, self._equations
        eliminated = layout.eliminated[e]
        dl, N = eliminated.dof, self._system.N[e]
        out = -N.reshape(-1, dl, dl)[landmarks]
        for a, first in eliminated.incidences.items():
            for b, second in eliminated.incidences.items():
                A, B = layout.kept[a], layout.kept[b]
                _add_landmark_covariances(
                    landmarks, N, dl, first.pointer, first.block, equations.W[e][a], A.start, A.width,
                    second.pointer, second.block, equations.W[e][b], B.start, B.width, self._sigma, out,
                )  # fmt: skip
        return out


def free_motions(layout: Layout, system: ReducedSystem, S: FloatArray) -> FloatArray:
    """Orthonormal basis (unknowns, k) of the world motions that the reduced system does not see, k at most 7."""
    directions = np.zeros((7, layout.num_kept_unknowns))
    for kept in layout.kept:
        blocks = np.zeros((7, kept.count, kept.width))
        for member in kept.members:
            group = layout.problem.variables[member.group]
            part = gauge_directions(group.manifold, group.state)
            target = np.arange(kept.count) if member.block_of is None else member.block_of
            blocks[:, target[: part.shape[1]], member.offset : member.offset + member.dof] = part
        directions[:, kept.start : kept.start + kept.count * kept.width] = blocks.reshape(7, -1)
    held = np.concatenate([system.diagonal(c).reshape(-1) == 0.0 for c in range(len(layout.kept))])
    if held.any():  # only combinations that leave the held coordinates alone are free
        _, values, combinations = np.linalg.svd(directions[:, held].T, full_matrices=True)
        rank = int((values > 1e-9 * max(values.max(initial=0.0), 1e-300)).sum())
        directions = combinations[rank:] @ directions
    U, values, _ = np.linalg.svd(directions.T, full_matrices=False)
    Q = U[:, values > 1e-9 * max(values.max(initial=0.0), 1e-300)]
    inner = Q.T @ S @ Q
    values, vectors = np.linalg.eigh(inner)
    expected = np.einsum("ni,n,ni->i", Q @ vectors, np.diag(S), Q @ vectors)
    return Q @ vectors[:, values < FREE_TOLERANCE * np.maximum(expected, 1e-300)]
