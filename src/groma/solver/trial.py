# SPDX-License-Identifier: BSD-3-Clause
"""A step that is tried: the states after it, their cost, and what a longer one would give."""

from __future__ import annotations

from dataclasses import dataclass, replace

from groma.problem.linearization import NormalEquations
from groma.solver.dogleg import Dogleg
from groma.solver.independent import MAX_STRETCH
from groma.solver.levenberg_marquardt import LevenbergMarquardt
from groma.solver.report import Stopwatch
from groma.solver.steps import States, Step, retract


@dataclass(frozen=True)
class Trial:
    """States after a step, with what was found there."""

    step: Step
    states: States
    inputs: list[tuple]
    cost: float
    #: Actual over predicted decrease of the cost.
    gain_ratio: float
    length: float
    #: The decrease of the quadratic model.
    promised: float
    #: Costs, and numbers of degenerate factors at the new states, by factor group.
    costs: list[float]
    hidden: list[int]

    @property
    def num_hidden(self) -> int:
        """Degenerate factors at the new states."""
        return sum(self.hidden)


def try_step(
    equations: NormalEquations,
    strategy: LevenbergMarquardt | Dogleg,
    watch: Stopwatch,
    states: States,
    cost: float,
) -> Trial | None:
    """Propose a step and evaluate the cost after it; None if the linear system could not be solved."""
    proposal = strategy.propose()
    if proposal is None:
        return None
    step, predicted = proposal
    with watch("backsubstitute"):
        moved = retract(equations.layout, states, step)
    with watch("cost"):
        inputs = equations.prepare(moved)
        new_cost = equations.cost(inputs)
    ratio = (cost - new_cost) / predicted if predicted > 0 else 0.0
    found = (float(ratio), step.norm(), predicted, equations.costs, equations.hidden)
    return Trial(step, moved, inputs, new_cost, *found)


def stretched(equations: NormalEquations, states: States, trial: Trial) -> Trial:
    r"""Try a multiple of an accepted step, and return the better trial.

    Robust losses bend the cost down, so reweighted least squares overestimates the curvature. If the curvature along
    the step is the fraction c of the model's, the gain ratio is 2 - c and the minimum lies at 1 / c times the step.
    """
    factor = min(1.0 / max(2.0 - trial.gain_ratio, 1.0 / MAX_STRETCH), MAX_STRETCH)
    moved = retract(equations.layout, states, trial.step.blend(factor, trial.step, 0.0))
    inputs = equations.prepare(moved)
    cost = equations.cost(inputs)
    better = {"states": moved, "inputs": inputs, "cost": cost, "costs": equations.costs, "hidden": equations.hidden}
    return replace(trial, **better) if cost < trial.cost else trial
