# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks that step on their own: which groups take part after a good step, and which rescue a bad one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from problems import scene_problem

from groma.problem.lay_out import lay_out
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.parallel import Workers
from groma.solver.options import SolverOptions
from groma.solver.refinement import landmark_refiner
from groma.solver.trial import JointTrial, evaluated

ONLY_LINES = SolverOptions(landmark_steps=1, landmark_groups=("lines",))


def refined(layout, workers, options, *trial, **states):
    """What the refiner of some options makes of a trial."""
    refiner = landmark_refiner(layout, workers, options)
    assert refiner is not None
    return refiner.refine(*trial, **states)


def spoilt(seed):
    """A problem near its minimum, its states, and a trial that has thrown a third of its points far away."""
    layout = lay_out(scene_problem(seed=seed, num_lines=8, disturb=0.001))
    workers = Workers(1)
    equations = NormalEquations(layout, workers)
    states = to_solver_order(layout)
    start = equations.cost(equations.prepare(states))
    points = states["points"].copy()
    points[::3] += np.random.default_rng(seed).normal(0, 0.5, points[::3].shape)
    moved = {**states, "points": points}
    trial = JointTrial(**evaluated(equations, moved))
    return layout, workers, equations, states, start, trial


@pytest.mark.parametrize("seed", [0, 1])
def test_all_landmarks_take_part_in_the_rescue_of_a_refused_step(seed):
    """The options let lines alone step on their own; here points are to blame, and go back."""
    layout, workers, equations, states, start, trial = spoilt(seed)
    assert trial.cost > 100.0 * start
    rescued = refined(layout, workers, ONLY_LINES, equations, trial, instead=states)
    assert rescued.cost < start
    assert np.abs(rescued.states["points"] - states["points"]).max() < 0.1


def test_after_an_accepted_step_only_the_groups_of_the_options_move():
    layout, workers, equations, _, _, trial = spoilt(2)
    lines = refined(layout, workers, ONLY_LINES, equations, trial)
    assert lines.cost < trial.cost
    np.testing.assert_array_equal(lines.states["points"], trial.states["points"])
    everything = replace(ONLY_LINES, landmark_groups=None)
    assert refined(layout, workers, everything, equations, trial).cost < lines.cost
