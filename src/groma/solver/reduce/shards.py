# SPDX-License-Identifier: BSD-3-Clause
r"""A solve whose observations do not fit into memory: landmarks come in shards, one shard at a time.

Eliminating a landmark needs nothing but its own factors, and what it leaves behind,

.. math:: S = \sum_{\text{shards}} \big(H + W^\top N W\big), \qquad
          b = -\sum_{\text{shards}} \big(g_c + W^\top N g_l\big),

has the size of the cameras. So a shard is laid out, linearised and eliminated, its part is added to S and b, and it is
forgotten. The step of the cameras found, the shard is formed once more for the steps of its landmarks, and in the same
visit it is linearised at the new states: one visit of every shard a step. Memory is that of the states, of the reduced
system, and of the largest shard.

The loop is that of every solve, :func:`groma.solver.solve.minimise`. But the damping of the next linearisation must be
known before the cost is. So it falls by what the gain ratio of the step before suggests, up to a third, and grows as in
:mod:`groma.solver.levenberg_marquardt` after a refused step, for which the shards are visited once more. In the same
way a step is not stretched after it was tried: where the last one found the cost less curved than the model, as robust
losses make it, the next one is made longer at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from groma._stopwatch import Stopwatch
from groma._typing import FloatArray
from groma.errors import ProblemError
from groma.problem.linearization import NormalEquations, to_original_order, to_solver_order
from groma.problem.parallel import Workers
from groma.problem.variables import Variables
from groma.solver.damped_problem import Trial
from groma.solver.levenberg_marquardt import damping_from, predicted_decrease
from groma.solver.linear.blas import one_blas_thread
from groma.solver.linear.schur import ReducedSystem
from groma.solver.options import DAMPING, SolverOptions, first_damping
from groma.solver.reduce.contract import Reducer
from groma.solver.reduce.journal import Journal, Waypoint
from groma.solver.reduce.shard import OpenShard, Shard, Shelf
from groma.solver.reduce.shared_system import NUM_FOUND, SharedSystem
from groma.solver.reduce.single import SingleProcess
from groma.solver.report import SolveReport
from groma.solver.solve import Progress, minimise
from groma.solver.standing import Standing
from groma.solver.steps import States, share_of_states, squares_of_states, squares_of_step
from groma.solver.termination import Termination

#: With more cameras than this the reduced system is not formed: it would take 2 GB and more on every process (cost:
#: memory).
MAX_FORMED = 50_000
#: How much longer a step is made, at most. Over 24 random scenes under a Cauchy loss shards were visited 1136 times in
#: all without it, 781 times with it, 907 times with a limit of 3.
MAX_STRETCH = 2.0


@dataclass(frozen=True)
class ShardedSolution:
    """All variables at their new states, and the step that led there."""

    variables: dict[str, Variables]
    report: SolveReport


def solve_shards(
    variables: Mapping[str, Variables],
    shards: Sequence[Shard],
    options: SolverOptions | None = None,
    progress: Progress | None = None,
    reducer: Reducer | None = None,
    room: float = 0.0,
    journal: Journal | None = None,
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
        ``landmark_steps`` and ``eliminate`` are not used.
    progress
        Called with an :class:`Iteration` after every step tried; return False to stop.
    reducer
        Where several processes solve one problem, each with some of its shards and their landmarks: how they sum what
        they find. Kept variables are the same on all of them. Default: one process has all shards.
    room
        Bytes of memory for shards that stay from one visit to the next.
    journal
        State to resume from, and the place where states are saved.

    Returns
    -------
    ShardedSolution
        States of all variables, and the report. Not converging is reported, not raised.

    Raises
    ------
    ProblemError
        If landmarks are in no shard or in two, or a factor of a shard does not fit.
    """
    options, reducer = options or SolverOptions(), reducer or SingleProcess()
    _check(variables, shards, reducer)
    report = SolveReport()
    watch = Stopwatch(report.seconds)
    report.threads = options.threads or reducer.num_cores
    workers = Workers(report.threads)
    try:
        with one_blas_thread():
            problem = ShardedProblem(variables, shards, workers, options, watch, (reducer, Shelf(variables, room)))
            standing, keep = None, None
            if journal is not None:
                keep = partial(problem.keep, journal)
                if journal.begin is not None:
                    problem.go_on_from(journal.begin)
                    standing = journal.begin.standing
            report.termination = minimise(problem, options, report, watch, progress, standing, keep)
    finally:
        workers.close()
    report.linear_solver, report.num_unknowns = problem.linear_name, problem.num_unknowns
    report.num_factors, report.num_residuals = problem.num_factors, problem.num_residuals
    report.seconds["total"] = watch.elapsed()
    states = problem.states
    return ShardedSolution(
        {name: group.with_state(group.held_kept(states[name])) for name, group in variables.items()}, report
    )


@dataclass(frozen=True, kw_only=True)
class ShardedTrial(Trial):
    """States of all variables."""

    states: States
    #: Curvature of the cost along the step that led here, over that of the quadratic model.
    curvature: float = 1.0


class ShardedProblem:
    """Variables whose landmarks come in shards; a :class:`groma.solver.damped_problem.DampedProblem`."""

    def __init__(
        self,
        variables: Mapping[str, Variables],
        shards: Sequence[Shard],
        workers: Workers,
        options: SolverOptions,
        watch: Stopwatch,
        company: tuple[Reducer, Shelf],
    ) -> None:
        self._variables, self._shards, self._workers, self._options = variables, shards, workers, options
        self._watch, (self._reducer, self._shelf) = watch, company
        self._landmarks = {group for shard in shards for group in shard.landmarks}
        self._kept = {
            name: group for name, group in variables.items() if name not in self._landmarks and not group.is_constant
        }
        poses = sum(len(group) for group in self._kept.values() if group.manifold.kind == "pose")
        wanted = options.shared_system
        formed = wanted == "formed" or (
            wanted == "auto" and (poses <= MAX_FORMED or options.linear_solver not in ("auto", "pcg"))
        )
        self._sums = SharedSystem(self._kept, self._reducer, formed)
        first = replace(options, initial_damping=options.initial_damping or DAMPING.points)
        self._damping = damping_from(first_damping(variables, first), variables)
        self._last_ratio = self._curvature = 1.0
        self._here = ShardedTrial(cost=np.nan, states={name: group.state for name, group in variables.items()})
        #: Whether the shared system is that of the present states and damping.
        self._formed = False
        #: Root of the sum over all shards of the squares of their landmarks' largest slopes.
        self._steepest = 0.0
        self.num_factors = self.num_residuals = self.num_unknowns = self.linear_iterations = 0
        self.linear_name = ""

    @property
    def states(self) -> States:
        """The present states."""
        return self._here.states

    def go_on_from(self, waypoint: Waypoint) -> None:
        """Take over the damping state of an earlier solve, at whose states this one starts."""
        self._damping.value = waypoint.damping
        self._last_ratio, self._curvature = waypoint.last_ratio, waypoint.curvature

    def keep(self, journal: Journal, standing: Standing) -> None:
        """Write down where the solve stands."""
        journal.keep(self.states, Waypoint(standing, self._damping.value, self._last_ratio, self._curvature))

    @property
    def damping(self) -> float:  # noqa: D102
        return self._damping.value

    def start(self) -> ShardedTrial:  # noqa: D102
        cost, num_hidden = self._form()
        self._here = replace(self._here, cost=cost, num_hidden=num_hidden)
        return self._here

    def linearize(self) -> None:  # noqa: D102
        if not self._formed:
            self._form()

    def largest_gradient(self) -> float:
        """Return the largest component of the gradient, over the root of its curvature; of landmarks a bound."""
        return max(self._sums.largest_gradient(), self._steepest)

    def is_curved(self) -> bool:  # noqa: D102
        return self._sums.is_curved()

    def try_step(self) -> ShardedTrial:
        """Solve the shared system, and visit all shards: they are moved, and linearised where they come to be."""
        with self._watch("solve"):
            step, residual = self._shared_step()
        if step is None:
            return self._here.without_step()
        model = self._sums.model(step)
        factor = 1.0 / self._curvature
        visit = self._advance(step, factor)
        decrease, withheld = predicted_decrease(model, residual, (visit.squares, visit.slope), self.damping)
        slope, bend = 2.0 * decrease - withheld, 2.0 * (decrease - withheld)
        promised = factor * slope - 0.5 * factor**2 * self._curvature * bend
        fell = self._here.cost - visit.cost
        return ShardedTrial(
            cost=visit.cost,
            num_hidden=visit.num_hidden,
            gain_ratio=fell / max(promised, 1e-300),
            promised=promised,
            length=factor * float(np.sqrt(visit.lengths.sum())),
            relative_length=factor * share_of_states(visit.lengths, visit.sizes),
            withheld=withheld,
            states=visit.states,
            curvature=2.0 * (factor * slope - fell) / max(factor**2 * bend, 1e-300),
        )

    def _shared_step(self) -> tuple[list[FloatArray] | None, list[FloatArray] | None]:
        """Solve the shared system; return the step, if there is one, and what an iterative solver leaves."""
        if not self._kept:  # landmarks alone
            return [], None
        layout, S, rhs = self._sums.system(self.damping)
        linear = self._sums.solver(layout, self._options.linear_solver)
        linear.follow(self.states)
        step = linear.solve(S, rhs)
        self.linear_name, self.linear_iterations = linear.name, linear.num_iterations
        return step, linear.residual

    def stretch(self, trial: ShardedTrial, factor: float) -> ShardedTrial:
        """Leave the trial as it is: a longer one would take another visit. The next step is longer instead."""
        return trial

    def refine(self, trial: ShardedTrial) -> ShardedTrial:  # noqa: D102
        return trial

    def rescue(self, trial: ShardedTrial) -> ShardedTrial:  # noqa: D102
        return trial

    def accept(self, trial: ShardedTrial) -> None:
        """Take the states of a trial; the shared system was formed there with the lower damping."""
        self._here = trial
        self._damping.accept(self._known_ratio)
        self._last_ratio, self._curvature = trial.gain_ratio, min(max(trial.curvature, 1.0 / MAX_STRETCH), 1.0)

    def refuse(self, trial: ShardedTrial) -> Termination | None:  # noqa: D102
        self._last_ratio, self._curvature, self._formed = trial.gain_ratio, 1.0, False
        return self._damping.refuse(trial)

    @property
    def _known_ratio(self) -> float:
        """The gain ratio that the next damping follows: that of the step before. It does not raise the damping."""
        return max(self._last_ratio, 0.5)

    def _open(self, shard: Shard, states: States) -> tuple[OpenShard, NormalEquations, ReducedSystem, States]:
        with self._watch("setup"):
            opened = self._shelf.open(shard, states)
            equations = NormalEquations(opened.layout, self._workers)
            return opened, equations, ReducedSystem(equations), to_solver_order(opened.layout)

    def _linearize(self, equations: NormalEquations, system: ReducedSystem, states: States, damping: float) -> float:
        with self._watch("linearize"):
            system.clear()
            return equations.linearize(
                states, equations.prepare(states), lambda share, chunk: system.eliminate_chunk(share, chunk, damping)
            )

    def _form(self) -> tuple[float, int]:
        """Visit all shards to form the shared system; return the cost and the number of degenerate factors."""
        self._sums.clear()
        self._formed = True
        free = sum(group.num_free for name, group in self._variables.items() if name in self._landmarks)
        self._sums.find(_found(0.0, 0.0, 0.0, 0.0, free))
        for shard in self._shards:
            opened, equations, system, own = self._open(shard, self.states)
            cost = self._linearize(equations, system, own, self.damping)
            with self._watch("schur"):
                self._sums.add(opened.layout, system)
            counts = sum(equations.num_degenerate), opened.num_factors, opened.num_residuals
            self._sums.find(_found(cost, *counts, steepest=system.largest_landmark_slope()))
        cost, num_hidden, factors, residuals, unknowns = self._sum_up()[:5]
        self.num_factors, self.num_residuals = int(factors), int(residuals)
        self.num_unknowns = int(unknowns) + sum(group.num_free for group in self._kept.values())
        return float(cost), int(num_hidden)

    def _sum_up(self) -> FloatArray:
        """Sum the shared system, and what else was found, over all processes."""
        with self._watch("schur"):
            found = self._sums.reduce()
        self._steepest = float(np.sqrt(found[-1]))
        return found

    def _advance(self, step: list[FloatArray], factor: float) -> _Visit:
        """Visit all shards to move the states by a multiple of a step, and form the shared system there.

        The damping is that of the next step.
        """
        states, lower = self.states, self._damping.lowered(self._known_ratio)
        trial = {**states, **self._sums.retract(states, [factor * delta for delta in step])}
        trial |= {name: states[name].copy() for name in self._landmarks}
        self._sums.clear()
        for shard in self._shards:
            opened, equations, system, own = self._open(shard, states)
            layout, lengths = opened.layout, np.zeros(6)
            self._linearize(equations, system, own, self.damping)
            with self._watch("backsubstitute"):
                deltas = system.landmark_steps(self._sums.part(layout, step))
                moved = {**own, **{name: trial[name] for name in self._kept}}
                for group, delta in zip(layout.eliminated, deltas, strict=True):
                    manifold = self._variables[group.group].manifold
                    moved[group.group] = manifold.retract(
                        own[group.group], factor * delta.reshape(group.count, group.dof)
                    )
                back = to_original_order(layout, moved)
                for name, rows in shard.landmarks.items():
                    trial[name][rows] = back[name]
                model = (system.landmark_squares, system.landmark_slope)
                for group, delta in zip(layout.eliminated, deltas, strict=True):
                    lengths += self._lengths(group.group, own[group.group], delta)
            cost = self._linearize(equations, system, moved, lower)
            with self._watch("schur"):
                self._sums.add(layout, system)
            found = cost, sum(equations.num_degenerate), *model, *lengths
            self._sums.find(_found(*found, steepest=system.largest_landmark_slope()))
        found = self._sum_up()
        cost, num_hidden, squares, slope = (float(value) for value in found[:4])
        lengths = found[4:10].copy()
        for name, delta in zip(self._kept, step, strict=True):
            lengths += self._lengths(name, states[name], delta)
        return _Visit(trial, cost, int(num_hidden), lengths[:3], lengths[3:], squares, slope)

    def _lengths(self, group: str, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Return the squares of a step of a group, and of its states (6,); see :mod:`groma.solver.steps`."""
        manifold = self._variables[group].manifold
        squares = squares_of_step(manifold, delta.reshape(len(state), manifold.dof))
        return np.concatenate([squares, squares_of_states(manifold, state)])


@dataclass(frozen=True)
class _Visit:
    """What a visit of all shards found at the states after a step."""

    states: States
    cost: float
    num_hidden: int
    #: Squares of the step and of the states it began from, in three parts each.
    lengths: FloatArray
    sizes: FloatArray
    #: Over all landmarks: delta D delta and g delta.
    squares: float
    slope: float


# ------------------------------------------------------------------------------------------------------------ helpers


def _check(variables: Mapping[str, Variables], shards: Sequence[Shard], reducer: Reducer) -> None:
    """Every landmark is in one shard."""
    if not any(map(int, reducer.gather(str(len(shards))))):
        raise ProblemError("There are no shards. Make one or more, each with some landmarks and their factors.")
    times: dict[str, FloatArray] = {}
    for number, shard in enumerate(shards):
        for name, rows in shard.landmarks.items():
            if name not in variables:
                raise ProblemError(f"Shard {number} names the group {name!r}; there are {sorted(variables)}.")
            times.setdefault(name, np.zeros(len(variables[name])))[rows] += 1
    for name, seen in times.items():
        wrong = np.flatnonzero(seen != 1)
        if len(wrong):
            raise ProblemError(
                f"Each landmark must be in one shard; {name!r} {wrong[0]} is in {int(seen[wrong[0]])}. "
                "Cut the rows of the group into slices that follow one another."
            )


def _found(*first: float, steepest: float = 0.0) -> FloatArray:
    """Return what a shard adds to the sums besides its system: first numbers, and the largest slope of landmarks."""
    return np.array([*first, *[0.0] * (NUM_FOUND - 1 - len(first)), steepest**2])


__all__ = ["Shard", "ShardedProblem", "ShardedSolution", "solve_shards"]
