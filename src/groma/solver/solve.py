# SPDX-License-Identifier: BSD-3-Clause
"""The solve itself: one loop of damped least squares for every kind of problem.

::

    start
    repeat
        linearise                                        (and eliminate, where there are landmarks)
        try a step                                       -> cost, gain ratio
        improve it                                       (a longer one; landmarks on their own)
        if the cost fell:  accept the step, lower the damping, test for convergence
        else:              refuse it, raise the damping

The problems are a joint one (``joint.py``), variables that are not coupled to each other (``independent.py``), and
landmarks in shards (``reduce/shards.py``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from groma._stopwatch import Stopwatch
from groma._typing import FloatArray
from groma.errors import check_kind, given_or_default
from groma.execution import available_cores
from groma.problem.lay_out import Layouts
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations, to_original_order, to_solver_order
from groma.problem.parallel import FACTORS_FOR_THREADS, Workers
from groma.problem.problem import Problem
from groma.solver.damped_problem import DampedProblem, T
from groma.solver.independent import STRETCH, IndependentProblem, stretch_factor
from groma.solver.joint import JointProblem
from groma.solver.linear.blas import one_blas_thread
from groma.solver.options import SolverOptions
from groma.solver.report import Iteration, SolveReport, count_unknowns, note_costs, warn_of_oddities
from groma.solver.standing import Standing
from groma.solver.steps import States
from groma.solver.termination import Criteria, Termination, is_beyond_cost

#: Called after every step tried; returning False stops the solve.
Progress = Callable[[Iteration], bool | None]


@dataclass(frozen=True)
class Solution:
    """The solved problem and the report of the solve."""

    problem: Problem
    report: SolveReport

    def __getitem__(self, group: str) -> FloatArray:
        """Return the states of a group of variables."""
        return self.problem.variables[group].state


def solve(
    problem: Problem,
    options: SolverOptions | None = None,
    progress: Progress | None = None,
    layouts: Layouts | None = None,
) -> Solution:
    r"""Minimise :math:`\tfrac12 \sum \rho(\lVert r \rVert^2)` over the free variables of a problem.

    Parameters
    ----------
    problem
        Variables and factors; not modified.
    options
        How to solve; the defaults suit bundle adjustment.
    progress
        Called with an :class:`Iteration` after every step tried; return False to stop.
    layouts
        For a sequence of solves of the same problem, at other states or under other losses: what is common to
        them is found once.

    Returns
    -------
    Solution
        A new problem at the states found, and the report. Not converging is reported, not raised.

    Raises
    ------
    ProblemError
        If a factor couples two landmarks that were both to be eliminated.
    """
    check_kind(problem, Problem, "problem", "Make one: groma.Problem(variables, factors).")
    options = given_or_default(options, SolverOptions)
    report = SolveReport(num_factors=sum(map(len, problem.factors)), num_residuals=problem.num_residuals)
    watch = Stopwatch(report.seconds)
    with watch("setup"):
        parts, layout = (layouts or Layouts()).of(problem, options.eliminate)
    report.notes += layout.warnings
    report.num_unknowns = count_unknowns(problem)
    if not layout.factors:
        report.seconds["total"] = watch.elapsed()
        return Solution(problem, report)
    report.threads = options.threads or (available_cores() if report.num_factors >= FACTORS_FOR_THREADS else 1)
    workers = Workers(report.threads)
    try:
        with one_blas_thread():
            if options.max_iterations:
                states = _minimised(layout, workers, options, report, watch, progress)
            else:
                states = _evaluate(layout, workers, report, watch)
    finally:
        workers.close()
    warn_of_oddities(report)
    report.seconds["total"] = watch.elapsed()
    found = parts.join(to_original_order(layout, states)).items()
    return Solution(
        problem.with_states({name: problem.variables[name].held_kept(state) for name, state in found}), report
    )


def minimise(
    problem: DampedProblem[T],
    options: SolverOptions,
    report: SolveReport,
    watch: Stopwatch,
    progress: Progress | None = None,
    standing: Standing | None = None,
    keep: Callable[[Standing], None] | None = None,
) -> Termination:
    """Step until a criterion is met, and return which; the states are the problem's own.

    A loop that gets the ``standing`` of an earlier one resumes there. ``keep`` is called after every
    accepted step.
    """
    best = problem.start()
    report.initial_cost = report.final_cost = best.cost
    if not np.isfinite(best.cost):
        return Termination.NOT_FINITE
    if best.num_hidden == problem.num_factors:
        return Termination.NO_FACTOR_COUNTS
    criteria = Criteria(options)
    if standing is not None:
        report.initial_cost, report.history = standing.initial_cost, list(standing.history)
        report.iterations, criteria.fell = len(standing.history), standing.fell
        if standing.ended is not None:
            return standing.ended
    share = report.initial_cost / max(1, problem.num_factors)
    while report.iterations < options.max_iterations:
        problem.linearize()
        slope, damping = problem.largest_gradient(), problem.damping
        if slope <= options.gradient_tolerance:
            return Termination.GRADIENT_CONVERGED if problem.is_curved() else Termination.NO_FACTOR_COUNTS
        step = problem.try_step()
        if not report.iterations and step.promised <= options.start_tolerance * best.cost:
            return Termination.COST_CONVERGED
        report.iterations += 1
        trial, accepted = _improved(problem, step, best, share)
        if accepted:
            problem.accept(trial)
            ended = criteria.after_accepted(trial, best)
            best = trial
        else:
            ended = criteria.after_refused(trial, best) or problem.refuse(trial)
        report.final_cost = best.cost
        record = Iteration(
            iteration=report.iterations,
            cost=trial.cost,
            accepted=accepted,
            damping=damping,
            gain_ratio=trial.gain_ratio,
            step_norm=trial.length,
            gradient_max=slope,
            linear_iterations=problem.linear_iterations,
            seconds=watch.elapsed(),
        )
        report.history.append(record)
        if accepted and keep is not None:
            keep(Standing(report.initial_cost, criteria.fell, tuple(report.history), ended))
        if progress is not None and progress(record) is False:
            return Termination.STOPPED_BY_CALLER
        if ended is not None:
            return ended
    return Termination.MAX_ITERATIONS


def _improved(problem: DampedProblem[T], trial: T, best: T, share: float) -> tuple[T, bool]:
    """Return a trial, or a better one from where it led, and whether to accept it."""
    if is_beyond_cost(trial, best):
        return replace(trial, gain_ratio=1.0), True
    if not trial.lowers(best, share):
        rescued = problem.rescue(trial)
        return (rescued, True) if rescued.lowers(best, share) else (trial, False)
    if trial.gain_ratio > STRETCH.longer:
        longer = problem.stretch(trial, stretch_factor(trial.gain_ratio))
        trial = longer if longer.lowers(trial, share) else trial
    return problem.refine(trial), True


def _evaluate(layout: Layout, workers: Workers, report: SolveReport, watch: Stopwatch) -> States:
    """Find the costs at the start, and nothing else."""
    with watch("setup"):
        equations, states = NormalEquations(layout, workers), to_solver_order(layout)
    with watch("cost"):
        cost = equations.cost(equations.prepare(states))
    equations.num_degenerate = equations.hidden
    report.initial_cost = report.final_cost = cost
    note_costs(report, layout, equations, equations.costs, 0)
    report.termination = Termination.MAX_ITERATIONS if np.isfinite(cost) else Termination.NOT_FINITE
    if equations.num_hidden == sum(len(factor.factor) for factor in layout.factors):
        report.termination = Termination.NO_FACTOR_COUNTS
    return states


def _minimised(
    layout: Layout, workers: Workers, options: SolverOptions, report: SolveReport, watch: Stopwatch,
    progress: Progress | None,
) -> States:  # fmt: skip
    """Minimise from the states of the layout's problem."""
    kind: type[Any] = JointProblem if layout.kept else IndependentProblem
    problem = kind(layout, workers, options, watch)
    report.linear_solver = problem.linear_name
    report.termination = minimise(problem, options, report, watch, progress)
    problem.note_end(report)
    return problem.states
