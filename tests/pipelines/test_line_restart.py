# SPDX-License-Identifier: BSD-3-Clause
"""A line that starts in a wrong minimum ends in the right one, and does not hold up the others."""

from dataclasses import replace

import numpy as np
import pytest

import groma
from groma.pipelines._assemble import LINE_FACTORS, AssemblyOptions, assemble
from groma.pipelines._line_restart import restart_lines
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


def test_wrong_line_is_replaced_and_no_other(scenes):
    truth, wrong = scenes
    problem = _problem(wrong)
    better = restart_lines(wrong, problem, LINE_FACTORS)
    assert better is not None
    changed = (better.variables["lines"].state != problem.variables["lines"].state).any(axis=1)
    assert np.flatnonzero(changed).tolist() == [BAD]
    assert _sine(better.variables["lines"].ambient()[BAD], truth.lines.plucker[BAD]) < 0.02


def test_nothing_to_do_at_the_truth(scenes):
    truth, _ = scenes
    assert restart_lines(truth, _problem(truth), LINE_FACTORS) is None


def test_held_lines_stay(scenes):
    _, wrong = scenes
    problem = _problem(wrong)
    held = {**problem.variables, "lines": replace(problem.variables["lines"], constant=True)}
    assert restart_lines(wrong, type(problem)(held, problem.factors), LINE_FACTORS) is None


@pytest.mark.parametrize("loss", ["none", "auto"])
def test_adjust_recovers(scenes, loss):
    truth, wrong = scenes
    result = groma.adjust(wrong, groma.AdjustOptions(loss=loss, planes=False))
    assert _sine(result.scene.lines.plucker[BAD], truth.lines.plucker[BAD]) < 0.02
    assert result.report.solve.iterations <= 15
