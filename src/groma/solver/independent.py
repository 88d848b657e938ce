# SPDX-License-Identifier: BSD-3-Clause
"""Many small problems at once: variables that share no factor with another free variable.

A camera against fixed landmarks (motion only) and landmarks seen by fixed cameras (structure only) are of this kind.
Every variable has a damping of its own, its step is kept only if it lowers that variable's cost, and it is left alone
once it has converged: what it becomes does not depend on the others, and a few that creep do not keep all of them busy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from groma._simd import width
from groma._stopwatch import Stopwatch
from groma._typing import BoolArray, FloatArray
from groma.gates import gate
from groma.problem.layout import Chunk, Layout
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.parallel import Workers
from groma.solver.damped_problem import Trial
from groma.solver.linear.schur import MIN_DIAGONAL, invert_blocks
from groma.solver.options import SolverOptions, first_damping
from groma.solver.report import SolveReport, note_costs
from groma.solver.steps import States
from groma.solver.termination import Termination

#: A variable whose damping exceeds this has reached its minimum to machine precision.
MAX_DAMPING = 1e12
MIN_DAMPING = 1e-15


@dataclass(frozen=True)
class StretchGates:
    """When a step is tried at another length, and the damping of variables that are not coupled."""

    longer: float = gate(1.5, "1", "gain ratio from which steps get longer", "derived from half the curvature")
    shorter: float = gate(0.5, "1", "gain ratio below which they get shorter", "derived from 1.5 times the curvature")
    most: float = gate(8.0, "times", "a step gets as long, or as short", "cost: further steps")
    lowered: float = gate(5.0, "times", "less damping after a step that helped", "cost: further steps")


#: The defaults.
STRETCH = StretchGates()


def stretch_factor(gain_ratio: Any) -> Any:
    """Return what a step should be multiplied by, for a gain ratio or an array of them.

    If the curvature along a step is c times the model's, the gain ratio is 2 - c, and the minimum lies at 1 / c times
    the step. Robust losses bend the cost down (c < 1): reweighted least squares overestimates the curvature.
    """
    return 1.0 / np.clip(2.0 - gain_ratio, 1.0 / STRETCH.most, STRETCH.most)


@dataclass(frozen=True)
class BlockProgress:
    """How far the variables have come in one step."""

    #: Variables whose cost fell, or promises to fall, by more than the tolerance.
    unfinished: int
    #: Euclidean length of all steps that were kept.
    length: float


class IndependentBlocks:
    """Levenberg-Marquardt on every variable of a layout without kept blocks; Gauss-Newton without initial damping."""

    def __init__(self, layout: Layout, workers: Workers, initial_damping: float, tolerance: float = 1e-6) -> None:
        self.layout = layout
        self._tolerance = tolerance
        self.equations = NormalEquations(layout, workers)
        self._N = [np.zeros_like(V) for V in self.equations.V]
        self._h = [np.zeros_like(g) for g in self.equations.g_landmarks]
        self._initial_damping = initial_damping
        self._max_damping = MAX_DAMPING if initial_damping > 0.0 else 0.0
        self._begins = [
            np.array([chunk.begin for chunk in layout.chunks if chunk.eliminated == e], dtype=np.int64)
            for e in range(len(layout.eliminated))
        ]
        self._singular = [np.zeros(e.count, np.int64) for e in layout.eliminated]
        self._steepest = [np.zeros(e.count) for e in layout.eliminated]
        self.reset()

    @property
    def num_singular(self) -> int:
        """Variables with a direction that the data do not determine."""
        return sum(int(mine.sum()) for mine in self._singular)

    def reset(self) -> None:
        """Forget the dampings of earlier steps, and that variables have converged."""
        self._unfinished = [np.ones(e.count, bool) for e in self.layout.eliminated]
        self._begun = False
        #: States with what factors read of them, and those whose costs by factor group are in the equations.
        self._last: tuple[States, list[tuple]] | None = None
        self._costs_are_of: States | None = None
        self.damping = [np.full(e.count, self._initial_damping) for e in self.layout.eliminated]
        self._growth = [np.full(e.count, 2.0) for e in self.layout.eliminated]

    def _with_any(self, variables: list[BoolArray]) -> Callable[[Chunk], bool] | None:
        """Return a function that tells whether a chunk has any of these variables; None if they are all."""
        if all(mine.all() for mine in variables):
            return None
        found = [np.logical_or.reduceat(mine, begin) for mine, begin in zip(variables, self._begins, strict=True)]
        those = {(e, at) for e, any_of in enumerate(found) for at in self._begins[e][any_of].tolist()}
        return lambda chunk: (chunk.eliminated, chunk.begin) in those

    def costs(self, states: States, known: list[FloatArray] | None = None) -> list[FloatArray]:
        """Return the cost of each variable of each group; where it has converged, that of ``known`` if given."""
        wanted = None if known is None else self._with_any(self._unfinished)
        costs = self._evaluated(states, wanted)
        if known is not None and wanted is not None:
            costs = [np.where(mine, new, old) for mine, new, old in zip(self._unfinished, costs, known, strict=True)]
        return costs

    def _evaluated(self, states: States, wanted: Callable[[Chunk], bool] | None) -> list[FloatArray]:
        """Return the cost of each variable of each group in the selected chunks, 0 in others."""
        costs = [np.zeros(e.count) for e in self.layout.eliminated]
        self.equations.cost(self._prepared(states), costs, wanted)
        self._costs_are_of = states if wanted is None else None
        return costs

    def _prepared(self, states: States) -> list[tuple]:
        """Return what factors read of the states; read-only. The last states are cached."""
        if self._last is None or self._last[0] is not states:
            self._last = None  # its memory is free for the next one
            self._last = states, self.equations.prepare(states)
        return self._last[1]

    def total(self, states: States) -> float:
        """Return the cost of all factors; those by factor group are left in the equations."""
        if self._costs_are_of is not states:
            self._evaluated(states, None)
        return float(sum(self.equations.costs))

    def step(self, states: States, costs: list[FloatArray]) -> tuple[States, list[FloatArray], BlockProgress]:
        """Try one step of every variable; return the new states, their costs, and how far the variables have come."""
        self.linearize(states)
        return self.advance(states, costs)

    def linearize(self, states: States) -> None:
        """Form and solve the normal equations of all variables that have not converged."""
        wanted = self._with_any(self._unfinished) if self._begun else None
        self._costs_are_of = None
        self.equations.linearize(states, self._prepared(states), self._invert, wanted)
        self._begun = True

    def largest_gradient(self) -> float:
        """Return the largest component of the gradient, each over the root of its curvature."""
        return float(np.sqrt(max((mine.max(initial=0.0) for mine in self._steepest), default=0.0)))

    def advance(self, states: States, costs: list[FloatArray]) -> tuple[States, list[FloatArray], BlockProgress]:
        """Take the step of every variable from where they were linearised, if it lowers the variable's cost."""
        deltas, promised = self._steps()
        moved = self._moved(states, deltas)
        new_costs = self.costs(moved, costs)
        moved = self._rescaled(states, costs, moved, new_costs, deltas, promised)
        unfinished, squared_length, better = 0, 0.0, []
        for e in range(len(costs)):
            better.append(new_costs[e] < costs[e])
            decrease = np.where(better[e], costs[e] - new_costs[e], promised[e])
            can_go_on = better[e] | (self.damping[e] < self._max_damping)
            self._unfinished[e] &= can_go_on & (decrease > self._tolerance * costs[e])
            unfinished += int(self._unfinished[e].sum())
            squared_length += float((np.where(better[e][:, None], deltas[e], 0.0) ** 2).sum())
            new_costs[e] = np.where(better[e], new_costs[e], costs[e])
            self._adapt(e, better[e])
        return self._chosen(better, moved, states), new_costs, BlockProgress(unfinished, float(np.sqrt(squared_length)))

    def _chosen(self, here: list[BoolArray], states: States, others: States) -> States:
        """Return the states of the variables that are ``here`` in each group, and other states of the rest."""
        if all(mine.all() for mine in here):
            return states
        chosen = dict(states)
        for group, mine in zip(self.layout.eliminated, here, strict=True):
            chosen[group.group] = np.where(mine[:, None], states[group.group], others[group.group])
        return chosen

    def _steps(self) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return the steps (count, dof) of each group, and what the quadratic model promises for each variable."""
        deltas, promised = [], []
        for e, group in enumerate(self.layout.eliminated):
            V, g = self.equations.V[e].reshape(group.count, -1), self.equations.g_landmarks[e]
            g = g.reshape(group.count, group.dof)
            delta = np.where(self._unfinished[e][:, None], self._h[e].reshape(group.count, group.dof), 0.0)
            diagonal = np.maximum(V[:, :: group.dof + 1], MIN_DIAGONAL)
            pull = -np.einsum("ni,ni->n", g, delta)
            promised.append(0.5 * (pull + self.damping[e] * np.einsum("ni,ni,ni->n", delta, diagonal, delta)))
            deltas.append(delta)
        return deltas, promised

    def _moved(self, states: States, deltas: list[FloatArray]) -> States:
        moved = dict(states)
        for group, delta in zip(self.layout.eliminated, deltas, strict=True):
            manifold = self.layout.problem.variables[group.group].manifold
            moved[group.group] = manifold.retract(states[group.group], delta)
        return moved

    def _adapt(self, e: int, better: BoolArray) -> None:
        """Lower the damping of variables whose cost fell, and raise that of the others."""
        raised = np.minimum(self.damping[e] * self._growth[e], self._max_damping)
        lowered = np.maximum(self.damping[e] / STRETCH.lowered, min(MIN_DAMPING, self._max_damping))
        self.damping[e] = np.where(better, lowered, raised)
        self._growth[e] = np.where(better, 2.0, np.minimum(2.0 * self._growth[e], 1e6))

    def _invert(self, share: int, chunk: Chunk) -> None:
        """Find the steps of the variables of one chunk, or of some that follow each other."""
        e = chunk.eliminated
        if e is not None:
            V, g = self.equations.V[e], self.equations.g_landmarks[e]
            dof = width(self.layout.eliminated[e].dof)
            invert_blocks(
                V, g, self.damping[e], 1, chunk.begin, chunk.end, self._N[e], self._h[e],
                self._singular[e], self._steepest[e], dof,
            )  # fmt: skip

    def _rescaled(
        self, states: States, costs: list[FloatArray], moved: States, new_costs: list[FloatArray],
        deltas: list[FloatArray], promised: list[FloatArray],
    ) -> States:  # fmt: skip
        """Try another length of the steps whose cost fell otherwise than promised; return the better states.

        ``new_costs`` and ``deltas`` are changed where the other length is better.

        A line seen along its length, or anything else that is bent and has large residuals, may bend the cost up: from
        twice the model's curvature on, full steps jump over the minimum to where the cost is higher, for ever. Damping
        helps little there, because the diagonal says nothing of such a direction.
        """
        factors, tried = [], []
        for e in range(len(deltas)):
            decrease = costs[e] - new_costs[e]
            ratio = decrease / np.maximum(promised[e], 1e-300)
            counts = self._unfinished[e] & (np.maximum(np.abs(decrease), promised[e]) > self._tolerance * costs[e])
            tried.append(counts & ((ratio > STRETCH.longer) | (ratio < STRETCH.shorter)))
            factors.append(np.where(tried[e], stretch_factor(ratio), 1.0) if tried[e].any() else np.ones(len(ratio)))
        if not any(mine.any() for mine in tried):
            return moved
        other = self._moved(states, [factor[:, None] * delta for factor, delta in zip(factors, deltas, strict=True)])
        other_costs = self._evaluated(other, self._with_any(tried))
        better = [
            mine & (one < all_at_first) for mine, one, all_at_first in zip(tried, other_costs, new_costs, strict=True)
        ]
        for e, factor in enumerate(factors):
            deltas[e] = np.where(better[e][:, None], factor[:, None] * deltas[e], deltas[e])
            new_costs[e] = np.where(better[e], other_costs[e], new_costs[e])
        return self._chosen(better, other, moved)


@dataclass(frozen=True, kw_only=True)
class IndependentTrial(Trial):
    """States of all variables, and the cost of each variable of each group."""

    states: States
    costs: list[FloatArray]


class IndependentProblem:
    """A layout without kept blocks; a :class:`groma.solver.damped_problem.DampedProblem`.

    A step is accepted or refused variable by variable before the loop sees it.
    """

    linear_name, linear_iterations = "blocks", 0

    def __init__(self, layout: Layout, workers: Workers, options: SolverOptions, watch: Stopwatch) -> None:
        with watch("setup"):
            first = first_damping(layout.problem.variables, options)
            self._blocks = IndependentBlocks(layout, workers, first, options.function_tolerance)
            self._here = IndependentTrial(cost=np.nan, states=to_solver_order(layout), costs=[])
        self._layout, self._watch, self._outside = layout, watch, 0.0
        self._at_start: list[float] = []

    @property
    def states(self) -> States:
        """The present states, in the order of the layout."""
        return self._here.states

    @property
    def num_factors(self) -> int:  # noqa: D102
        return sum(len(layout.factor) for layout in self._layout.factors)

    @property
    def damping(self) -> float:  # noqa: D102
        return max((float(d.max()) for d in self._blocks.damping if d.size), default=0.0)

    def start(self) -> IndependentTrial:  # noqa: D102
        with self._watch("cost"):
            costs = self._blocks.costs(self.states)
        self._at_start = self._blocks.equations.costs
        cost = float(sum(self._at_start))
        self._outside = cost - _total(costs)
        self._here = replace(self._here, cost=cost, costs=costs, num_hidden=self._blocks.equations.num_hidden)
        return self._here

    def linearize(self) -> None:  # noqa: D102
        with self._watch("linearize"):
            self._blocks.linearize(self.states)

    def largest_gradient(self) -> float:  # noqa: D102
        return self._blocks.largest_gradient()

    def is_curved(self) -> bool:  # noqa: D102
        return any(bool(V.any()) for V in self._blocks.equations.V)

    def try_step(self) -> IndependentTrial:  # noqa: D102
        with self._watch("linearize"):
            states, costs, came = self._blocks.advance(self.states, self._here.costs)
        found = {"cost": _total(costs) + self._outside, "length": came.length, "all_converged": came.unfinished == 0}
        return IndependentTrial(**found, states=states, costs=costs)

    def stretch(self, trial: IndependentTrial, factor: float) -> IndependentTrial:  # noqa: D102
        return trial

    def refine(self, trial: IndependentTrial) -> IndependentTrial:  # noqa: D102
        return trial

    def rescue(self, trial: IndependentTrial) -> IndependentTrial:  # noqa: D102
        return trial

    def accept(self, trial: IndependentTrial) -> None:  # noqa: D102
        self._here = trial

    def refuse(self, trial: IndependentTrial) -> Termination | None:
        """Go on from the trial: what fell of single variables may be too little to be seen in the sum."""
        self._here = trial
        return None

    def note_end(self, report: SolveReport) -> None:
        """Write the costs of the present states into the report, and what could not be evaluated or determined."""
        equations = self._blocks.equations
        with self._watch("cost"):
            report.final_cost = self._blocks.total(self.states)
            equations.num_degenerate = equations.hidden
        note_costs(report, self._layout, equations, self._at_start, self._blocks.num_singular)


def _total(costs: list[FloatArray]) -> float:
    return float(sum(part.sum() for part in costs))
