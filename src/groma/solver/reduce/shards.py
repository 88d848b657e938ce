# SPDX-License-Identifier: BSD-3-Clause
r"""A solve whose observations do not fit into memory: landmarks come in shards, one shard at a time.

Eliminating a landmark needs nothing but its own factors, and what it leaves behind,

.. math:: S = \sum_{\text{shards}} \big(H + W^\top N W\big), \qquad
          b = -\sum_{\text{shards}} \big(g_c + W^\top N g_l\big),

has the size of the cameras. So a shard is laid out, linearised and eliminated, its part is added to S and b, and it is
forgotten. The step of the cameras found, the shard is formed once more for the steps of its landmarks, and in the same
visit it is linearised at the new states: one visit of every shard a step. Memory is that of the states, of the reduced
system, and of the largest shard.

The damping of the next linearisation must be known before the cost is. So it falls by what the gain ratio of the step
before suggests, up to a third, and grows as in :mod:`groma.solver.levenberg_marquardt` after a refused step, for which
the shards are visited once more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.errors import ProblemError
from groma.factors.contract import Factor
from groma.problem.lay_out import lay_out
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations, to_original_order, to_solver_order
from groma.problem.parallel import Workers, available_cores
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.solver.levenberg_marquardt import MAX_DAMPING, MIN_DAMPING
from groma.solver.linear.blas import one_blas_thread
from groma.solver.linear.reduced import ConjugateGradients, choose
from groma.solver.linear.schur import ReducedSystem
from groma.solver.options import SolverOptions
from groma.solver.reduce.shared_system import SharedSystem
from groma.solver.report import Iteration, SolveReport, Stopwatch
from groma.solver.solve import Progress
from groma.solver.steps import States, size_of
from groma.solver.termination import Termination

#: Damping of the first step where the options give none.
FIRST_DAMPING = 1e-5


@dataclass(frozen=True)
class Shard:
    """Landmarks with all their factors."""

    #: Rows of each group of landmarks that are in this shard.
    landmarks: Mapping[str, slice]
    #: Makes the factors, for example from memory-mapped files. References to landmarks count from the first row of the
    #: shard, all others from the first of their group.
    factors: Callable[[], Sequence[Factor]]


@dataclass(frozen=True)
class ShardedSolution:
    """All variables at their new states, and how they got there."""

    variables: dict[str, Variables]
    report: SolveReport


def solve_shards(
    variables: Mapping[str, Variables],
    shards: Sequence[Shard],
    options: SolverOptions | None = None,
    progress: Progress | None = None,
) -> ShardedSolution:
    """Minimise the cost of all factors of all shards, as :func:`groma.solver.solve.solve` does for one problem.

    Parameters
    ----------
    variables
        All groups of variables. Groups of landmarks are those that shards name; the others (cameras, planes) are kept
        in the reduced system, and are seen by all shards.
    shards
        Each landmark in one shard; factors without a landmark in any one.
    options
        ``strategy``, ``landmark_steps`` and ``eliminate`` are not used.
    progress
        Called with an :class:`Iteration` after every step tried; return False to stop.

    Returns
    -------
    ShardedSolution
        States of all variables, and the report. Not converging is reported, not raised.

    Raises
    ------
    ProblemError
        If landmarks are in no shard or in two, or a factor of a shard does not fit.
    """
    options = options or SolverOptions()
    _check(variables, shards)
    report = SolveReport()
    watch = Stopwatch(report)
    report.threads = options.threads or available_cores()
    workers = Workers(report.threads)
    try:
        with one_blas_thread():
            states = _Run(variables, shards, workers, options, report, watch, progress).minimise()
    finally:
        workers.close()
    report.seconds["total"] = watch.elapsed()
    return ShardedSolution({name: group.with_state(states[name]) for name, group in variables.items()}, report)


class _Run:
    """One solve."""

    def __init__(
        self,
        variables: Mapping[str, Variables],
        shards: Sequence[Shard],
        workers: Workers,
        options: SolverOptions,
        report: SolveReport,
        watch: Stopwatch,
        progress: Progress | None,
    ) -> None:
        self.variables, self.shards, self.workers, self.options = variables, shards, workers, options
        self.report, self.watch, self.progress = report, watch, progress
        landmarks = {group for shard in shards for group in shard.landmarks}
        self.kept = {
            name: group for name, group in variables.items() if name not in landmarks and not group.is_constant
        }
        self.sums = SharedSystem(self.kept)

    def minimise(self) -> States:
        """Step until a criterion is met."""
        options, report, watch = self.options, self.report, self.watch
        states = {name: group.state for name, group in self.variables.items()}
        damping, growth, last_ratio = options.initial_damping or FIRST_DAMPING, 2.0, 1.0
        cost = self._form(states, damping)
        report.initial_cost = report.final_cost = cost
        report.num_unknowns = sum(_num_free(group) for group in self.variables.values())
        if not np.isfinite(cost):
            report.termination = Termination.NOT_FINITE
            return states
        report.termination = Termination.MAX_ITERATIONS
        while report.iterations < options.max_iterations:
            if self.sums.largest_gradient() <= options.gradient_tolerance:
                report.termination = Termination.GRADIENT_CONVERGED
                break
            report.iterations += 1
            slope = self.sums.largest_gradient()
            with watch("solve"):
                layout, S, rhs = self.sums.system(damping)
                linear = choose(layout, options.linear_solver)
                linear.follow(states)
                step = linear.solve(S, rhs)
            report.linear_solver = linear.name
            new_cost, length, ratio, accepted = np.inf, np.inf, 0.0, False
            moved, lower = states, max(damping * _reduction(last_ratio), MIN_DAMPING)
            if step is not None:
                residual = linear.residual if isinstance(linear, ConjugateGradients) else None
                predicted = self.sums.decrease(step, damping, residual)
                moved, new_cost, length, more = self._advance(states, step, damping, lower)
                ratio = (cost - new_cost) / max(predicted + more, 1e-300)
                accepted = new_cost < cost
            record = Iteration(
                iteration=report.iterations,
                cost=float(new_cost),
                accepted=accepted,
                damping=damping,
                gain_ratio=float(ratio),
                step_norm=float(length),
                gradient_max=slope,
                linear_iterations=linear.num_iterations if isinstance(linear, ConjugateGradients) else 0,
                seconds=watch.elapsed(),
            )
            report.history.append(record)
            ended, last_ratio = None, ratio
            if accepted:
                decrease, cost, states, damping, growth = cost - new_cost, new_cost, moved, lower, 2.0
                if decrease <= options.function_tolerance * (cost + decrease):
                    ended = Termination.COST_CONVERGED
                elif length <= options.step_tolerance * size_of(states):
                    ended = Termination.STEP_CONVERGED
            else:
                damping, growth = damping * growth, growth * 2.0
                if damping > MAX_DAMPING or length <= 1e-14 * size_of(states):
                    ended = Termination.DAMPING_EXHAUSTED
            if self.progress is not None and self.progress(record) is False:
                ended = Termination.STOPPED_BY_CALLER
            if ended is not None:
                report.termination = ended
                break
            if not accepted:
                self._form(states, damping)
        report.final_cost = cost
        return states

    def _problem(self, shard: Shard, states: States) -> Problem:
        """Return a shard as a problem of its own, at given states."""
        part = {
            name: Variables(
                self.variables[name].manifold, states[name][rows], _rows_of(self.variables[name].constant, rows)
            )
            for name, rows in shard.landmarks.items()
        }
        whole = {name: group.with_state(states[name]) for name, group in self.variables.items() if name not in part}
        return Problem({**whole, **part}, shard.factors())

    def _open(self, shard: Shard, states: States) -> tuple[Layout, NormalEquations, ReducedSystem, States]:
        with self.watch("setup"):
            problem = self._problem(shard, states)
            layout = lay_out(problem, tuple(shard.landmarks))
            equations = NormalEquations(layout, self.workers)
            return layout, equations, ReducedSystem(equations), to_solver_order(layout)

    def _linearize(self, equations: NormalEquations, system: ReducedSystem, states: States, damping: float) -> float:
        with self.watch("linearize"):
            system.clear()
            return equations.linearize(
                states, equations.prepare(states), lambda share, chunk: system.eliminate_chunk(share, chunk, damping)
            )

    def _form(self, states: States, damping: float) -> float:
        """Visit all shards to form the reduced system at given states; return the cost."""
        self.sums.clear()
        cost, factors, residuals = 0.0, 0, 0
        for shard in self.shards:
            layout, equations, system, own = self._open(shard, states)
            cost += self._linearize(equations, system, own, damping)
            with self.watch("schur"):
                self.sums.add(layout, system)
            factors += sum(map(len, layout.problem.factors))
            residuals += layout.problem.num_residuals
        self.report.num_factors, self.report.num_residuals = factors, residuals
        return cost

    def _advance(
        self, states: States, step: list[FloatArray], damping: float, lower: float
    ) -> tuple[States, float, float, float]:
        """Visit all shards to move the states, and form the reduced system there.

        Returns the states, their cost, the length of the step, and the landmarks' part of the predicted decrease.
        """
        trial = {**states, **self.sums.retract(states, step)}
        trial |= {name: states[name].copy() for shard in self.shards for name in shard.landmarks}
        squares = sum(float(part @ part) for part in step)
        self.sums.clear()
        cost, predicted = 0.0, 0.0
        for shard in self.shards:
            layout, equations, system, own = self._open(shard, states)
            self._linearize(equations, system, own, damping)
            with self.watch("backsubstitute"):
                deltas = system.landmark_steps(self.sums.part(layout, step))
                moved = {**own, **{name: trial[name] for name in self.kept}}
                for group, delta in zip(layout.eliminated, deltas, strict=True):
                    manifold = self.variables[group.group].manifold
                    moved[group.group] = manifold.retract(own[group.group], delta.reshape(group.count, group.dof))
                predicted += 0.5 * (damping * system.landmark_squares - system.landmark_slope)
                squares += sum(float(delta @ delta) for delta in deltas)
                back = to_original_order(layout, moved)
                for name, rows in shard.landmarks.items():
                    trial[name][rows] = back[name]
            cost += self._linearize(equations, system, moved, lower)
            with self.watch("schur"):
                self.sums.add(layout, system)
        return trial, cost, float(np.sqrt(squares)), predicted


# ------------------------------------------------------------------------------------------------------------ helpers


def _check(variables: Mapping[str, Variables], shards: Sequence[Shard]) -> None:
    """Every landmark is in one shard."""
    if not shards:
        raise ProblemError("There are no shards. Make one or more, each with some landmarks and their factors.")
    times: dict[str, IntArray] = {}
    for number, shard in enumerate(shards):
        for name, rows in shard.landmarks.items():
            if name not in variables:
                raise ProblemError(f"Shard {number} names the group {name!r}; there are {sorted(variables)}.")
            times.setdefault(name, np.zeros(len(variables[name]), np.int64))[rows] += 1
    for name, seen in times.items():
        wrong = np.flatnonzero(seen != 1)
        if len(wrong):
            raise ProblemError(
                f"Each landmark must be in one shard; {name!r} {wrong[0]} is in {seen[wrong[0]]}. "
                "Cut the rows of the group into slices that follow one another."
            )


def _rows_of(constant: bool | np.ndarray, rows: slice) -> bool | np.ndarray:
    return constant if isinstance(constant, bool | np.bool_) else constant[rows]


def _reduction(gain_ratio: float) -> float:
    """Nielsen's rule, without its growth."""
    return float(np.clip(1.0 - (2.0 * min(gain_ratio, 1.0) - 1.0) ** 3, 1.0 / 3.0, 1.0))


def _num_free(group: Variables) -> int:
    free = group.free_coordinates()
    return len(group) * group.manifold.dof if free is None else int(free.sum())


__all__ = ["Shard", "ShardedSolution", "solve_shards"]
