# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks that step on their own: which groups take part after a good step, and which rescue a bad one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from problems import scene_problem

from groma.factors import LinesMeeting, PointOnLine
from groma.factors.contract import Ref
from groma.problem.lay_out import landmarks_kept, lay_out
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.parallel import Workers
from groma.problem.problem import Problem
from groma.problem.tied import with_tied_apart
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


def with_tied_lines(*factors):
    """A problem in which factors tie some of its lines to other landmarks."""
    problem = scene_problem(seed=3, num_lines=8, disturb=0.001)
    on_line = PointOnLine(point=Ref("points", [0, 1, 2]), line=Ref("lines", [5, 2, 5]), sqrt_information=1e-3)
    return with_tied_apart(Problem(problem.variables, [*problem.factors, on_line, *factors])).problem


def test_lines_that_points_are_tied_to_step_on_their_own_too():
    """They stay in the reduced system; thrown far away, they are brought back like any other landmark."""
    layout, workers = lay_out(with_tied_lines()), Workers(1)
    assert landmarks_kept(layout) == ["tied lines"]
    equations, states = NormalEquations(layout, workers), to_solver_order(layout)
    start = equations.cost(equations.prepare(states))
    lines = layout.problem.variables["tied lines"].manifold
    moved = {**states, "tied lines": lines.retract(states["tied lines"], np.full((2, 4), 0.1))}
    trial = JointTrial(**evaluated(equations, moved))
    assert trial.cost > 10.0 * start
    everything = SolverOptions(landmark_steps=4)
    for instead in (None, states):
        better = refined(layout, workers, everything, equations, trial, instead=instead)
        assert better.cost < 1.01 * start
        assert better.cost == pytest.approx(equations.cost(equations.prepare(better.states)), rel=1e-12)
    assert refined(layout, workers, ONLY_LINES, equations, trial).cost > 0.9 * trial.cost


def test_lines_that_are_tied_to_each_other_do_not_step_on_their_own():
    meeting = LinesMeeting(first=Ref("lines", [2]), second=Ref("lines", [5]))
    assert landmarks_kept(lay_out(with_tied_lines(meeting))) == []
