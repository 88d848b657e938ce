# SPDX-License-Identifier: BSD-3-Clause
"""States of all variables of a joint solve, before or after a step, with what was found there."""

from __future__ import annotations

from dataclasses import dataclass

from groma.problem.linearization import NormalEquations
from groma.solver.damped_problem import Trial
from groma.solver.steps import States, Step


@dataclass(frozen=True, kw_only=True)
class JointTrial(Trial):
    """A trial of a joint solve."""

    states: States
    #: What each factor group reads of the states.
    inputs: list[tuple]
    #: Costs, and numbers of degenerate factors, by factor group.
    costs: list[float]
    hidden: list[int]
    #: How the states were reached; None at the start.
    step: Step | None = None


def evaluated(equations: NormalEquations, states: States) -> dict:
    """Evaluate the cost at some states; return the fields of :class:`JointTrial` about it."""
    inputs = equations.prepare(states)
    cost = equations.cost(inputs)
    return {"states": states, "inputs": inputs, "cost": cost, **counted_in(equations)}


def counted_in(equations: NormalEquations) -> dict:
    """Return what the last evaluation of the cost left behind, as fields of :class:`JointTrial`."""
    return {"costs": equations.costs, "hidden": equations.hidden, "num_hidden": equations.num_hidden}
