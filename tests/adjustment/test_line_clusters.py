# SPDX-License-Identifier: BSD-3-Clause
"""Lines and the points on them leave a wrong minimum together, and nothing else moves."""

from dataclasses import replace

import numpy as np
import pytest

import groma
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.rescue.clusters import renew_clusters
from groma.problem.residuals import squared_norms
from groma.scene import Distances, Relations, synthetic
from groma.scene.survey import Kind

pytestmark = pytest.mark.kernels

BAD = 4


@pytest.fixture(scope="module")
def scenes():
    """A scene with points on lines at its truth, and the same with a line and its points turned far away."""
    truth = synthetic.holistic(12, noise_px=0.5, seed=1).truth
    truth = truth.replace(relations=Relations(point_on_line=truth.relations.point_on_line))
    first, last = truth.lines.segments[BAD]
    along = (last - first) / np.linalg.norm(last - first)
    across = np.cross(along, [0.0, 0.0, 1.0])
    direction = along + 1.5 * across / np.linalg.norm(across)
    direction /= np.linalg.norm(direction)
    middle, plucker, xyz = (first + last) / 2.0, truth.lines.plucker.copy(), truth.points.xyz.copy()
    plucker[BAD] = np.concatenate([np.cross(middle, direction), direction])
    points = truth.relations.point_on_line[truth.relations.point_on_line[:, 1] == BAD, 0]
    xyz[points] = middle + ((xyz[points] - middle) @ direction)[:, None] * direction
    return truth, truth.with_lines(plucker).with_points(xyz), points


def _problem(scene):
    return assemble(scene, AssemblyOptions(planes=False)).problem


def _cost(problem):
    return sum(squared_norms(factor, problem.variables).sum() for factor in problem.factors)


def _sine(line, other):
    a, b = (x[3:] / np.linalg.norm(x[3:]) for x in (line, other))
    return np.linalg.norm(np.cross(a, b))


def test_a_line_and_its_points_come_back_and_nothing_else_moves(scenes):
    truth, wrong, points = scenes
    problem = _problem(wrong)
    better, moved = renew_clusters(wrong, problem)
    assert moved.tolist() == [BAD]
    assert _sine(better.variables["lines"].ambient()[BAD], truth.lines.plucker[BAD]) < 0.03
    apart = better.variables["points"].ambient()[points, :3] - truth.points.xyz[points]
    assert np.linalg.norm(apart, axis=1).max() < 0.1
    for name, group in problem.variables.items():
        rest = np.setdiff1d(np.arange(len(group)), {"lines": [BAD], "points": points}.get(name, []))
        np.testing.assert_array_equal(better.variables[name].state[rest], group.state[rest])
    assert _cost(better) < 1.5 * _cost(_problem(truth))


def test_nothing_moves_at_the_truth_or_where_nothing_is_tied_or_free(scenes):
    truth, wrong, _ = scenes
    problem = _problem(truth)
    assert renew_clusters(truth, problem)[0] is problem
    loose = _problem(wrong.replace(relations=Relations()))
    assert renew_clusters(wrong, loose)[0] is loose
    problem = _problem(wrong)
    held = {**problem.variables, "points": replace(problem.variables["points"], constant=True)}
    problem = type(problem)(held, problem.factors)
    assert renew_clusters(wrong, problem)[0] is problem


def test_a_point_on_two_lines_makes_them_one_cluster(scenes):
    truth, wrong, points = scenes
    shared = np.array([[points[0], BAD + 1]])
    relations = Relations(point_on_line=np.concatenate([truth.relations.point_on_line, shared]))
    problem = _problem(wrong.replace(relations=relations))
    better = renew_clusters(wrong, problem)[0]
    unmoved = (better.variables["lines"].state == problem.variables["lines"].state).all(axis=1)
    assert np.flatnonzero(~unmoved).tolist() == [BAD, BAD + 1]
    assert _cost(better) < _cost(problem)


def test_what_ties_a_cluster_to_lines_outside_of_it_stays_out(scenes):
    """A width between two lines of which one is turned: the other is not in its cluster, and has to stay."""
    truth, wrong, _ = scenes
    others = [BAD + 1, BAD + 2]
    places = truth.lines.segments[others].mean(axis=1)
    lengths = np.linalg.norm(places - truth.lines.segments[BAD].mean(axis=0), axis=1)
    kinds = np.full(2, Kind.LINE)
    widths = Distances(kinds, np.array(others), kinds, np.full(2, BAD), places, lengths, np.full(2, 0.01))
    problem = _problem(wrong.replace(distances=widths))
    assert any(factor.type_name == "distance" for factor in problem.factors)
    better, moved = renew_clusters(wrong, problem)
    assert moved.tolist() == [BAD]
    unmoved = (better.variables["lines"].state == problem.variables["lines"].state).all(axis=1)
    assert np.flatnonzero(~unmoved).tolist() == [BAD]


@pytest.mark.slow
def test_few_steps_and_a_lower_cost_where_a_cluster_was_in_a_wrong_minimum():
    """Twelve steps were needed, to a cost of 9886, before lines found their place together with their points."""
    start = synthetic.holistic(200, noise_px=1.0, seed=2, views="near").start
    result = groma.adjust(start, groma.AdjustOptions(loss="none"))
    assert result.report.solve.converged
    assert result.report.solve.iterations <= 7
    assert result.report.solve.final_cost < 9820.0
