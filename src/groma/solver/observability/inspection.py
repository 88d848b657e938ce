# SPDX-License-Identifier: BSD-3-Clause
r"""One linearisation of a problem, shared by the parts of a diagnosis.

Free motions of the whole scene are sought in the reduced system S first: eliminated landmarks follow the cameras as
well as they can there, so a motion G of the kept variables is one of the whole scene exactly if :math:`G^\top S\,G` is
zero. That costs next to nothing, whatever the number of landmarks. But S carries the rounding of all landmarks, of far
points above all; in case of doubt, the normal equations with the landmarks are used.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.problem.gauge import gauge_directions
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations
from groma.problem.problem import Problem
from groma.problem.residuals import squared_norms
from groma.problem.tied import Divided
from groma.solver.covariance.datum import (
    FREE_TOLERANCE,
    free_motions,
    held_coordinates,
    middle_and_extent,
    moves_anything,
    unmoved,
)
from groma.solver.linear.blocks import product
from groma.solver.linear.schur import ReducedSystem
from groma.solver.linear.visible_motion import camera_centers, motion
from groma.solver.observability.gates import DIAGNOSIS
from groma.solver.observability.messages import Names


@dataclass(frozen=True)
class Inspection:
    """A problem, its linearisation at its states, and quantities derived on demand."""

    problem: Problem
    #: The same with landmarks that are tied to others apart, and how that is laid out.
    parts: Divided
    layout: Layout
    equations: NormalEquations
    #: Undamped, with the landmarks eliminated.
    system: ReducedSystem
    names: Names

    @cached_property
    def centers(self) -> dict[str, FloatArray]:
        """Centres (count, 3) of the poses of each group."""
        return camera_centers(self.problem)

    @cached_property
    def all_centers(self) -> FloatArray:
        """(C, 3) centres of all poses."""
        return np.concatenate([np.zeros((0, 3)), *self.centers.values()])

    @cached_property
    def held(self) -> BoolArray:
        """Which unknowns of the reduced system are held constant."""
        return held_coordinates(self.layout)[0]

    @cached_property
    def place_and_size(self) -> tuple[FloatArray, float]:
        """Middle and extent of points and cameras."""
        return middle_and_extent(self.problem, DIAGNOSIS.sample)

    @cached_property
    def free_motions(self) -> tuple[FloatArray, FloatArray]:
        """World motions that cost nothing: combinations (7, k) of the seven, and their increments (unknowns, k)."""
        G, diagonal = self._world_motions(), self.system.flat_diagonal()
        combinations = np.eye(7)
        if self.held.any():
            combinations = unmoved(G[self.held], self.place_and_size[1])
        combinations = combinations[:, moves_anything(G.T @ (diagonal[:, None] * G), combinations)]
        if combinations.shape[1]:
            M = np.where(diagonal[:, None] > 0.0, G @ combinations, 0.0)  # what nothing sees is not in the way
            cost = M.T @ np.stack([product(self.layout, self.system.S, column) for column in M.T], axis=1)
            size = M.T @ (diagonal[:, None] * M)
            scale = 1.0 / np.sqrt(np.maximum(np.diag(size), 1e-300))
            values, vectors = np.linalg.eigh(0.5 * (cost + cost.T) * scale[:, None] * scale)
            expected = np.einsum("ik,ij,jk->k", vectors, size * scale[:, None] * scale, vectors)
            unsure = (values > FREE_TOLERANCE * expected) & (values < DIAGNOSIS.certain * expected)
            if unsure.any() or self.system.num_singular_landmarks:
                exact = free_motions(self.layout, self.equations, self.system)
                return exact.combinations, exact.kept
            combinations = combinations @ (scale[:, None] * vectors)[:, values < FREE_TOLERANCE * expected]
        return combinations, G @ combinations

    def _world_motions(self) -> FloatArray:
        """Increments (unknowns, 7) of the kept variables under the seven world motions."""
        references = [r for factor in self.problem.factors for r in factor.references()]
        mounted = {ref.group for slot, ref in references if slot.name == "extrinsics"}
        center, length = self.place_and_size
        G = np.zeros((self.layout.num_kept_unknowns, 7))
        for name, at in self.layout.unknowns.items():
            group = self.layout.problem.variables[name]
            part = gauge_directions(group.manifold, group.state, center, length, name in mounted)
            G[at] = part.transpose(1, 2, 0)
        return G

    def motion_of(self, name: str) -> FloatArray:
        """Motions (count, m, dof) in comparable units of kept variables by their increments."""
        group = self.problem.variables[name]
        center, length = self.place_and_size
        middle = np.tile(center, (len(group), 1))
        if group.manifold.kind == "plane":
            middle = self.on_planes(name)
        return motion(group.manifold, group.state, middle, np.full(len(group), length))

    def on_planes(self, name: str) -> FloatArray:
        """Middle (count, 3) of the points that lie on each plane; of the scene where there are none."""
        count = len(self.problem.variables[name])
        sums, total = np.zeros((count, 3)), np.zeros(count)
        for factor in self.problem.factors:
            refs = {self.problem.variables[ref.group].manifold.kind: ref for _, ref in factor.references()}
            if "plane" in refs and "point" in refs and refs["plane"].group == name:
                points = self.problem.variables[refs["point"].group].ambient()[refs["point"].index]
                np.add.at(sums, refs["plane"].index, points)
                np.add.at(total, refs["plane"].index, 1.0)
        return np.where(total[:, None] > 0, sums / np.maximum(total, 1.0)[:, None], self.place_and_size[0])

    def information_of(self, name: str) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Information (count, dof, dof) on variables with the kept ones held, what is held of each, and the inverse.

        The inverse is NaN for those that are kept themselves.
        """
        group = self.problem.variables[name]
        free, dof = group.free_coordinates(), group.manifold.dof
        information = np.zeros((len(group), dof, dof))
        inverse = np.full_like(information, np.nan)
        for part, mine in self.parts.parts(name):
            for e, eliminated in enumerate(self.layout.eliminated):
                if eliminated.group == part:
                    rows = mine[eliminated.order]
                    information[rows] = self.equations.V[e].reshape(-1, dof, dof)
                    inverse[rows] = -self.system.N[e].reshape(-1, dof, dof)
            for c, member in ((c, member) for c, kept in enumerate(self.layout.kept) for member in kept.members):
                if member.group == part:
                    blocks = self.system.S[c, c][member.blocks(np.arange(len(mine)))]
                    information[mine] = blocks[:, member.columns, member.columns]
        return information, np.zeros((len(group), dof), bool) if free is None else ~free, inverse

    @cached_property
    def landmarks(self) -> list[str]:
        """Groups of points and lines that may move."""
        free = {e.group for e in self.layout.eliminated} | {*self.layout.unknowns}
        return [
            name
            for name, group in self.problem.variables.items()
            if group.manifold.kind in ("point", "line") and any(part in free for part, _ in self.parts.parts(name))
        ]

    @cached_property
    def squares(self) -> list[FloatArray]:
        """Squared norm of every residual of every group of factors, divided by the noise, without the loss."""
        return [squared_norms(factor, self.problem.variables) for factor in self.problem.factors]

    def worst_residuals(self, name: str, chosen: BoolArray) -> FloatArray:
        """Largest weighted residual (count,) of the chosen variables; zero for others."""
        worst = np.zeros(len(chosen))
        for factor, squares in zip(self.problem.factors, self.squares, strict=True):
            for _, ref in factor.references():
                if ref.group == name:
                    mine = np.flatnonzero(chosen[ref.index])
                    np.maximum.at(worst, ref.index[mine], squares[mine])
        return np.sqrt(worst)

    @cached_property
    def residuals_of_cameras(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """For each group of poses: summed squared weighted residuals, and number of measured numbers, of every pose."""
        result = {name: (np.zeros(len(centers)), np.zeros(len(centers))) for name, centers in self.centers.items()}
        for k, factor in enumerate(self.problem.factors):
            refs = {slot.name: ref for slot, ref in factor.references()}
            if len(factor) == 0 or "pose" not in refs or refs["pose"].group not in result or len(refs) < 2:
                continue
            squares, index = self.squares[k], refs["pose"].index
            sums, rows = result[refs["pose"].group]
            sums += np.bincount(index, weights=squares, minlength=len(sums))
            rows += factor.residual_rank * np.bincount(index, minlength=len(rows))
        return result
