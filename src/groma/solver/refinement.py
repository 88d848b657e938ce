# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks that take a few steps of their own after every joint step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma.problem.lay_out import landmarks_kept, lay_out_landmarks
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

    Landmarks that share no factor move in the same turn. Those that stay in the reduced system, because factors tie
    them to others, have a turn of their own, after the others.
    """

    def __init__(self, layout: Layout, workers: Workers, turns: list[tuple[str, ...]], steps: int) -> None:
        self._outer, self._turns, self._steps, self._workers = layout, turns, steps, workers
        self._of_all: LandmarkRefiner | None = None
        self._blocks = [IndependentBlocks(lay_out_landmarks(layout, groups), workers, 1e-6) for groups in turns]
        self._moving = {group for groups in turns for group in groups}
        self._eliminated = {
            factor.eliminated
            for factor in layout.factors
            if any(ref.group in self._moving for _, ref in factor.factor.references())
        }

    def refine(self, equations: NormalEquations, trial: JointTrial, instead: States | None = None) -> JointTrial:
        """Return the trial with better landmarks.

        Landmarks start from the trial, or from the states ``instead`` where those cost less with the new cameras. Those
        are for a step that would be refused: whatever landmarks are to blame, all then take part.
        """
        if instead is not None and (every := turns_of(self._outer)) != self._turns:
            self._of_all = self._of_all or LandmarkRefiner(self._outer, self._workers, every, self._steps)
            return self._of_all.refine(equations, trial, instead)
        inner = to_original_order(self._outer, trial.states)
        before = None if instead is None else to_original_order(self._outer, instead)
        for blocks in self._blocks:
            inner = self._moved(blocks, inner, before)
        order = {e.group: e.order for e in self._outer.eliminated}
        own = {name: inner[name].take(order[name], axis=0) if name in order else inner[name] for name in self._moving}
        inputs = equations.prepare(refined := {**trial.states, **own})
        cost = equations.cost_of(inputs, self._eliminated, trial.costs, trial.hidden)
        if cost >= trial.cost:
            return trial
        return replace(trial, states=refined, inputs=inputs, cost=cost, **counted_in(equations))

    def _moved(self, blocks: IndependentBlocks, states: States, before: States | None) -> States:
        """Return states in which the landmarks of one turn have moved, from those ``before`` where they cost less."""
        blocks.reset()
        costs = blocks.costs(states)
        if before is not None:
            groups = [e.group for e in blocks.layout.eliminated]
            unmoved = {**states, **{group: before[group] for group in groups}}
            for e, (group, kept_costs) in enumerate(zip(groups, blocks.costs(unmoved), strict=True)):
                better = kept_costs < costs[e]
                states = {**states, group: np.where(better[:, None], before[group], states[group])}
                costs[e] = np.where(better, kept_costs, costs[e])
        for _ in range(self._steps):
            states, costs, _ = blocks.step(states, costs)
        return states


def turns_of(layout: Layout, groups: tuple[str, ...] | None = None) -> list[tuple[str, ...]]:
    """Return the groups of landmarks that move at once, turn by turn: of all, or some of those that are eliminated."""
    eliminated = tuple(e.group for e in layout.eliminated if groups is None or e.group in groups)
    kept = landmarks_kept(layout) if groups is None else []
    return [turn for turn in (eliminated, *((group,) for group in kept)) if turn]


def landmark_refiner(layout: Layout, workers: Workers, options: SolverOptions) -> LandmarkRefiner | None:
    """Return the refinement of the landmarks of a layout; None if no separate steps are requested."""
    if options.landmark_steps == 0 or not (turns := turns_of(layout, options.landmark_groups)):
        return None
    return LandmarkRefiner(layout, workers, turns, options.landmark_steps)
