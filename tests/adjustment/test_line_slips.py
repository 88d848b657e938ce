# SPDX-License-Identifier: BSD-3-Clause
"""A line does not pass through a camera, or behind it, to please one wrong observation; right lines stay untouched."""

import numpy as np
import pytest

import groma
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.rescue.restart import with_seen_ends
from groma.adjustment.rescue.slips import without_slips
from groma.factors.losses import Cauchy
from groma.scene import Relations, synthetic


def _angle_deg(lines, others):
    a, b = (x[..., 3:] / np.linalg.norm(x[..., 3:], axis=-1, keepdims=True) for x in (lines, others))
    return np.degrees(np.arcsin(np.clip(np.linalg.norm(np.cross(a, b), axis=-1), 0.0, 1.0)))


def _end_distance(scene, truth, line):
    """Largest distance of an end point from its true one, in the better order."""
    apart = np.linalg.norm(scene.lines.segments[line][:, None] - truth.lines.segments[line], axis=2)
    return min(apart.diagonal().max(), apart[::-1].diagonal().max())


@pytest.fixture(scope="module")
def through_a_camera():
    """A scene at its truth, and the same with one line through the centre of one of its cameras."""
    truth = synthetic.holistic(12, noise_px=0.5, seed=1).truth.replace(relations=Relations())
    table = truth.line_observations
    line = int(np.argmax(np.bincount(table.line_idx) >= 4))
    camera = truth.cam_centers_in_world[table.image_idx[table.line_idx == line][0]]
    end = truth.lines.segments[line, 0]
    plucker = truth.lines.plucker.copy()
    plucker[line] = np.concatenate([np.cross(end, camera - end), camera - end])
    return truth, truth.with_lines(plucker), line


def test_line_through_a_camera_goes_back_and_no_other_moves(through_a_camera):
    truth, slipped, line = through_a_camera
    assert _angle_deg(slipped.lines.plucker[line], truth.lines.plucker[line]) > 20
    problem = assemble(slipped, AssemblyOptions(planes=False, loss=Cauchy(1.0))).problem
    better, turned = without_slips(problem)
    assert turned.tolist() == [line]
    found = better.variables["lines"].ambient()
    assert _angle_deg(found[line], truth.lines.plucker[line]) < 3
    np.testing.assert_array_equal(np.delete(found, line, 0), np.delete(problem.variables["lines"].ambient(), line, 0))
    ended = with_seen_ends(slipped.with_lines(found), turned)
    assert _end_distance(ended, truth, line) < 0.5
    np.testing.assert_array_equal(
        np.delete(ended.lines.segments, line, 0), np.delete(slipped.with_lines(found).lines.segments, line, 0)
    )


def test_nothing_to_do_at_the_truth(through_a_camera):
    truth, _, _ = through_a_camera
    problem = assemble(truth, AssemblyOptions(planes=False, loss=Cauchy(1.0))).problem
    same, turned = without_slips(problem)
    assert same is problem
    assert len(turned) == 0


@pytest.mark.parametrize(("seed", "line"), [(1, 3), (4, 9)])
def test_adjustment_lets_no_line_slip(seed, line):
    """One observation of each line is wrong; these two lines used to end 18 and 15 degrees off."""
    made = synthetic.holistic(40, noise_px=0.5, seed=seed)
    table, rng = made.start.line_observations, np.random.default_rng(seed)
    wrong = np.unique(table.line_idx, return_index=True)[1]
    middle = rng.uniform(0, 1, (len(wrong), 2)) * [made.start.cameras.width[0], made.start.cameras.height[0]]
    angle = rng.uniform(0, np.pi, len(wrong))
    half = np.stack([np.cos(angle), np.sin(angle)], axis=1) * rng.uniform(10, 60, len(wrong))[:, None]
    segment = table.segment.copy()
    segment[wrong] = np.hstack([middle - half, middle + half])
    start = made.start.replace(relations=Relations(), line_observations=table.replace(segment=segment))
    found = groma.adjust(start, groma.AdjustOptions(planes=False, threads=1)).scene
    assert _angle_deg(found.lines.plucker[line], made.truth.lines.plucker[line]) < 3
    assert _end_distance(found, made.truth, line) < 0.5
