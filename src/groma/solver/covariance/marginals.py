# SPDX-License-Identifier: BSD-3-Clause
r"""Marginal and joint covariances of the variables of a solved problem.

With the reduced system S of the undamped normal equations (see :mod:`groma.solver.linear.schur`) the covariance of the
kept blocks is :math:`\Sigma_c = S^{-1}`, and that of a landmark, with :math:`B = -V^{-1} W`,

.. math:: \Sigma_l = V^{-1} + B\,\Sigma_c\,B^\top .

The second term needs :math:`\Sigma_c` only between blocks that see the landmark, which is where S has its own blocks;
:mod:`groma.solver.linear.fronts` finds these and no others, so the inverse is never formed. Covariances between
variables that share nothing are found by solving with the factorisation.

Every covariance refers to the increments of the chart the variable is stored in, and to unit weight: the square root
information of the factors must be that of the noise. Weights of robust losses count as they are at the solution.

Gauge. When the scene is free to move, S is singular. Either hold variables constant, or take ``gauge="inner"``: of all
frames and scales the one in which the coordinates named by ``datum`` vary least together; see
:mod:`groma.solver.covariance.datum`. A free motion of the scene does not count as uncertainty then.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.errors import InputError
from groma.execution import num_threads
from groma.geometry.conversions import conversion_jacobian
from groma.geometry.manifold import Manifold
from groma.problem.lay_out import lay_out
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.parallel import Workers
from groma.problem.problem import Problem
from groma.problem.tied import with_tied_apart
from groma.solver.covariance.datum import FreeMotions, constrained, free_motions, held_coordinates
from groma.solver.covariance.landmarks import Landmarks
from groma.solver.covariance.rank_deficient import (
    LOOSE,
    deficiency,
    hold_cancelled_coordinates,
    hold_unobservable_blocks,
    loses_the_cameras,
    zero_modes,
)
from groma.solver.covariance.s_transform import Transformation, datum_of_parts, datum_weights, transformation
from groma.solver.linear.blas import one_blas_thread
from groma.solver.linear.blocks import Blocks
from groma.solver.linear.fronts import Fronts
from groma.solver.linear.modes import divided, scaled, smallest
from groma.solver.linear.schur import ReducedSystem

#: A scaled variance above this means a direction that the data do not determine.
MAX_VARIANCE = 1e11
#: Relative step of the central differences of functions of variables.
STEP = 1e-6

#: A variable: the name of its group, and its index.
Variable = tuple[str, int]

# ----------------------------------------------------------------------------------------------------------- Public


@dataclass(frozen=True)
class Derived:
    """A quantity computed from variables, with its covariance to first order."""

    #: (n,) value and (n, n) covariance.
    value: FloatArray
    covariance: FloatArray

    @property
    def sigma(self) -> FloatArray:
        """(n,) standard deviations."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


class Covariances:
    """Covariances at the states of a problem.

    Parameters
    ----------
    problem
        A problem at its solution.
    gauge
        ``"held"``: the variables held constant fix the frame; ``"inner"``: inner constraints (a free network).
    eliminate
        As for :func:`groma.solver.solve.solve`.
    datum
        For ``gauge="inner"``: weights of the coordinates whose variances are to be least, by group, each of a shape
        that broadcasts to (count, dof). By default all kept variables (poses, planes, directions, intrinsics) count
        alike. ``{"poses": [1, 1, 1, 0, 0, 0]}`` refers covariances to the camera centres, in the left chart of poses,
        and ``{"points": 1}`` to the points.

    Raises
    ------
    ProblemError
        If the normal equations are rank deficient in the chosen gauge.
    InputError
        If the gauge or the datum is not one.

    Notes
    -----
    Variables held constant have covariance zero. Where a few variables are unobservable (a point seen once, a plane
    with two points), these have no covariance: theirs are NaN, see :meth:`undetermined`; all others are not affected.
    """

    def __init__(
        self,
        problem: Problem,
        gauge: str = "held",
        eliminate: str | tuple[str, ...] = "auto",
        datum: Mapping[str, npt.ArrayLike] | None = None,
    ) -> None:
        if gauge not in ("held", "inner"):
            raise InputError(f"gauge must be 'held' or 'inner'; got {gauge!r}.")
        self.problem = problem
        self._divided = with_tied_apart(problem, eliminate)
        self._layout = layout = lay_out(self._divided.problem, eliminate)
        states = to_solver_order(layout)
        workers = Workers(num_threads())
        self._equations = equations = NormalEquations(layout, workers)
        self._system = ReducedSystem(equations)
        equations.linearize(states, equations.prepare(states))
        self._landmarks = Landmarks(layout, equations, self._system)
        workers.close()
        self._position = {e.group: np.argsort(e.order) for e in layout.eliminated}
        self._eliminated = {e.group: number for number, e in enumerate(layout.eliminated)}
        self._kept = {member.group: (c, member) for c, kept in enumerate(layout.kept) for member in kept.members}
        self._held, self._held_landmarks = held_coordinates(layout)
        self._undetermined = [self._landmarks.undetermined(e, held) for e, held in enumerate(self._held_landmarks)]
        self._datum: Transformation | None = None
        self.motions: FreeMotions | None = None  #: of an inner gauge: the world motions that the data leave free
        self._sigma: Blocks = {}
        if layout.kept:
            self._system.assemble(0.0)
            seen = self._system.flat_diagonal() != 0.0
            cancelled, moved = hold_cancelled_coordinates(self._system)
            self._unseen = ~(seen | self._held) | cancelled
            for e, open_ in enumerate(self._undetermined if moved.any() else ()):
                open_ |= self._landmarks.moved(e, moved, LOOSE)
            with one_blas_thread():
                self._invert(gauge, datum and datum_of_parts(problem, self._divided, datum))

    def _invert(self, gauge: str, datum: Mapping[str, npt.ArrayLike] | None) -> None:
        layout = self._layout
        self._fronts = Fronts(layout)
        S, self._size = scaled(layout, self._system.S)
        motions, G = None, np.zeros((layout.num_kept_unknowns, 0))
        if gauge == "inner":
            motions = self.motions = free_motions(layout, self._equations, self._system)
            G = np.where((self._held | self._unseen)[:, None], 0.0, motions.kept)
            S = constrained(layout, S, G * self._size[:, None])
        inverse = self._inverse(S)
        if inverse is None:
            S = self._without_open_variables(S, G, gauge)
            inverse = self._inverse(S)
            if inverse is None:
                raise deficiency(layout, smallest(layout, self._fronts, S), 0)
        self._sigma = divided(layout, inverse, self._size)
        if motions is not None and G.any():  # not where all that moves is seen by nothing
            weights = datum_weights(layout, datum, self._undetermined)
            parts = self._landmarks, self._solve, motions, G, self._held_landmarks
            self._datum = transformation(layout, *parts, weights)

    def _inverse(self, S: Blocks) -> Blocks | None:
        """Return the inverse of a scaled system on its pattern, None where it has no rank."""
        if not self._fronts.factorize(S):
            return None
        inverse = self._fronts.inverse_on_pattern()
        variances = [np.einsum("nii->ni", inverse[c, c][: k.count]) for c, k in enumerate(self._layout.kept)]
        return inverse if all((part < MAX_VARIANCE).all() for part in variances) else None

    def _without_open_variables(self, S: Blocks, G: FloatArray, gauge: str) -> Blocks:
        """Hold the unobservable variables, and note them and the landmarks they move."""
        layout = self._layout
        known = self._held | self._unseen
        S, unobservable = hold_unobservable_blocks(self._equations, S, self._size, known, G)
        modes = zero_modes(layout, self._fronts, S)
        null = modes.vectors[:, : modes.num_null]
        if modes.num_null or not len(modes.values):
            free = free_motions(layout, self._equations, self._system).count if gauge == "held" else 0
            if free or loses_the_cameras(layout, modes):
                raise deficiency(layout, modes, free)
            S = constrained(layout, S, null)
        self._unseen |= unobservable | np.any(np.abs(null) > LOOSE, axis=1)
        for e in range(len(self._undetermined)):
            self._undetermined[e] |= self._landmarks.moved(e, null / self._size[:, None], LOOSE)
        return S

    def _solve(self, rhs: FloatArray) -> FloatArray:
        """Return S^-1 times the columns of ``rhs``, S with the constraints of the gauge."""
        with one_blas_thread():
            return self._fronts.solve(rhs / self._size[:, None]) / self._size[:, None]

    def of(self, group: str, index: IntArray | int | None = None) -> FloatArray:
        """Return the covariances (len(index), dof, dof) of variables of a group; all of them by default.

        Variables held constant have covariance zero, variables that are not determined NaN.

        Raises
        ------
        InputError
            If there is no such group, or no such variable in it.
        """
        index = self._checked(group, index)
        dof = self.problem.variables[group].manifold.dof
        out = np.zeros((len(index), dof, dof))
        for at, part, rows in self._divided.places(group, index):
            if part in self._kept:
                out[at] = self._of_kept(part, rows)
            elif part in self._eliminated:
                out[at] = self._of_landmarks(self._eliminated[part], self._position[part][rows])
            else:
                out[at[np.isin(rows, self._open(part))]] = np.nan
        return out

    def _checked(self, group: str, index: npt.ArrayLike | None) -> IntArray:
        if group not in self.problem.variables:
            raise InputError(f"There is no group {group!r}; the problem has {sorted(self.problem.variables)}.")
        variables = self.problem.variables[group]
        rows = np.arange(len(variables)) if index is None else np.atleast_1d(np.asarray(index))
        if len(rows) and (rows.min() < 0 or rows.max() >= len(variables)):
            raise InputError(f"Group {group!r} has variables 0 to {len(variables) - 1}; asked for {rows.tolist()[:5]}.")
        return rows

    def _of_kept(self, part: str, rows: IntArray) -> FloatArray:
        (c, member), at = self._kept[part], self._layout.unknowns[part][rows]
        sigma = self._sigma[c, c][member.blocks(rows)][:, member.columns, member.columns]
        if self._datum is not None:
            sigma = sigma + self._datum.correction(self._datum.G[at], self._datum.A[at])
        held = self._held[at]
        sigma = np.where(held[:, :, None] | held[:, None, :], 0.0, sigma)
        return np.where(self._unseen[at].any(axis=1)[:, None, None], np.nan, sigma)

    def _of_landmarks(self, e: int, landmarks: IntArray) -> FloatArray:
        dof = self._layout.eliminated[e].dof
        out = self._landmarks.covariances(e, landmarks, self._sigma)
        if self._datum is not None:
            rows = landmarks[:, None] * dof + np.arange(dof)
            out += self._datum.correction(self._datum.G_landmarks[e][rows], self._datum.A_landmarks[e][rows])
        held = self._held_landmarks[e].reshape(-1, dof)[landmarks]
        out = np.where(held[:, :, None] | held[:, None, :], 0.0, out)
        return np.where(self._undetermined[e][landmarks][:, None, None], np.nan, out)

    def undetermined(self, group: str) -> IntArray:
        """Return the indices of the unobservable variables of a group; their covariances are NaN."""
        self._checked(group, None)
        return np.sort(np.concatenate([mine[self._open(part)] for part, mine in self._divided.parts(group)]))

    def _open(self, part: str) -> IntArray:
        """Return the rows of the unobservable variables of a group of the divided problem."""
        if (e := self._eliminated.get(part)) is not None:
            return self._layout.eliminated[e].order[self._undetermined[e]].astype(np.int64)
        if part not in self._kept:  # held, or nothing was measured of them
            variables = self._layout.problem.variables[part]
            free = variables.free_coordinates()
            return np.arange(len(variables)) if free is None else np.flatnonzero(free.any(axis=1))
        return np.flatnonzero(self._unseen[self._layout.unknowns[part]].any(axis=1))

    def in_datum(self, increments: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Free increments (count, dof) of all groups from their common motion: the errors that :meth:`of` describes.

        For ``gauge="inner"``, an error is known only up to a motion of the whole scene; this is P of the datum.
        """
        moved = {name: np.array(part, dtype=np.float64) for name, part in increments.items()}
        if self._datum is None:
            return moved
        layout, datum = self._layout, self._datum
        moved = self._divided.divide(moved)
        views = [(name, datum.G[at], datum.D[at]) for name, at in layout.unknowns.items()]
        for e, eliminated in enumerate(layout.eliminated):
            rows = self._position[eliminated.group]
            shape = (eliminated.count, eliminated.dof)
            G, D = datum.G_landmarks[e].reshape(*shape, -1)[rows], datum.D_landmarks[e].reshape(shape)[rows]
            views.append((eliminated.group, G, D))
        common = sum(np.einsum("nik,ni,ni->k", G, D, moved[name]) for name, G, D in views)
        for name, G, _ in views:
            moved[name] -= G @ (datum.Q @ common)
        return self._divided.join(moved)

    def in_chart(self, group: str, chart: Manifold, index: IntArray | int | None = None) -> FloatArray:
        """Return covariances (n, dof, dof) of lines or planes for the increments of another chart."""
        rows = self._checked(group, index)
        variables = self.problem.variables[group]
        J = conversion_jacobian(variables.state[rows], variables.manifold, chart)
        return J @ self.of(group, rows) @ np.swapaxes(J, 1, 2)

    def of_coordinates(self, group: str, index: IntArray | int | None = None) -> FloatArray:
        r"""Return covariances (n, m, m) of the factor coordinates, :math:`B \Sigma B^\top`.

        (m, d) of lines, (n, w) of planes, the left twist of poses; singular where these have redundant numbers.
        """
        rows = self._checked(group, index)
        variables = self.problem.variables[group]
        basis, sigma = variables.manifold.basis(variables.state[rows]), self.of(group, rows)
        return sigma if basis is None else basis @ sigma @ np.swapaxes(basis, 1, 2)

    def joint(self, variables: Sequence[Variable]) -> FloatArray:
        """Return the joint covariance of some variables, by concatenated increments.

        Each costs one solve with the factorised system per degree of freedom; the variables need not share anything.
        """
        layout, datum = self._layout, self._datum
        places, size = {}, 0
        for group, index in variables:
            variable = group, int(self._checked(group, index)[0])
            if variable not in places:
                places[variable] = slice(size, size + self.problem.variables[group].manifold.dof)
                size = places[variable].stop
        R, out, broken = np.zeros((layout.num_kept_unknowns, size)), np.zeros((size, size)), np.zeros(size, bool)
        G, A = (np.zeros((size, 0 if datum is None else datum.G.shape[1])) for _ in range(2))
        for (group, i), at in places.items():
            broken[at] = i in self.undetermined(group)
            ((_, part, row),) = self._divided.places(group, np.array([i]))
            if part in self._kept:
                rows = layout.unknowns[part][row[0]]
                R[rows, at] = np.diag(np.where(self._held[rows], 0.0, 1.0))
                if datum is not None:
                    G[at], A[at] = datum.G[rows], datum.A[rows]
            elif part in self._eliminated:
                e, p = self._eliminated[part], int(self._position[part][row[0]])
                for c, incidences in layout.eliminated[e].incidences.items():
                    own = slice(incidences.pointer[p], incidences.pointer[p + 1])
                    B = self._landmarks.incidence(e, c)[own]
                    layout.kept[c].blocks_of(R)[incidences.block[own], :, at] += np.swapaxes(B, 1, 2)
                out[at, at] -= self._landmarks.inverses(e)[p]
                if datum is not None:
                    rows = slice(p * layout.eliminated[e].dof, (p + 1) * layout.eliminated[e].dof)
                    G[at], A[at] = datum.G_landmarks[e][rows], datum.A_landmarks[e][rows]
        if layout.kept:
            out += R.T @ self._solve(R)
        if datum is not None:
            out += datum.correction(G[None], A[None])[0]
        out[broken] = np.nan
        out[:, broken] = np.nan
        asked = [places[group, int(np.atleast_1d(index)[0])] for group, index in variables]
        rows = np.concatenate([np.zeros(0, int), *(np.arange(at.start, at.stop) for at in asked)])
        return 0.5 * (out + out.T)[np.ix_(rows, rows)]

    def derived(self, function: Callable[..., npt.ArrayLike], variables: Sequence[Variable]) -> Derived:
        """Return the value and covariance of a function of some variables.

        Parameters
        ----------
        function
            Takes the ambient numbers of each variable, (12,), (3,), (6,) or (4,), and returns a number or (n,) numbers.
            Its value must not depend on the scale of (m, d) and (n, w). :mod:`groma.solver.covariance.quantities` has
            some.
        variables
            (group, index) of each argument.

        Returns
        -------
        Derived
            To first order; derivatives by the increments of the charts are central differences.
        """
        groups = [self.problem.variables[group] for group, _ in variables]
        states = [group.state[i : i + 1] for group, (_, i) in zip(groups, variables, strict=True)]

        def value(moved: list[FloatArray]) -> FloatArray:
            ambients = [group.manifold.ambient(state)[0] for group, state in zip(groups, moved, strict=True)]
            return np.atleast_1d(np.asarray(function(*ambients), dtype=np.float64))

        center, columns = value(states), []
        for v, group in enumerate(groups):
            step = STEP * max(1.0, float(np.abs(states[v]).max())) if group.manifold.kind == "point" else STEP
            for k in range(group.manifold.dof):
                delta = np.zeros((1, group.manifold.dof))
                delta[0, k] = step
                ends = [
                    value([*states[:v], group.manifold.retract(states[v], sign * delta), *states[v + 1 :]])
                    for sign in (1.0, -1.0)
                ]
                columns.append((ends[0] - ends[1]) / (2 * step))
        J = np.stack(columns, axis=1)
        return Derived(center, J @ self.joint(variables) @ J.T)
