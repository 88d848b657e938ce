# SPDX-License-Identifier: BSD-3-Clause
r"""The eliminated variables of a linearised problem: how they follow the kept ones, and their covariances.

With the blocks V of the landmarks and W of their incidences with kept variables (see :mod:`groma.solver.linear.schur`),
a landmark that is not held follows an increment x of the kept variables by :math:`B\,x`, :math:`B = -V^{-1} W`, and

.. math:: \Sigma_l = V^{-1} + B\,\Sigma_c\,B^\top

is its covariance, which needs :math:`\Sigma_c` between blocks that see the landmark only.
"""

from __future__ import annotations

import numpy as np

from groma._numba import loop
from groma._typing import BoolArray, FloatArray, IntArray
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations
from groma.solver.linear.blocks import Blocks
from groma.solver.linear.elimination import LANDMARK_TOLERANCE, badly_conditioned, eliminate, scaled_blocks
from groma.solver.linear.schur import ReducedSystem

# ---------------------------------------------------------------------------------------------------------- Kernels


@loop
def _multiply_incidences(pointer, N, W, dl, dc, out):
    """Out = N W for every incidence, with N = -V^-1."""
    for p in range(pointer.shape[0] - 1):
        for k in range(pointer[p], pointer[p + 1]):
            for r in range(dl):
                for c in range(dc):
                    total = 0.0
                    for m in range(dl):
                        total += N[(p * dl + r) * dl + m] * W[(k * dl + m) * dc + c]
                    out[k, r, c] = total


@loop
def _add_outer(B_k, sigma, B_m, twice, half, out):
    """Out += B_k sigma B_m^T, and its transpose if ``twice``."""
    dl, da = B_k.shape
    db = B_m.shape[1]
    for r in range(dl):
        for e in range(db):
            total = 0.0
            for c in range(da):
                total += B_k[r, c] * sigma[c, e]
            half[r, e] = total
    for r in range(dl):
        for s in range(dl):
            total = 0.0
            for e in range(db):
                total += half[r, e] * B_m[s, e]
            out[r, s] += total
            if twice:
                out[s, r] += total


@loop
def _add_within(landmarks, pointer, pair_slots, pair_pointer, B, sigma, out):
    """Add B Sigma B^T over the pairs of incidences of one class; ``sigma`` holds the blocks by slot."""
    half = np.zeros((out.shape[1], sigma.shape[2]))
    for i in range(landmarks.shape[0]):
        p = landmarks[i]
        s = pair_pointer[p]
        for k in range(pointer[p], pointer[p + 1]):
            for m in range(k, pointer[p + 1]):
                _add_outer(B[k], sigma[pair_slots[s]], B[m], m > k, half, out[i])
                s += 1


@loop
def _add_between(landmarks, pointer_a, pointer_b, pair_slots, pair_pointer, B_a, B_b, sigma, out):
    """Add B_a Sigma_ab B_b^T and its transpose over the pairs of incidences of two classes."""
    half = np.zeros((out.shape[1], sigma.shape[2]))
    for i in range(landmarks.shape[0]):
        p = landmarks[i]
        s = pair_pointer[p]
        for k in range(pointer_b[p], pointer_b[p + 1]):
            for m in range(pointer_a[p], pointer_a[p + 1]):
                _add_outer(B_a[m], sigma[pair_slots[s]], B_b[k], True, half, out[i])
                s += 1


# ----------------------------------------------------------------------------------------------------------- Public


class Landmarks:
    """The landmarks of the eliminated groups, by number ``e`` of the group, in solver order.

    Parameters
    ----------
    layout, equations, system
        Of a problem that is linearised; its landmarks are eliminated here, without damping.
    """

    def __init__(self, layout: Layout, equations: NormalEquations, system: ReducedSystem) -> None:
        self._layout, self._equations, self._system = layout, equations, system
        self._roots = eliminate(system)
        self._B: dict[tuple[int, int], FloatArray] = {}

    def inverses(self, e: int) -> FloatArray:
        """-V^-1 of every landmark, (count, dof, dof)."""
        dof = self._layout.eliminated[e].dof
        return self._system.N[e].reshape(-1, dof, dof)

    def incidence(self, e: int, c: int) -> FloatArray:
        """Return B of every incidence with the kept class ``c``, (incidences, dof, width)."""
        if (e, c) not in self._B:
            eliminated, width = self._layout.eliminated[e], self._layout.kept[c].width
            incidences = eliminated.incidences[c]
            B = np.empty((len(incidences.block), eliminated.dof, width))
            _multiply_incidences(
                incidences.pointer, self._system.N[e], self._equations.W[e][c], eliminated.dof, width, B
            )
            roots = self._roots[e]
            rows, owner = roots.incidences[c]
            W: FloatArray = np.asarray(self._equations.W[e][c].reshape(-1, eliminated.dof, width)[rows], np.float64)
            B[rows] = -(roots.A[owner] @ roots.times(W, c))
            self._B[e, c] = B
        return self._B[e, c]

    def followed(self, e: int, X: FloatArray) -> FloatArray:
        """Return B X for the columns of X (kept unknowns, k), (count, dof, k)."""
        eliminated = self._layout.eliminated[e]
        out = np.zeros((eliminated.count, eliminated.dof, X.shape[1]))
        for c, incidences in eliminated.incidences.items():
            blocks = self._layout.kept[c].blocks_of(X)
            landmark = np.repeat(np.arange(eliminated.count), np.diff(incidences.pointer))
            np.add.at(out, landmark, self.incidence(e, c) @ blocks[incidences.block])
        return out

    def covariances(self, e: int, landmarks: IntArray, sigma: Blocks) -> FloatArray:
        """Return the covariances (len(landmarks), dof, dof), from those of the kept blocks on the pattern of S."""
        eliminated = self._layout.eliminated[e]
        out = -self.inverses(e)[landmarks]
        for c, incidences in eliminated.incidences.items():
            _add_within(
                landmarks, incidences.pointer, incidences.pair_slots, incidences.pair_pointer,
                self.incidence(e, c), sigma[c, c], out,
            )  # fmt: skip
        for (a, b), (slots, pointer) in eliminated.cross.items():
            _add_between(
                landmarks, eliminated.incidences[a].pointer, eliminated.incidences[b].pointer, slots, pointer,
                self.incidence(e, a), self.incidence(e, b), sigma[a, b], out,
            )  # fmt: skip
        return out

    def undetermined(self, e: int, held: BoolArray) -> BoolArray:
        """Return which landmarks have an unobservable direction; ``held`` coordinates are known."""
        dof = self._layout.eliminated[e].dof
        V = self._equations.V[e].reshape(-1, dof, dof).copy()
        steps = np.arange(dof)
        V[:, steps, steps] += held.reshape(-1, dof)
        found = (V[:, steps, steps] == 0.0).any(axis=1)
        few, blocks = badly_conditioned(scaled_blocks(V)[0], LANDMARK_TOLERANCE)
        found[few] |= np.linalg.eigvalsh(blocks)[:, 0] < LANDMARK_TOLERANCE
        return found

    def moved(self, e: int, X: FloatArray, threshold: float) -> BoolArray:
        """Return which landmarks follow the columns of X by more than a threshold, in units that make diag V one."""
        dof = self._layout.eliminated[e].dof
        size = np.sqrt(np.einsum("nii->ni", self._equations.V[e].reshape(-1, dof, dof)))
        return (np.abs(self.followed(e, X)) * size[:, :, None] > threshold).any(axis=(1, 2))
