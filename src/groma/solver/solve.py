# SPDX-License-Identifier: BSD-3-Clause
"""The solve itself.

::

    linearise and eliminate
    repeat
        propose a step                                   (levenberg_marquardt.py or dogleg.py)
        move the states, evaluate the cost               -> gain ratio
        if the cost fell:  keep the states, test for convergence, linearise and eliminate again
        else:              shorten the step

When no free variable is coupled to another, each is solved on its own: see :mod:`groma.solver.independent`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from groma._typing import FloatArray
from groma.problem.lay_out import lay_out
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations, to_original_order, to_solver_order
from groma.problem.parallel import Workers, available_cores
from groma.problem.problem import Problem
from groma.solver.dogleg import Dogleg
from groma.solver.independent import STRETCH_GAIN_RATIO, solve_independently
from groma.solver.levenberg_marquardt import LevenbergMarquardt
from groma.solver.linear.blas import one_blas_thread
from groma.solver.linear.reduced import ConjugateGradients, choose
from groma.solver.linear.reduction import Reduction
from groma.solver.linear.schur import ReducedSystem
from groma.solver.options import SolverOptions, first_damping
from groma.solver.refinement import landmark_refiner
from groma.solver.report import (
    Iteration,
    SolveReport,
    Stopwatch,
    count_unknowns,
    note_end,
    note_start,
    warn_of_oddities,
)
from groma.solver.steps import States, gradient, largest, size_of
from groma.solver.termination import Termination, cost_converged
from groma.solver.trial import stretched, try_step

#: From this many factors on, all cores are used unless the caller says otherwise.
FACTORS_FOR_THREADS = 50_000
#: Where the blocks between landmarks and kept blocks would take more bytes than this, single precision keeps them.
COMPACT_FROM = 2**28

#: Called after every step tried; returning False stops the solve.
Progress = Callable[[Iteration], bool | None]


@dataclass(frozen=True)
class Solution:
    """The problem at its new states, and how it got there."""

    problem: Problem
    report: SolveReport

    def __getitem__(self, group: str) -> FloatArray:
        """Return the states of a group of variables."""
        return self.problem.variables[group].state


def solve(problem: Problem, options: SolverOptions | None = None, progress: Progress | None = None) -> Solution:
    r"""Minimise :math:`\tfrac12 \sum \rho(\lVert r \rVert^2)` over the free variables of a problem.

    Parameters
    ----------
    problem
        Variables and factors; not changed.
    options
        How to solve; the defaults suit bundle adjustment.
    progress
        Called with an :class:`Iteration` after every step tried; return False to stop.

    Returns
    -------
    Solution
        A new problem at the states found, and the report. Not converging is reported, not raised.

    Raises
    ------
    ProblemError
        If a factor couples two landmarks that were both to be eliminated.
    """
    options = options or SolverOptions()
    report = SolveReport(num_factors=sum(map(len, problem.factors)), num_residuals=problem.num_residuals)
    watch = Stopwatch(report)
    with watch("setup"):
        layout = lay_out(problem, options.eliminate)
    report.notes += layout.warnings
    report.num_unknowns = count_unknowns(problem)
    if not layout.factors:
        report.seconds["total"] = watch.elapsed()
        return Solution(problem, report)
    report.threads = options.threads or (available_cores() if report.num_factors >= FACTORS_FOR_THREADS else 1)
    workers = Workers(report.threads)
    try:
        run = _evaluate if options.max_iterations == 0 else _solve_jointly if layout.kept else solve_independently
        with one_blas_thread():
            states = run(layout, workers, options, report, watch, progress)
    finally:
        workers.close()
    warn_of_oddities(report)
    report.seconds["total"] = watch.elapsed()
    return Solution(problem.with_states(to_original_order(layout, states)), report)


def _evaluate(
    layout: Layout, workers: Workers, options: SolverOptions, report: SolveReport, watch: Stopwatch, progress
) -> States:
    """Find the costs at the start, and nothing else."""
    with watch("setup"):
        equations, states = NormalEquations(layout, workers), to_solver_order(layout)
    with watch("cost"):
        cost = equations.cost(equations.prepare(states))
    equations.num_degenerate = equations.hidden
    note_start(report, layout, equations, cost)
    note_end(report, layout, equations, 0)
    report.termination = Termination.MAX_ITERATIONS if np.isfinite(cost) else Termination.NOT_FINITE
    return states


def _solve_jointly(
    layout: Layout, workers: Workers, options: SolverOptions, report: SolveReport, watch: Stopwatch, progress
) -> States:
    with watch("setup"):
        equations = NormalEquations(layout, workers, compact=_bytes_of_blocks(layout) > COMPACT_FROM)
        system = ReducedSystem(equations)
        linear = choose(layout, options.linear_solver)
        refiner = landmark_refiner(layout, workers, options)
        states = to_solver_order(layout)
    report.linear_solver = linear.name
    strategy = {"levenberg_marquardt": LevenbergMarquardt, "dogleg": Dogleg}[options.strategy](
        Reduction(equations, system, linear, watch), first_damping(layout, options)
    )
    inputs = equations.prepare(states)
    cost = strategy.linearize(states, inputs)
    costs, hidden = equations.costs, sum(equations.num_degenerate)
    note_start(report, layout, equations, cost)
    if not np.isfinite(cost):
        report.termination = Termination.NOT_FINITE
        return states
    share = cost / max(1, sum(len(layout_.factor) for layout_ in layout.factors))
    termination, fell = None, 0.0
    while termination is None:
        slope = largest(gradient(equations))
        if slope <= options.gradient_tolerance:
            termination = Termination.GRADIENT_CONVERGED
            break
        if report.iterations == options.max_iterations:
            termination = Termination.MAX_ITERATIONS
            break
        report.iterations += 1
        fell_before, fell = fell, 0.0
        damping = strategy.damping
        trial = try_step(equations, strategy, watch, states, cost)
        # a factor that became degenerate counts nothing; without its share put back, steps would hide what they spoil
        accepted = trial is not None and trial.cost + max(0, trial.num_hidden - hidden) * share < cost
        if trial is not None and not accepted and refiner is not None:
            with watch("backsubstitute"):
                rescued = refiner.refine(equations, trial, instead=states)
            accepted = rescued.cost + max(0, rescued.num_hidden - hidden) * share < cost
            if accepted:
                trial = replace(rescued, gain_ratio=min((cost - rescued.cost) / trial.promised, 1.0))
        elif trial is not None and accepted:
            if trial.gain_ratio > STRETCH_GAIN_RATIO:
                with watch("cost"):
                    trial = stretched(equations, states, trial)
            if refiner is not None:
                with watch("backsubstitute"):
                    trial = refiner.refine(equations, trial)
        if trial is not None and accepted:
            fell, withheld = (cost - trial.cost) / cost, strategy.withheld / cost
            states, cost, costs = trial.states, trial.cost, trial.costs
            inputs, hidden = trial.inputs, trial.num_hidden
            strategy.accept(trial.gain_ratio)
            if cost_converged(fell, fell_before, trial.gain_ratio, withheld, options.function_tolerance):
                termination = Termination.COST_CONVERGED
            elif trial.length <= options.step_tolerance * size_of(states):
                termination = Termination.STEP_CONVERGED
        elif trial is not None and trial.promised <= options.function_tolerance * cost:
            termination = Termination.COST_CONVERGED  # even as promised the step would have ended the solve
        elif (trial is not None and trial.length <= 1e-14 * size_of(states)) or not strategy.refuse():
            termination = Termination.DAMPING_EXHAUSTED
        record = Iteration(
            iteration=report.iterations,
            cost=trial.cost if trial is not None else float("inf"),
            accepted=accepted,
            damping=damping,
            gain_ratio=trial.gain_ratio if trial is not None else 0.0,
            step_norm=trial.length if trial is not None else float("inf"),
            gradient_max=slope,
            linear_iterations=linear.num_iterations if isinstance(linear, ConjugateGradients) else 0,
            seconds=watch.elapsed(),
        )
        report.history.append(record)
        if progress is not None and progress(record) is False:
            termination = Termination.STOPPED_BY_CALLER
        if accepted and termination is None and report.iterations < options.max_iterations:
            strategy.linearize(states, inputs)
    report.termination = termination
    report.final_cost, equations.costs = cost, costs
    note_end(report, layout, equations, system.num_singular_landmarks)
    return states


def _bytes_of_blocks(layout: Layout) -> int:
    """Memory of the blocks W in double precision."""
    return sum(
        8 * len(incidences.block) * e.dof * layout.kept[c].width
        for e in layout.eliminated
        for c, incidences in e.incidences.items()
    )
