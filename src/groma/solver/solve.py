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
from groma.problem._parallel import Workers, available_cores
from groma.problem.lay_out import lay_out
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations, to_original_order, to_solver_order
from groma.problem.problem import Problem
from groma.solver._blas import one_blas_thread
from groma.solver.dogleg import Dogleg
from groma.solver.independent import MAX_STRETCH, STRETCH_GAIN_RATIO, IndependentBlocks
from groma.solver.levenberg_marquardt import LevenbergMarquardt
from groma.solver.linear import ConjugateGradients, choose
from groma.solver.options import SolverOptions
from groma.solver.report import Iteration, SolveReport, Stopwatch
from groma.solver.schur import ReducedSystem
from groma.solver.steps import States, Step, gradient, largest, retract, size_of
from groma.solver.termination import Termination

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
    report.num_unknowns = _count_unknowns(problem)
    if not layout.factors:
        report.seconds["total"] = watch.elapsed()
        return Solution(problem, report)
    report.threads = options.threads or (available_cores() if report.num_factors >= FACTORS_FOR_THREADS else 1)
    workers = Workers(report.threads)
    try:
        run = _solve_jointly if layout.kept else _solve_independently
        with one_blas_thread():
            states = run(layout, workers, options, report, watch, progress)
    finally:
        workers.close()
    _note_oddities(report)
    report.seconds["total"] = watch.elapsed()
    return Solution(problem.with_states(to_original_order(layout, states)), report)


def _solve_jointly(
    layout: Layout, workers: Workers, options: SolverOptions, report: SolveReport, watch: Stopwatch, progress
) -> States:
    with watch("setup"):
        equations = NormalEquations(layout, workers, compact=_bytes_of_blocks(layout) > COMPACT_FROM)
        system = ReducedSystem(equations)
        linear = choose(layout, options.linear_solver)
        refiner = _landmark_refiner(layout, workers, options)
        states = to_solver_order(layout)
    report.linear_solver = linear.name
    strategy = {"levenberg_marquardt": LevenbergMarquardt, "dogleg": Dogleg}[options.strategy](
        equations, system, linear, watch, _initial_damping(layout, options)
    )
    with watch("cost"):
        inputs = equations.prepare(states)
        cost = equations.cost(inputs)
    costs = equations.costs
    _start(report, layout, equations, cost)
    if not np.isfinite(cost):
        report.termination = Termination.NOT_FINITE
        return states
    hidden = equations.num_hidden
    share = cost / max(1, sum(len(layout_.factor) for layout_ in layout.factors))
    strategy.linearize(states, inputs)
    termination = None
    while termination is None:
        slope = largest(gradient(equations))
        if slope <= options.gradient_tolerance:
            termination = Termination.GRADIENT_CONVERGED
            break
        if report.iterations == options.max_iterations:
            termination = Termination.MAX_ITERATIONS
            break
        report.iterations += 1
        damping = strategy.damping
        trial = _try_step(layout, equations, strategy, watch, states, cost)
        # a factor that became degenerate counts nothing; without its share put back, steps would hide what they spoil
        accepted = trial is not None and trial.cost + max(0, trial.hidden - hidden) * share < cost
        if trial is not None and not accepted and refiner is not None:
            with watch("backsubstitute"):
                rescued = refiner.refine(equations, trial, instead=states)
            accepted = rescued.cost + max(0, rescued.hidden - hidden) * share < cost
            if accepted:
                trial = replace(rescued, gain_ratio=min((cost - rescued.cost) / trial.promised, 1.0))
        elif trial is not None and accepted:
            if trial.gain_ratio > STRETCH_GAIN_RATIO:
                with watch("cost"):
                    trial = _stretched(layout, equations, states, trial)
            if refiner is not None:
                with watch("backsubstitute"):
                    trial = refiner.refine(equations, trial)
        if trial is not None and accepted:
            decrease, old_cost, costs = cost - trial.cost, cost, trial.costs
            states, cost, inputs, hidden = trial.states, trial.cost, trial.inputs, trial.hidden
            strategy.accept(trial.gain_ratio)
            if decrease <= options.function_tolerance * old_cost:
                termination = Termination.COST_CONVERGED
            elif trial.length <= options.step_tolerance * size_of(states):
                termination = Termination.STEP_CONVERGED
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
    _finish(report, layout, equations, system.num_singular_landmarks)
    return states


@dataclass(frozen=True)
class _Trial:
    """States after a step, with what was found there."""

    step: Step
    states: States
    inputs: list[tuple]
    cost: float
    #: Actual over predicted decrease of the cost.
    gain_ratio: float
    length: float
    #: Degenerate factors at the new states.
    hidden: int
    #: The decrease of the quadratic model.
    promised: float
    #: Costs by factor group.
    costs: list[float]


def _try_step(
    layout: Layout,
    equations: NormalEquations,
    strategy: LevenbergMarquardt | Dogleg,
    watch,
    states: States,
    cost: float,
) -> _Trial | None:
    """Propose a step and evaluate the cost after it; None if the linear system could not be solved."""
    proposal = strategy.propose()
    if proposal is None:
        return None
    step, predicted = proposal
    with watch("backsubstitute"):
        moved = retract(layout, states, step)
    with watch("cost"):
        inputs = equations.prepare(moved)
        new_cost = equations.cost(inputs)
    ratio = (cost - new_cost) / predicted if predicted > 0 else 0.0
    found = (float(ratio), step.norm(), equations.num_hidden, predicted, equations.costs)
    return _Trial(step, moved, inputs, new_cost, *found)


def _stretched(layout: Layout, equations: NormalEquations, states: States, trial: _Trial) -> _Trial:
    r"""Try a multiple of an accepted step, and return the better trial.

    Robust losses bend the cost down, so reweighted least squares overestimates the curvature. If the curvature along
    the step is the fraction c of the model's, the gain ratio is 2 - c and the minimum lies at 1 / c times the step.
    """
    factor = min(1.0 / max(2.0 - trial.gain_ratio, 1.0 / MAX_STRETCH), MAX_STRETCH)
    moved = retract(layout, states, trial.step.blend(factor, trial.step, 0.0))
    inputs = equations.prepare(moved)
    cost = equations.cost(inputs)
    better = {"states": moved, "inputs": inputs, "cost": cost, "costs": equations.costs}
    return replace(trial, **better, hidden=equations.num_hidden) if cost < trial.cost else trial


# ------------------------------------------------------------------------------------------- landmarks on their own


class _LandmarkRefiner:
    """A few steps of each landmark on its own, cameras held; a step that does not lower its cost is undone.

    It follows every accepted step. It also rescues steps that would be refused: a few landmarks with a strongly bent
    cost, such as lines over a short baseline, would otherwise hold back all cameras.
    """

    def __init__(self, layout: Layout, workers: Workers, groups: list[str], steps: int) -> None:
        held = {
            name: group if name in groups else replace(group, constant=True)
            for name, group in layout.problem.variables.items()
        }
        factors = [f for f in layout.problem.factors if any(ref.group in groups for _, ref in f.references())]
        self._outer, self._steps = layout, steps
        self._blocks = IndependentBlocks(lay_out(Problem(held, factors), tuple(groups)), workers, 1e-6)

    def refine(self, equations: NormalEquations, trial: _Trial, instead: States | None = None) -> _Trial:
        """Return the trial with better landmarks.

        Landmarks start from the trial, or from the states ``instead`` where those cost less with the new cameras.
        """
        inner = to_original_order(self._outer, trial.states)
        self._blocks.reset()
        costs = self._blocks.costs(inner)
        if instead is not None:
            before = to_original_order(self._outer, instead)
            groups = [e.group for e in self._blocks.layout.eliminated]
            unmoved = {**inner, **{group: before[group] for group in groups}}
            for e, (group, kept_costs) in enumerate(zip(groups, self._blocks.costs(unmoved), strict=True)):
                better = kept_costs < costs[e]
                inner[group] = np.where(better[:, None], before[group], inner[group])
                costs[e] = np.where(better, kept_costs, costs[e])
        for _ in range(self._steps):
            inner, costs, _ = self._blocks.step(inner, costs)
        refined = dict(trial.states)
        for group in self._outer.eliminated:
            if group.group in inner:
                refined[group.group] = np.ascontiguousarray(inner[group.group][group.order])
        inputs = equations.prepare(refined)
        cost = equations.cost(inputs)
        if cost >= trial.cost:
            return trial
        better = {"states": refined, "inputs": inputs, "cost": cost, "costs": equations.costs}
        return replace(trial, **better, hidden=equations.num_hidden)


def _landmark_refiner(layout: Layout, workers: Workers, options: SolverOptions) -> _LandmarkRefiner | None:
    groups = [
        e.group for e in layout.eliminated if options.landmark_groups is None or e.group in options.landmark_groups
    ]
    if options.landmark_steps == 0 or not groups:
        return None
    return _LandmarkRefiner(layout, workers, groups, options.landmark_steps)


def _bytes_of_blocks(layout: Layout) -> int:
    """Memory of the blocks W in double precision."""
    return sum(
        8 * len(incidences.block) * e.dof * layout.kept[c].width
        for e in layout.eliminated
        for c, incidences in e.incidences.items()
    )


def _initial_damping(layout: Layout, options: SolverOptions) -> float:
    """Lines are more bent than points, and long first steps throw some into minima of their own."""
    if options.initial_damping is not None:
        return options.initial_damping
    variables = layout.problem.variables.values()
    moving_lines = any(group.manifold.kind == "line" and not group.is_constant for group in variables)
    return 1e-4 if moving_lines else 1e-5


def _solve_independently(
    layout: Layout, workers: Workers, options: SolverOptions, report: SolveReport, watch: Stopwatch, progress
) -> States:
    with watch("setup"):
        blocks = IndependentBlocks(layout, workers, _initial_damping(layout, options), options.function_tolerance)
        states = to_solver_order(layout)
    report.linear_solver = "blocks"
    with watch("cost"):
        costs = blocks.costs(states)
    cost = float(sum(blocks.equations.costs))
    outside = cost - float(sum(part.sum() for part in costs))
    _start(report, layout, blocks.equations, cost)
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
    _finish(report, layout, blocks.equations, blocks.num_singular)
    return states


# ------------------------------------------------------------------------------------------------------- reporting


def _count_unknowns(problem: Problem) -> int:
    total = 0
    used = {ref.group for factor in problem.factors if len(factor) for _, ref in factor.references()}
    for name in used:
        group = problem.variables[name]
        free = group.free_coordinates()
        total += len(group) * group.manifold.dof if free is None else int(free.sum())
    return total


def _by_type(layout: Layout, values: list) -> dict:
    totals: dict = {}
    for factor, value in zip(layout.factors, values, strict=True):
        totals[factor.factor.type_name] = totals.get(factor.factor.type_name, 0) + value
    return totals


def _start(report: SolveReport, layout: Layout, equations: NormalEquations, cost: float) -> None:
    report.initial_cost = report.final_cost = cost
    report.initial_costs = report.final_costs = _by_type(layout, equations.costs)


def _finish(report: SolveReport, layout: Layout, equations: NormalEquations, singular: int) -> None:
    report.final_costs = _by_type(layout, equations.costs)
    report.num_degenerate = {name: n for name, n in _by_type(layout, equations.num_degenerate).items() if n}
    report.num_underdetermined_landmarks = singular


def _note_oddities(report: SolveReport) -> None:
    for name, count in report.num_degenerate.items():
        report.warnings.append(
            f"{count} factor(s) of type {name!r} could not be evaluated (degenerate geometry) and were left out."
        )
    if report.num_underdetermined_landmarks:
        report.warnings.append(
            f"{report.num_underdetermined_landmarks} landmark(s) have a direction that the observations do not "
            "determine; it was left where it was."
        )
    if report.num_residuals < report.num_unknowns:
        report.warnings.append(
            f"There are fewer residuals ({report.num_residuals}) than unknowns ({report.num_unknowns}): the result is "
            "one of many. Hold variables constant, add priors or add observations."
        )
