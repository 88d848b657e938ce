# SPDX-License-Identifier: BSD-3-Clause
"""A few landmarks that factors tie to others: they alone stay in the reduced system, and nothing else changes."""

import dataclasses

import numpy as np
import pytest
from problems import EXACT, held, scene_problem

from groma.factors import LinesMeeting, PointOnLine
from groma.factors.contract import Ref
from groma.problem.lay_out import lay_out
from groma.problem.problem import Problem
from groma.problem.residuals import residuals_of
from groma.problem.tied import find_tied
from groma.solver.options import SolverOptions
from groma.solver.solve import solve


def _on_lines(problem, points, lines):
    factor = PointOnLine(
        point=Ref("points", np.asarray(points)), line=Ref("lines", np.asarray(lines)), sqrt_information=20.0
    )
    return Problem(problem.variables, [*problem.factors, factor])


@pytest.fixture
def coupled():
    """Points 0, 5 and 7 lie on lines 3, 8 and 3."""
    return _on_lines(held(scene_problem(num_points=40, num_lines=12)), [0, 5, 7], [3, 8, 3])


def test_lines_that_carry_points_are_found(coupled):
    (tied,) = find_tied(coupled)
    assert tied.group == "lines"
    assert np.flatnonzero(tied.is_tied).tolist() == [3, 8]


def test_the_others_are_eliminated(coupled):
    (tied,) = find_tied(coupled)
    layout = lay_out(tied.divide(coupled))
    assert {e.group: e.count for e in layout.eliminated} == {"points": 40, "lines": 10}
    assert {member.group for kept in layout.kept for member in kept.members} == {"poses", "tied lines"}


def test_a_divided_problem_has_the_same_residuals(coupled):
    (tied,) = find_tied(coupled)
    divided = tied.divide(coupled)
    assert len(divided.factors) == len(coupled.factors) + 1
    for kind in {factor.type_name for factor in coupled.factors}:
        found, expected = (
            np.concatenate([residuals_of(f, p.variables) for f in p.factors if f.type_name == kind])
            for p in (divided, coupled)
        )
        np.testing.assert_array_equal(np.sort(found, axis=0), np.sort(expected, axis=0))


def test_joined_states_are_those_of_before(coupled):
    (tied,) = find_tied(coupled)
    states = {name: group.state for name, group in tied.divide(coupled).variables.items()}
    joined = tied.join(states)
    assert joined.keys() == coupled.variables.keys()
    for name, group in coupled.variables.items():
        np.testing.assert_array_equal(joined[name], group.state)


def test_the_minimum_is_that_of_all_lines_kept(coupled):
    whole = solve(coupled, dataclasses.replace(EXACT, eliminate=("points",)))
    divided = solve(coupled, EXACT)
    assert divided.report.final_cost == pytest.approx(whole.report.final_cost, rel=1e-9)
    assert divided.report.final_costs.keys() == whole.report.final_costs.keys()
    for name in ("poses", "points", "lines"):
        assert divided[name].shape == whole[name].shape
        np.testing.assert_allclose(divided[name], whole[name], atol=1e-5)


def test_what_is_held_stays_held(coupled):
    constant = np.zeros((12, 4), bool)
    constant[3], constant[4, 1] = True, True
    lines = dataclasses.replace(coupled.variables["lines"], constant=constant)
    problem = Problem({**coupled.variables, "lines": lines}, coupled.factors)
    found = solve(problem, EXACT)["lines"]
    np.testing.assert_allclose(found[3], lines.state[3], rtol=0, atol=1e-14)
    assert np.abs(found[8] - lines.state[8]).max() > 1e-4
    whole = solve(problem, dataclasses.replace(EXACT, eliminate=("points",)))["lines"]
    np.testing.assert_allclose(found, whole, atol=1e-5)


def test_of_two_groups_the_one_with_fewer_tied_is_divided():
    problem = _on_lines(scene_problem(num_points=40, num_lines=12), [4, 4, 4], [0, 1, 2])
    (tied,) = find_tied(problem)
    assert tied.group == "points" and np.flatnonzero(tied.is_tied).tolist() == [4]


def test_lines_that_meet_leave_no_choice(coupled):
    meeting = LinesMeeting(first=Ref("lines", np.array([1])), second=Ref("lines", np.array([9])), sqrt_information=5.0)
    (tied,) = find_tied(Problem(coupled.variables, [*coupled.factors, meeting]))
    assert tied.group == "lines" and np.flatnonzero(tied.is_tied).tolist() == [1, 3, 8, 9]


def test_where_all_are_tied_or_none_nothing_is_divided():
    free = scene_problem(num_points=40, num_lines=12)
    assert find_tied(free) == []
    assert find_tied(_on_lines(free, np.arange(12), np.arange(12))) == []


def test_landmarks_that_are_held_tie_nothing():
    problem = _on_lines(scene_problem(num_points=40, num_lines=12, constant_landmarks=True), [0], [3])
    assert find_tied(problem) == []


def test_a_choice_of_the_caller_is_kept(coupled):
    report = solve(coupled, SolverOptions(eliminate=("points",))).report
    assert not any("tied" in note for note in report.notes)
    assert any("'tied lines' stays" in note for note in solve(coupled).report.notes)
