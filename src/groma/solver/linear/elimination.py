# SPDX-License-Identifier: BSD-3-Clause
r"""Elimination of landmarks without damping, as covariances need it: with roots where blocks are badly conditioned.

A line that passes close by the centre of a camera turns in the image by much when it moves by little. That camera's
rows may be a million times larger than those of the others, and its block V of the normal equations is nearly of their
rank alone. In :math:`S = H - W^\top V^{-1} W` two numbers cancel then whose rounding, the condition of V times that of
a sum, may be larger than all other landmarks know of the camera. With a root :math:`A A^\top = V^{-1}`

.. math:: W^\top V^{-1} W = (A^\top W)^\top (A^\top W),

and the rounding of this form does not grow with the condition (Higham, *Accuracy and Stability of Numerical
Algorithms*, section 10.1). To eliminate :math:`A^\top W` with the identity in the place of V is to subtract just that,
so the kernels of :mod:`groma.solver.linear.schur` serve both; landmarks that are well conditioned go as always.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.solver.linear.schur import ReducedSystem

#: A landmark whose scaled normal matrix has a smaller eigenvalue than this has an undetermined direction.
LANDMARK_TOLERANCE = 1e-12
#: One with a smaller eigenvalue than this is eliminated by its root.
ILL_CONDITIONED = 1e-6


@dataclass(frozen=True)
class Roots:
    """Landmarks of one group that are eliminated by the roots of their blocks."""

    #: (n,) in solver order.
    landmarks: IntArray
    #: (n, dof, dof) A, with zeros for directions that are not determined.
    A: FloatArray
    #: By kept class: their incidences, and the row of ``landmarks`` of each.
    incidences: dict[int, tuple[IntArray, IntArray]]

    def times(self, W: FloatArray, c: int) -> FloatArray:
        """A^T W of the incidences (m, dof, width) with class ``c``."""
        return np.swapaxes(self.A[self.incidences[c][1]], 1, 2) @ W


def eliminate(system: ReducedSystem) -> list[Roots]:
    """Eliminate all landmarks of linearised equations without damping; return those that went by their roots.

    The sums V and W of the equations are as before afterwards, and N of the system is -V^-1 for all landmarks, without
    directions that are not determined.
    """
    equations, layout = system.equations, system.layout
    found = [_roots(system, e) for e in range(len(layout.eliminated))]
    kept = []
    for e, roots in enumerate(found):
        dof = layout.eliminated[e].dof
        V = equations.V[e].reshape(-1, dof, dof)
        W = {}
        for c, (rows, _) in roots.incidences.items():
            blocks = equations.W[e][c].reshape(-1, dof, layout.kept[c].width)
            W[c] = blocks[rows]
            blocks[rows] = roots.times(W[c], c)
        kept.append((V[roots.landmarks], W))
        V[roots.landmarks] = np.eye(dof) * (roots.A != 0.0).any(axis=1)[:, None, :]
    system.eliminate(0.0)
    for e, (roots, (V, W)) in enumerate(zip(found, kept, strict=True)):
        dof = layout.eliminated[e].dof
        equations.V[e].reshape(-1, dof, dof)[roots.landmarks] = V
        system.N[e].reshape(-1, dof, dof)[roots.landmarks] = -(roots.A @ np.swapaxes(roots.A, 1, 2))
        for c, (rows, _) in roots.incidences.items():
            equations.W[e][c].reshape(-1, dof, layout.kept[c].width)[rows] = W[c]
    return found


def scaled_blocks(V: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return V (n, dof, dof) with a diagonal of ones, and the roots (n, dof) of its diagonal; one where it is zero."""
    size = np.sqrt(np.einsum("nii->ni", V))
    size[size == 0.0] = 1.0
    return V / size[:, :, None] / size[:, None, :], size


def badly_conditioned(V: FloatArray, tolerance: float) -> tuple[IntArray, FloatArray]:
    """Return all rows with an eigenvalue below a tolerance, and perhaps some more, of V with a diagonal of ones.

    The other n - 1 eigenvalues sum up to n at most, so that their product is below e.
    """
    few = np.flatnonzero(np.linalg.det(V) < tolerance * np.e)
    return few, V[few]


def _roots(system: ReducedSystem, e: int) -> Roots:
    """Find the badly conditioned landmarks of a group, and the roots of their inverses."""
    eliminated = system.layout.eliminated[e]
    V, size = scaled_blocks(system.equations.V[e].reshape(-1, eliminated.dof, eliminated.dof))
    few, blocks = badly_conditioned(V, ILL_CONDITIONED)
    values, vectors = np.linalg.eigh(blocks)
    ill = values[:, 0] < ILL_CONDITIONED
    few, values, vectors = few[ill], values[ill], vectors[ill]
    determined = values > LANDMARK_TOLERANCE
    root = np.where(determined, 1.0 / np.sqrt(np.where(determined, values, 1.0)), 0.0)
    incidences = {}
    for c, all_of in eliminated.incidences.items():
        count = np.diff(all_of.pointer)[few]
        owner = np.repeat(np.arange(len(few)), count)
        start = np.cumsum(count) - count
        incidences[c] = (np.arange(len(owner)) - np.repeat(start - all_of.pointer[few], count), owner)
    return Roots(few, vectors * root[:, None, :] / size[few][:, :, None], incidences)
