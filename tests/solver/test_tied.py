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
from groma.solver.covariance.clusters import with_kept
from groma.solver.covariance.marginals import Covariances
from groma.solver.observability.diagnosis import diagnose
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


@pytest.fixture(scope="module")
def solved():
    """The coupled problem at its minimum, all of whose lines are seen."""
    problem = held(scene_problem(num_points=40, num_lines=12))
    return solve(_on_lines(problem, [0, 5, 7], [3, 8, 3]), EXACT).problem


@pytest.mark.parametrize("gauge", ["held", "inner"])
def test_covariances_are_those_of_all_lines_kept(solved, gauge):
    datum = None
    if gauge == "inner":
        poses = dataclasses.replace(solved.variables["poses"], constant=False)
        # What is left of a length tells a little of the scale, and what is made of that depends on how it is held.
        weak = [
            dataclasses.replace(f, sqrt_information=1e-3) if f.type_name == "point_on_line" else f
            for f in solved.factors
        ]
        solved, datum = Problem({**solved.variables, "poses": poses}, weak), {"poses": 1.0, "lines": 1e-3}
    divided = Covariances(solved, gauge, datum=datum)
    whole = Covariances(solved, gauge, eliminate=("points",), datum=datum)
    assert divided._layout.num_kept_unknowns < whole._layout.num_kept_unknowns
    for name in ("poses", "points", "lines"):
        expected = whole.of(name)
        np.testing.assert_allclose(divided.of(name), expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_array_equal(divided.of("lines", [8, 2, 3]), divided.of("lines")[[8, 2, 3]])
    asked = [("lines", 8), ("poses", 2), ("lines", 2), ("points", 5), ("lines", 8)]
    expected = whole.joint(asked)
    np.testing.assert_allclose(divided.joint(asked), expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    rng = np.random.default_rng(3)
    moved = {name: rng.normal(size=(len(g), g.manifold.dof)) for name, g in solved.variables.items()}
    expected, found = whole.in_datum(moved), divided.in_datum(moved)
    assert found.keys() == expected.keys()
    for name in expected:
        np.testing.assert_allclose(found[name], expected[name], atol=1e-8)


def test_covariances_with_what_is_kept_are_told_of_the_whole_group(solved):
    kept = with_kept(Covariances(solved), "poses", 3)
    whole = with_kept(Covariances(solved, eliminate=("points",)), "poses", 3)
    assert kept["lines"].shape == whole["lines"].shape
    np.testing.assert_allclose(kept["lines"][[3, 8]], whole["lines"][[3, 8]], atol=1e-10 * np.abs(whole["lines"]).max())
    assert not kept["lines"][[0, 11]].any()


def _with_unseen_lines(problem, unseen, seen_once=False):
    """The problem without what the images see of some lines, or without all but the first that does."""
    factors = list(problem.factors)
    for k, factor in enumerate(factors):
        if factor.type_name == "line_reprojection":
            kept = ~np.isin(factor.line.index, unseen)
            if seen_once:
                kept[np.unique(factor.line.index, return_index=True)[1]] = True
            factors[k] = factor.take(np.flatnonzero(kept))
    return Problem(problem.variables, factors)


def test_what_is_not_determined_is_told_of_the_whole_group(solved):
    problem = _with_unseen_lines(solved, [1, 8])
    divided, whole = Covariances(problem), Covariances(problem, eliminate=("points",))
    assert divided.undetermined("lines").tolist() == whole.undetermined("lines").tolist() == [1, 8]
    assert np.isnan(divided.of("lines")).any(axis=(1, 2)).nonzero()[0].tolist() == [1, 8]


def test_a_diagnosis_is_that_of_all_lines_kept(solved):
    problem = _with_unseen_lines(solved, [1, 8], seen_once=True)
    divided, whole = diagnose(problem), diagnose(problem, eliminate=("points",))
    assert divided.sentences == whole.sentences
    assert [(f.group, f.indices) for f in divided.findings] == [(f.group, f.indices) for f in whole.findings]
    assert divided.weakness.keys() == whole.weakness.keys() == {"points", "lines"}
    determined = np.delete(np.arange(12), [1, 8])
    assert np.array_equal(divided.weakness["lines"] < 0.2, whole.weakness["lines"] < 0.2)
    assert (divided.weakness["lines"][determined] < 0.2).all()


def test_a_tied_landmark_that_nothing_tells_of_is_named_as_one_of_its_group(coupled):
    (silent,) = [f for f in coupled.factors if f.type_name == "point_on_line"]
    silent = dataclasses.replace(silent, sqrt_information=0.0)
    others = [f for f in coupled.factors if f is not silent and f.type_name != "point_on_line"]
    problem = _with_unseen_lines(Problem(coupled.variables, [*others, silent]), [8])
    found = [f for f in diagnose(problem).findings if f.kind == "no_observations"]
    assert [(f.group, f.indices) for f in found] == [("lines", (8,))]
    assert found[0].sentence.startswith("Line 8")
