# SPDX-License-Identifier: BSD-3-Clause
"""All variables in one step: landmarks are eliminated, the reduced system is solved, landmarks follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma._stopwatch import Stopwatch
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.parallel import Workers
from groma.solver.levenberg_marquardt import damping_from, predicted_decrease
from groma.solver.linear.choice import linear_solver
from groma.solver.linear.reduction import Reduction
from groma.solver.linear.schur import ReducedSystem
from groma.solver.options import SolverOptions, first_damping
from groma.solver.refinement import landmark_refiner
from groma.solver.report import SolveReport, note_costs
from groma.solver.steps import States, Step, largest_slope, relative_length, retract, sizes_of
from groma.solver.termination import Termination
from groma.solver.trial import JointTrial, evaluated

#: Where the blocks between landmarks and kept blocks would take more bytes than this, single precision keeps them
#: (cost: memory).
COMPACT_FROM = 2**28


class JointProblem:
    """A layout with kept blocks; a :class:`groma.solver.damped_problem.DampedProblem`."""

    def __init__(self, layout: Layout, workers: Workers, options: SolverOptions, watch: Stopwatch) -> None:
        with watch("setup"):
            self.equations = NormalEquations(layout, workers, compact=_bytes_of_blocks(layout) > COMPACT_FROM)
            self._system = ReducedSystem(self.equations)
            self.linear = linear_solver(layout, options.linear_solver)
            self._refiner = landmark_refiner(layout, workers, options)
            states = to_solver_order(layout)
        self._layout, self._watch, self.linear_name = layout, watch, self.linear.name
        self._reduction = Reduction(self.equations, self._system, self.linear, watch)
        self._damping = damping_from(first_damping(layout.problem.variables, options), layout.problem.variables)
        inputs = self.equations.prepare(states)
        self._at_start: list[float] = []
        self._sizes = sizes_of(layout, states)
        self._here = JointTrial(cost=np.nan, states=states, inputs=inputs, costs=[], hidden=[])

    @property
    def states(self) -> States:
        """The present states, in the order of the layout."""
        return self._here.states

    @property
    def num_factors(self) -> int:  # noqa: D102
        return sum(len(layout.factor) for layout in self._layout.factors)

    @property
    def damping(self) -> float:  # noqa: D102
        return self._damping.value

    @property
    def linear_iterations(self) -> int:  # noqa: D102
        return self.linear.num_iterations

    def start(self) -> JointTrial:  # noqa: D102
        here, equations = self._here, self.equations
        cost = self._reduction.linearize(here.states, here.inputs, self.damping)
        hidden, self._at_start = equations.num_degenerate, equations.costs
        self._here = replace(here, cost=cost, costs=equations.costs, hidden=hidden, num_hidden=sum(hidden))
        return self._here

    def linearize(self) -> None:  # noqa: D102
        self._reduction.form(self._here.states, self._here.inputs, self.damping)

    def largest_gradient(self) -> float:  # noqa: D102
        equations, kept = self.equations, range(len(self._layout.kept))
        slopes = [largest_slope(equations.g_kept[c], self._system.diagonal(c).reshape(-1)) for c in kept]
        return max([*slopes, self._system.largest_landmark_slope()])

    def is_curved(self) -> bool:  # noqa: D102
        kept = (self._system.diagonal(c) for c in range(len(self._layout.kept)))
        return any(bool(part.any()) for part in (*kept, *self.equations.V))

    def try_step(self) -> JointTrial:  # noqa: D102
        kept = self._reduction.solve()
        if kept is None:
            return self._here.without_step()
        with self._watch("backsubstitute"):
            system, gradients = self._system, self.equations.g_kept
            step = Step(kept, system.landmark_steps(kept))
            blocks = [(system.diagonal(c).reshape(-1), gradients[c], delta) for c, delta in enumerate(kept)]
            sums = (system.landmark_squares, system.landmark_slope)
            promised, withheld = predicted_decrease(blocks, self.linear.residual, sums, self.damping)
            moved = retract(self._layout, self._here.states, step)
        with self._watch("cost"):
            found = evaluated(self.equations, moved)
        ratio = (self._here.cost - found["cost"]) / promised if promised > 0 else 0.0
        found |= {"gain_ratio": float(ratio), "promised": promised, "length": step.norm(), "withheld": withheld}
        found["relative_length"] = relative_length(self._layout, self._sizes, step)
        return JointTrial(**found, step=step)

    def stretch(self, trial: JointTrial, factor: float) -> JointTrial:  # noqa: D102
        assert trial.step is not None
        with self._watch("cost"):
            moved = retract(self._layout, self._here.states, trial.step.scaled(factor))
            return replace(trial, **evaluated(self.equations, moved))

    def refine(self, trial: JointTrial) -> JointTrial:
        """Let landmarks take steps of their own."""
        if self._refiner is None:
            return trial
        with self._watch("backsubstitute"):
            return self._refiner.refine(self.equations, trial)

    def rescue(self, trial: JointTrial) -> JointTrial:
        """Let landmarks take steps of their own, from where they were if that is better."""
        if self._refiner is None or not trial.has_step:
            return trial
        with self._watch("backsubstitute"):
            better = self._refiner.refine(self.equations, trial, instead=self._here.states)
        ratio = (self._here.cost - better.cost) / trial.promised if trial.promised else 0.0
        return replace(better, gain_ratio=min(ratio, 1.0))

    def accept(self, trial: JointTrial) -> None:  # noqa: D102
        self._here = trial
        self._damping.accept(trial.gain_ratio)

    def refuse(self, trial: JointTrial) -> Termination | None:  # noqa: D102
        return self._damping.refuse(trial)

    def note_end(self, report: SolveReport) -> None:
        """Write the costs of the present states into the report, and what could not be evaluated or determined."""
        self.equations.costs = self._here.costs
        note_costs(report, self._layout, self.equations, self._at_start, self._system.num_singular_landmarks)


def _bytes_of_blocks(layout: Layout) -> int:
    """Memory of the blocks W in double precision."""
    return sum(
        8 * len(incidences.block) * e.dof * layout.kept[c].width
        for e in layout.eliminated
        for c, incidences in e.incidences.items()
    )
