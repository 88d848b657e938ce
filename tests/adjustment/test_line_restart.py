# SPDX-License-Identifier: BSD-3-Clause
"""A line that starts in a wrong minimum ends in the right one, and does not hold up the others."""

from dataclasses import replace

import numpy as np
import pytest

import groma
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.rescue.restart import _line_costs, renew_lines, with_seen_ends
from groma.adjustment.terms.lines import LINE_FACTORS
from groma.scene import Relations, synthetic

pytestmark = pytest.mark.kernels

BAD = 4


@pytest.fixture(scope="module")
def scenes():
    """A scene at its truth, and the same with one line far off."""
    truth = synthetic.holistic(12, noise_px=0.5, seed=1).truth.replace(relations=Relations())
    plucker = truth.lines.plucker.copy()
    direction = np.roll(plucker[BAD, 3:], 1) * [1.0, -1.0, 1.0]
    direction -= (direction @ plucker[BAD, 3:]) * plucker[BAD, 3:] / (plucker[BAD, 3:] @ plucker[BAD, 3:])
    place = truth.lines.segments[BAD].mean(axis=0) * -1.5 + 0.7
    plucker[BAD] = np.concatenate([np.cross(place, direction), direction])
    return truth, truth.with_lines(plucker)


def _problem(scene):
    return assemble(scene, AssemblyOptions(planes=False)).problem


def _sine(lines, others):
    a, b = (x[3:] / np.linalg.norm(x[3:]) for x in (lines, others))
    return np.linalg.norm(np.cross(a, b))


def test_wrong_line_is_triangulated_anew_and_no_other(scenes):
    truth, wrong = scenes
    problem = _problem(wrong)
    better, renewed = renew_lines(wrong, problem)
    assert renewed.tolist() == [BAD]
    assert _sine(better.variables["lines"].ambient()[BAD], truth.lines.plucker[BAD]) < 0.02
    moved = with_seen_ends(wrong.with_lines(better.variables["lines"].ambient()), renewed)
    apart = np.linalg.norm(moved.lines.segments[BAD][:, None] - truth.lines.segments[BAD], axis=2)
    assert min(apart.diagonal().max(), apart[::-1].diagonal().max()) < 0.2


def test_no_line_is_triangulated_anew_at_the_truth(scenes):
    truth, _ = scenes
    assert len(renew_lines(truth, _problem(truth))[1]) == 0


def test_a_line_that_fits_badly_where_it_is_keeps_its_ends(scenes):
    """Its second start ends at the same place, by another last step."""
    truth, _ = scenes
    table = truth.line_observations
    segment = table.segment.copy()
    rows = np.flatnonzero(table.line_idx == BAD)
    segment[rows] += np.random.default_rng(0).normal(0.0, 4.0, (len(rows), 4))
    noisy = truth.replace(line_observations=table.replace(segment=segment))
    settled = noisy.with_lines(renew_lines(noisy, _problem(noisy))[0].variables["lines"].ambient())
    better, renewed = renew_lines(settled, _problem(settled))
    assert len(renewed) == 0
    assert _sine(better.variables["lines"].ambient()[BAD], settled.lines.plucker[BAD]) < 1e-3


def test_second_start_counts_under_relations_too(scenes):
    """Points on lines are factors of both starts, at the same places."""
    truth, wrong = scenes
    full = synthetic.holistic(12, noise_px=0.5, seed=1).truth
    problem = _problem(full.with_lines(wrong.lines.plucker))
    assert {factor.type_name for factor in problem.factors} >= {"point_on_line", "line_reprojection"}
    better = renew_lines(full, problem)[0]
    assert _sine(better.variables["lines"].ambient()[BAD], truth.lines.plucker[BAD]) < 0.02


@pytest.mark.compiled
@pytest.mark.parametrize("loss", ["none", "auto"])
def test_adjust_recovers(scenes, loss):
    truth, wrong = scenes
    result = groma.adjust(wrong, groma.AdjustOptions(loss=loss, planes=False))
    assert _sine(result.scene.lines.plucker[BAD], truth.lines.plucker[BAD]) < 0.02
    assert result.report.solve.iterations <= 15


def test_settled_lines_are_at_their_minima_and_nothing_else_moves(scenes):
    truth, _ = scenes
    problem = _problem(truth)
    settled = renew_lines(truth, problem)[0]
    for name, group in problem.variables.items():
        if name != "lines":
            np.testing.assert_array_equal(settled.variables[name].state, group.state)
    factors = [factor for factor in problem.factors if factor.type_name in LINE_FACTORS]
    costs = [_line_costs(p, factors)[0] for p in (problem, settled, renew_lines(truth, settled)[0])]
    assert (costs[1] < costs[0]).all()
    np.testing.assert_allclose(costs[2], costs[1], rtol=1e-3)


def test_held_lines_stay(scenes):
    _, wrong = scenes
    problem = _problem(wrong)
    held = {**problem.variables, "lines": replace(problem.variables["lines"], constant=True)}
    same, renewed = renew_lines(wrong, type(problem)(held, problem.factors))
    assert same.variables["lines"] is held["lines"]
    assert len(renewed) == 0


@pytest.mark.compiled
def test_few_steps_where_a_line_starts_in_a_wrong_minimum():
    """Twelve steps were needed before the first stage ended at a refused step."""
    start = synthetic.holistic(100, noise_px=1.0, seed=1, views="near").start
    result = groma.adjust(start.replace(relations=Relations()), groma.AdjustOptions(loss="none", planes=False))
    assert result.report.solve.iterations <= 8
    assert result.report.solve.converged
