# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks that take a few steps of their own after every joint step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma.problem.lay_out import lay_out_landmarks
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations, to_original_order
from groma.problem.parallel import Workers
from groma.solver.independent import IndependentBlocks
from groma.solver.options import SolverOptions
from groma.solver.steps import States
from groma.solver.trial import JointTrial, counted_in


class LandmarkRefiner:
    """A few steps of each landmark on its own, cameras held; a step that does not lower its cost is undone.

    It follows every accepted step. It also rescues steps that would be refused: a few landmarks with a strongly bent
    cost, such as lines over a short baseline, would otherwise hold back all cameras.
    """

    def __init__(self, layout: Layout, workers: Workers, groups: list[str], steps: int) -> None:
        self._outer, self._groups, self._steps, self._workers = layout, groups, steps, workers
        self._of_all: LandmarkRefiner | None = None
        self._blocks = IndependentBlocks(lay_out_landmarks(layout, tuple(groups)), workers, 1e-6)

    def refine(self, equations: NormalEquations, trial: JointTrial, instead: States | None = None) -> JointTrial:
        """Return the trial with better landmarks.

        Landmarks start from the trial, or from the states ``instead`` where those cost less with the new cameras. Those
        are for a step that would be refused: whatever landmarks are to blame, all that are eliminated then take part.
        """
        every = [e.group for e in self._outer.eliminated]
        if instead is not None and len(self._groups) < len(every):
            self._of_all = self._of_all or LandmarkRefiner(self._outer, self._workers, every, self._steps)
            return self._of_all.refine(equations, trial, instead)
        inner = to_original_order(self._outer, trial.states)
        self._blocks.reset()
        costs = self._blocks.costs(inner)
        if instead is not None:
            before = to_original_order(self._outer, instead)
            groups = [e.group for e in self._blocks.layout.eliminated]
            unmoved = {**inner, **{group: before[group] for group in groups}}
            for e, (group, kept_costs) in enumerate(zip(groups, self._blocks.costs(unmoved), strict=True)):
                better = kept_costs < costs[e]
                inner = {**inner, group: np.where(better[:, None], before[group], inner[group])}
                costs[e] = np.where(better, kept_costs, costs[e])
        for _ in range(self._steps):
            inner, costs, _ = self._blocks.step(inner, costs)
        refined, moved = dict(trial.states), set()
        for number, group in enumerate(self._outer.eliminated):
            if group.group in self._groups:
                moved.add(number)
                refined[group.group] = np.ascontiguousarray(inner[group.group][group.order])
        inputs = equations.prepare(refined)
        cost = equations.cost_of(inputs, moved, trial.costs, trial.hidden)
        if cost >= trial.cost:
            return trial
        return replace(trial, states=refined, inputs=inputs, cost=cost, **counted_in(equations))


def landmark_refiner(layout: Layout, workers: Workers, options: SolverOptions) -> LandmarkRefiner | None:
    """Return the refinement of the landmarks of a layout; None if no separate steps are requested."""
    groups = [
        e.group for e in layout.eliminated if options.landmark_groups is None or e.group in options.landmark_groups
    ]
    if options.landmark_steps == 0 or not groups:
        return None
    return LandmarkRefiner(layout, workers, groups, options.landmark_steps)
