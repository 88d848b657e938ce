# SPDX-License-Identifier: BSD-3-Clause
"""Many small problems at once: variables that share no factor with another free variable.

A camera against fixed landmarks (motion only) and landmarks seen by fixed cameras (structure only) are of this kind.
Every variable has a damping of its own, its step is kept only if it lowers that variable's cost, and it is left alone
once it has converged: what it becomes does not depend on the others, and a few that creep do not keep all of them busy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._simd import width
from groma._typing import FloatArray
from groma.problem.layout import Chunk, Layout
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.parallel import Workers
from groma.solver.linear.schur import MIN_DIAGONAL, invert_blocks
from groma.solver.options import SolverOptions, first_damping
from groma.solver.report import Iteration, SolveReport, Stopwatch, note_end, note_start
from groma.solver.steps import States
from groma.solver.termination import Termination

#: A variable whose damping exceeds this has reached its minimum to machine precision.
MAX_DAMPING = 1e12
MIN_DAMPING = 1e-15
#: A gain ratio above this means the cost falls faster than the quadratic model says, and a longer step may do better;
#: one below the other, that it is more bent than the model says, and a shorter step may.
STRETCH_GAIN_RATIO, SHORTEN_GAIN_RATIO = 1.5, 0.5
MAX_STRETCH = 8.0


@dataclass(frozen=True)
class BlockProgress:
    """How far the variables have come in one step."""

    #: Variables whose cost fell, or promises to fall, by more than the tolerance.
    unfinished: int
    #: Euclidean length of all steps that were kept.
    length: float
    #: Largest component of the gradient before the step.
    gradient: float


class IndependentBlocks:
    """Levenberg-Marquardt on every variable of a layout without kept blocks."""

    def __init__(self, layout: Layout, workers: Workers, initial_damping: float, tolerance: float = 1e-6) -> None:
        self.layout = layout
        self._tolerance = tolerance
        self.equations = NormalEquations(layout, workers)
        self._N = [np.zeros_like(V) for V in self.equations.V]
        self._h = [np.zeros_like(g) for g in self.equations.g_landmarks]
        self._initial_damping = initial_damping
        self._singular: dict[tuple[int, int], int] = {}
        self.reset()

    @property
    def num_singular(self) -> int:
        """Variables with a direction that the data do not determine."""
        return sum(self._singular.values())

    def reset(self) -> None:
        """Forget the dampings of earlier steps, and that variables have converged."""
        self._open = [np.ones(e.count, bool) for e in self.layout.eliminated]
        self._begun = False
        self.damping = [np.full(e.count, self._initial_damping) for e in self.layout.eliminated]
        self._growth = [np.full(e.count, 2.0) for e in self.layout.eliminated]

    def _wanted(self, chunk: Chunk) -> bool:
        """Whether some variable of a chunk has not converged."""
        return chunk.eliminated is not None and bool(self._open[chunk.eliminated][chunk.begin : chunk.end].any())

    def costs(self, states: States, known: list[FloatArray] | None = None) -> list[FloatArray]:
        """Return the cost of each variable of each group; where it has converged, that of ``known`` if given."""
        costs = [np.zeros(e.count) for e in self.layout.eliminated]
        self.equations.cost(self.equations.prepare(states), costs, None if known is None else self._wanted)
        if known is not None:
            costs = [np.where(mine, new, old) for mine, new, old in zip(self._open, costs, known, strict=True)]
        return costs

    def step(self, states: States, costs: list[FloatArray]) -> tuple[States, list[FloatArray], BlockProgress]:
        """Try one step of every variable; return the new states, their costs, and how far the variables have come."""
        equations = self.equations
        equations.linearize(states, equations.prepare(states), self._invert, self._wanted if self._begun else None)
        self._begun = True
        moved, deltas, promised, slope = dict(states), [], [], 0.0
        for e, group in enumerate(self.layout.eliminated):
            V, g, mine = equations.V[e].reshape(group.count, -1), equations.g_landmarks[e], self._open[e]
            g = g.reshape(group.count, group.dof)
            delta = np.where(mine[:, None], self._h[e].reshape(group.count, group.dof), 0.0)
            diagonal = np.maximum(V[:, :: group.dof + 1], MIN_DIAGONAL)
            pull = -np.einsum("ni,ni->n", g, delta)
            promised.append(0.5 * (pull + self.damping[e] * np.einsum("ni,ni,ni->n", delta, diagonal, delta)))
            deltas.append(delta)
            slope = max(slope, float(np.abs(g).max(initial=0.0)))
            manifold = self.layout.problem.variables[group.group].manifold
            moved[group.group] = manifold.retract(states[group.group], delta)
        new_costs = self.costs(moved, costs)
        self._rescale(states, costs, moved, new_costs, deltas, promised)
        unfinished, squared_length = 0, 0.0
        for e, group in enumerate(self.layout.eliminated):
            better = new_costs[e] < costs[e]
            moved[group.group] = np.where(better[:, None], moved[group.group], states[group.group])
            decrease = np.where(better, costs[e] - new_costs[e], promised[e])
            open_ended = better | (self.damping[e] < MAX_DAMPING)
            self._open[e] &= open_ended & (decrease > self._tolerance * costs[e])
            unfinished += int(self._open[e].sum())
            squared_length += float((np.where(better[:, None], deltas[e], 0.0) ** 2).sum())
            new_costs[e] = np.where(better, new_costs[e], costs[e])
            raised = np.minimum(self.damping[e] * self._growth[e], MAX_DAMPING)
            self.damping[e] = np.where(better, np.maximum(self.damping[e] / 5.0, MIN_DAMPING), raised)
            self._growth[e] = np.where(better, 2.0, np.minimum(2.0 * self._growth[e], 1e6))
        return moved, new_costs, BlockProgress(unfinished, float(np.sqrt(squared_length)), slope)

    def _invert(self, share: int, chunk: Chunk) -> None:
        """Find the steps of the variables of one chunk."""
        e = chunk.eliminated
        if e is not None:
            V, g = self.equations.V[e], self.equations.g_landmarks[e]
            dof = width(self.layout.eliminated[e].dof)
            self._singular[e, chunk.begin] = invert_blocks(
                V, g, self.damping[e], 1, chunk.begin, chunk.end, self._N[e], self._h[e], dof
            )

    def _rescale(self, states: States, costs, moved: States, new_costs, deltas, promised) -> None:
        r"""Try other lengths for steps whose cost fell otherwise than promised; ``moved``, costs and steps are updated.

        If the curvature along a step is c times the model's, the gain ratio is 2 - c, and the minimum lies at 1 / c
        times the step. Robust losses bend the cost down (c < 1). A line seen along its length, or anything else that is
        bent and has large residuals, may bend it up: from c = 2 on, full steps jump over the minimum to where the cost
        is higher, for ever. Damping helps little there, because the diagonal says nothing of such a direction.
        """
        factors = []
        for e in range(len(deltas)):
            decrease = costs[e] - new_costs[e]
            ratio = decrease / np.maximum(promised[e], 1e-300)
            counts = self._open[e] & (np.maximum(np.abs(decrease), promised[e]) > self._tolerance * costs[e])
            wrong = counts & ((ratio > STRETCH_GAIN_RATIO) | (ratio < SHORTEN_GAIN_RATIO))
            factors.append(np.where(wrong, 1.0 / np.clip(2.0 - ratio, 1.0 / MAX_STRETCH, MAX_STRETCH), 1.0))

        def concerned(chunk: Chunk) -> bool:
            e = chunk.eliminated
            return e is not None and bool((factors[e][chunk.begin : chunk.end] != 1.0).any())

        if all((factor == 1.0).all() for factor in factors):
            return
        other = dict(moved)
        for e, group in enumerate(self.layout.eliminated):
            manifold = self.layout.problem.variables[group.group].manifold
            other[group.group] = manifold.retract(states[group.group], factors[e][:, None] * deltas[e])
        other_costs = [np.zeros(e.count) for e in self.layout.eliminated]
        self.equations.cost(self.equations.prepare(other), other_costs, concerned)
        for e, group in enumerate(self.layout.eliminated):
            better = (factors[e] != 1.0) & (other_costs[e] < new_costs[e])
            moved[group.group] = np.where(better[:, None], other[group.group], moved[group.group])
            deltas[e] = np.where(better[:, None], factors[e][:, None] * deltas[e], deltas[e])
            new_costs[e] = np.where(better, other_costs[e], new_costs[e])


def solve_independently(
    layout: Layout, workers: Workers, options: SolverOptions, report: SolveReport, watch: Stopwatch, progress
) -> States:
    """Solve a layout without kept blocks; return the states in its order."""
    with watch("setup"):
        blocks = IndependentBlocks(layout, workers, first_damping(layout, options), options.function_tolerance)
        states = to_solver_order(layout)
    report.linear_solver = "blocks"
    with watch("cost"):
        costs = blocks.costs(states)
    cost = float(sum(blocks.equations.costs))
    outside = cost - float(sum(part.sum() for part in costs))
    note_start(report, layout, blocks.equations, cost)
    if not np.isfinite(cost):
        report.termination = Termination.NOT_FINITE
        return states
    report.termination = Termination.MAX_ITERATIONS
    while report.iterations < options.max_iterations:
        report.iterations += 1
        with watch("linearize"):
            states, costs, moved = blocks.step(states, costs)
        new_cost = float(sum(part.sum() for part in costs)) + outside
        damping = max((float(d.max()) for d in blocks.damping if d.size), default=0.0)
        record = Iteration(
            iteration=report.iterations,
            cost=new_cost,
            accepted=new_cost < cost,
            damping=damping,
            gain_ratio=0.0,
            step_norm=moved.length,
            gradient_max=moved.gradient,
            linear_iterations=0,
            seconds=watch.elapsed(),
        )
        report.history.append(record)
        cost = new_cost
        if moved.gradient <= options.gradient_tolerance:
            report.termination = Termination.GRADIENT_CONVERGED
        elif moved.unfinished == 0:
            report.termination = Termination.COST_CONVERGED
        if progress is not None and progress(record) is False:
            report.termination = Termination.STOPPED_BY_CALLER
        if report.termination is not Termination.MAX_ITERATIONS:
            break
    with watch("cost"):
        report.final_cost = blocks.equations.cost(blocks.equations.prepare(states))
        blocks.equations.num_degenerate = blocks.equations.hidden
    note_end(report, layout, blocks.equations, blocks.num_singular)
    return states
