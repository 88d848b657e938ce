# SPDX-License-Identifier: BSD-3-Clause
r"""The datum: which motions of the whole scene the data leave free, and which frame covariances refer to.

Let G hold the free world motions, one a column, over all unknowns. A scene that is free to move has a singular normal
matrix N, and covariances exist only relative to a frame. Holding as many combinations of coordinates as there are free
motions gives one frame, and one generalised inverse of N, say M. Every other frame follows by an *S-transformation*:
with weights D on the coordinates that are to stay in place on average,

.. math:: \Sigma = P M P^\top, \qquad P = I - G\,(G^\top D G)^{-1} G^\top D .

Inner constraints are the choice D = I on the coordinates named: of all frames the one in which the sum of their
variances is least.

References
----------
Baarda, *S-transformations and criterion matrices*, 1973; Triggs et al., *Bundle adjustment, a modern synthesis*, 2000,
section 9.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.problem.gauge import world_motions
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations
from groma.problem.problem import Problem
from groma.problem.residuals import jacobians_of, root_matrices, squared_norms
from groma.solver.linear.blocks import Blocks, multiply, split
from groma.solver.linear.schur import ReducedSystem

#: A world motion counts as free if its cost is below this fraction of the one expected from its size.
FREE_TOLERANCE = 1e-9
#: Singular values below this fraction of the largest do not count.
RANK_TOLERANCE = 1e-9


@dataclass(frozen=True)
class FreeMotions:
    """World motions that change no residual."""

    #: (7, k) each as a combination of those of :func:`groma.problem.gauge.gauge_directions`, about ``center``
    #: and with ``length`` as the unit of the translations.
    combinations: FloatArray
    center: FloatArray
    length: float
    #: Increments of the kept unknowns (unknowns, k), and by eliminated group (unknowns, k), flat, in solver order.
    kept: FloatArray
    landmarks: list[FloatArray]

    @property
    def count(self) -> int:
        """Number of free motions."""
        return self.combinations.shape[1]


def held_coordinates(layout: Layout) -> tuple[BoolArray, list[BoolArray]]:
    """Return which unknowns are held constant: of the kept ones, and by eliminated group, flat, in solver order."""
    kept, landmarks = np.zeros(layout.num_kept_unknowns, bool), []
    for name, at in layout.unknowns.items():
        free = layout.problem.variables[name].free_coordinates()
        kept[at] = False if free is None else ~free
    for e in layout.eliminated:
        free = layout.problem.variables[e.group].free_coordinates()
        landmarks.append(np.zeros(e.count * e.dof, bool) if free is None else ~free[e.order].reshape(-1))
    return kept, landmarks


def free_motions(layout: Layout, equations: NormalEquations, system: ReducedSystem) -> FreeMotions:
    """Find the combinations of the seven world motions that move no held coordinate and cost nothing."""
    center, length = middle_and_extent(layout.problem)
    motions = world_motions(layout.problem, center, length)
    kept = np.zeros((layout.num_kept_unknowns, 7))
    for name, at in layout.unknowns.items():
        kept[at] = motions[name].transpose(1, 2, 0)
    landmarks = [motions[e.group][:, e.order].transpose(1, 2, 0).reshape(-1, 7) for e in layout.eliminated]
    held_kept, held_landmarks = held_coordinates(layout)
    combinations = np.eye(7)
    stuck = [kept[held_kept], *(part[mask] for part, mask in zip(landmarks, held_landmarks, strict=True))]
    stuck = np.concatenate(stuck)
    if len(stuck):
        combinations = unmoved(stuck, length)
    gram, size = _costs(layout, equations, system, kept, landmarks)
    combinations = combinations[:, moves_anything(size, combinations)]
    if combinations.shape[1]:
        gram = gram - _costs_of_incidences(layout.problem, motions)
        gram, size = (combinations.T @ M @ combinations for M in (gram, size))
        scale = 1.0 / np.sqrt(np.maximum(np.diag(size), 1e-300))
        values, vectors = np.linalg.eigh(gram * scale[:, None] * scale)
        # an eigenvector is free if its cost is small for its size
        expected = np.einsum("ik,ij,jk->k", vectors, size * scale[:, None] * scale, vectors)
        combinations = combinations @ (scale[:, None] * vectors)[:, values < FREE_TOLERANCE * expected]
    return FreeMotions(combinations, center, length, kept @ combinations, [part @ combinations for part in landmarks])


def constrained(layout: Layout, S: Blocks, G: FloatArray) -> Blocks:
    """Add as many constraints as there are motions G, each on one block, so that a scaled S keeps its pattern.

    Cameras are taken first: a plane may be loose by itself, and its constraints would then hold that instead.
    """
    left = np.eye(G.shape[1])
    S = {pair: blocks.copy() if pair[0] == pair[1] else blocks for pair, blocks in S.items()}
    kinds = layout.kinds
    for chosen in (("pose",), tuple(set(kinds) - {"pose"})):
        while left.shape[1]:
            strongest, where = 1e-6 * float(np.linalg.norm(G, axis=1).max(initial=0.0)), None
            for c, kept in enumerate(layout.kept):
                if kinds[c] in chosen:
                    strength = np.linalg.norm(kept.blocks_of(G) @ left, axis=(1, 2))
                    if strength.max() > strongest:
                        strongest, where = float(strength.max()), (c, int(strength.argmax()))
            if where is None:
                break
            c, block = where
            U, values, Vt = np.linalg.svd(layout.kept[c].blocks_of(G)[block] @ left)
            held = values > 0.1 * values[0]
            C = U[:, : len(values)][:, held]
            S[c, c][block] += C @ C.T
            left = left @ Vt.T[:, np.concatenate([~held, np.ones(len(Vt) - len(values), bool)])]
    return S


def middle_and_extent(problem: Problem, most_points: int | None = None) -> tuple[FloatArray, float]:
    """Middle (3,) and extent of the points and cameras of a problem, to which motions are referred.

    Maximum number of points of each group, evenly spread; None: all.
    """
    places = [np.zeros((0, 3))]
    for group in problem.variables.values():
        if group.manifold.kind == "point" and len(group):
            every = 1 if most_points is None else -(-len(group) // most_points)
            places.append(group.manifold.ambient(group.state[::every]))
        if group.manifold.kind == "pose" and len(group):
            T = group.ambient().reshape(-1, 3, 4)
            places.append(-np.einsum("nij,ni->nj", T[:, :, :3], T[:, :, 3]))
    place = np.concatenate(places)
    if len(place) == 0:
        return np.zeros(3), 1.0
    center = np.median(place, axis=0)
    length = float(np.median(np.linalg.norm(place - center, axis=1)))
    return center, length if length > 0 else 1.0


def unmoved(motions: FloatArray, length: float) -> FloatArray:
    """Return the combinations (7, k) of motions (unknowns, 7) that leave all these unknowns where they are.

    An unknown is a length or an angle, so each is compared with itself: its row is made of unit length, unless it is
    rounding beside ``length``, the unit of the translations. By singular values: their squares, the eigenvalues of the
    product, are lost in rounding below 1e-16.
    """
    norms = np.linalg.norm(motions, axis=1)
    rows = motions / np.maximum(norms, RANK_TOLERANCE * min(1.0, length))[:, None]
    _, values, vectors = np.linalg.svd(np.linalg.qr(rows, mode="r"))
    size = np.append(values, np.zeros(len(vectors) - len(values)))
    return vectors[size <= RANK_TOLERANCE * max(float(size.max(initial=0.0)), 1e-300)].T


def moves_anything(size: FloatArray, combinations: FloatArray) -> BoolArray:
    """Return the combinations (7, k) that move the variables; a problem of directions alone has no translation.

    ``size`` (7, 7) is what the motions would cost if every unknown moved alone: squares, and free of units.
    """
    costs = np.einsum("ik,ij,jk->k", combinations, size, combinations)
    return costs > RANK_TOLERANCE**2 * np.diag(size).max(initial=0.0)


def _costs_of_incidences(problem: Problem, motions: dict[str, FloatArray]) -> FloatArray:
    """Return the part of J^T J (7, 7) due to non-zero residuals of invariant factors.

    Landmarks on others cost less in a smaller scene, by the distances between them: that does not determine its scale.
    """
    gram = np.zeros((7, 7))
    for factor in problem.factors:
        if not factor.is_incidence or not len(factor):
            continue
        blocks = jacobians_of(factor, problem.variables)
        J = np.sum(
            [blocks[slot.name] @ motions[ref.group].transpose(1, 2, 0)[ref.index] for slot, ref in factor.references()],
            axis=0,
        )
        weight = factor.loss.evaluate(squared_norms(factor, problem.variables))[1]
        J = root_matrices(factor) @ J
        gram += np.einsum("n,nik,nil->kl", weight, J, J)
    return gram


def _costs(
    layout: Layout, equations: NormalEquations, system: ReducedSystem, kept: FloatArray, landmarks: list[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return J^T J restricted to the motions, and its diagonal restricted to them, both (7, 7)."""
    direct = {
        pair: equations.H[pair].reshape(-1, layout.kept[pair[0]].width, layout.kept[pair[1]].width)
        for pair in layout.blocks
    }
    gram, size = np.zeros((7, 7)), np.zeros((7, 7))
    for k in range(7):
        step = split(layout, np.ascontiguousarray(kept[:, k]))
        for part, product in zip(split(layout, kept), multiply(layout, direct, step), strict=True):
            gram[:, k] += part.T @ product
        for part, product in zip(landmarks, system.incident_products(step), strict=True):
            cross = part.T @ product
            gram[:, k] += cross
            gram[k] += cross
    for c, part in enumerate(split(layout, kept)):
        size += part.T @ (system.diagonal(c).reshape(-1)[:, None] * part)
    for e, part in enumerate(landmarks):
        dof = layout.eliminated[e].dof
        V = equations.V[e].reshape(-1, dof, dof)
        blocks = part.reshape(-1, dof, 7)
        gram += np.tensordot(blocks, V @ blocks, axes=((0, 1), (0, 1)))
        size += part.T @ (np.einsum("nii->ni", V).reshape(-1)[:, None] * part)
    return gram, size
