# SPDX-License-Identifier: BSD-3-Clause
"""The motion between two views of one camera: all candidates of a plane, and what a third view says of them."""

from dataclasses import replace

import numpy as np
import pytest

from groma.gates import NORMAL
from groma.geometry import quaternion, se3
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.gates import StartGates
from groma.tracking.pose.two_views import IDENTITY, Candidate, adjusted, continued, intersected, likely, motions

CAMERA = TrackCamera(500.0, 500.0, 320.0, 240.0, 640, 480)
GATES = StartGates()
SIGMA = 0.5


def pose(rotation_vector, center):
    turn = quaternion.exp(np.asarray(rotation_vector, float))
    return np.concatenate([turn, -quaternion.rotate(turn, np.asarray(center, float))])


#: A sideways step, and a second one as long with a turn.
SECOND, THIRD = pose([0.0, -0.02, 0.01], [0.2, 0.02, 0.0]), pose([0.03, -0.06, 0.0], [0.4, 0.1, 0.1])


def plane(rng, half, count=200):
    places = np.column_stack([*rng.uniform(-half, half, (2, count)), np.zeros(count)])
    tilt = quaternion.exp(np.array([0.6, 0.3, 0.0]))
    return quaternion.rotate(tilt, places) + np.array([0.0, 0.0, 2.0])


def box(rng, count=200):
    return rng.uniform([-0.8, -0.6, 1.5], [0.8, 0.6, 4.0], (count, 3))


def seen(places, poses, rng, sigma=SIGMA):
    pixels = np.stack([CAMERA.project(se3.transform_points(p[None], places)) for p in poses])
    return pixels + rng.normal(0.0, sigma, pixels.shape)


def begun(pixels):
    """Candidates from the first two views, adjusted to them."""
    found = []
    for motion in motions(CAMERA, pixels[0], pixels[1], GATES):
        start = Candidate(np.stack([IDENTITY, motion]), intersected(CAMERA, pixels[0], pixels[1], motion))
        found.append(adjusted(CAMERA, start, pixels[:2], SIGMA, NORMAL.coordinate))
    return found


def judged(candidates, pixels):
    """The same with a third view."""
    more = [continued(CAMERA, one, pixels[2], SIGMA, GATES) for one in candidates]
    return [adjusted(CAMERA, one, pixels, SIGMA, NORMAL.coordinate) for one in more]


def error(found, true):
    """Angle (radians) between rotations, and between directions of translation."""
    turn = 2 * np.arccos(min(1.0, abs(found[:4] @ true[:4])))
    a, b = found[4:] / np.linalg.norm(found[4:]), true[4:] / np.linalg.norm(true[4:])
    return turn, np.arccos(np.clip(a @ b, -1.0, 1.0))


@pytest.mark.parametrize("seed", range(4))
def test_a_plane_seen_thrice_leaves_the_right_motion(seed):
    rng = np.random.default_rng(seed)
    pixels = seen(plane(rng, 0.5), [IDENTITY, SECOND, THIRD], rng)
    decided = likely(judged(likely(begun(pixels), GATES), pixels), GATES)
    assert len(decided) == 1
    turn, direction = error(decided[0].poses[2], THIRD)
    assert turn < 0.02
    assert direction < 0.08
    assert decided[0].agrees.mean() > 0.97


def test_two_views_of_a_small_plane_leave_several_motions_and_a_third_prefers_the_right_one():
    left = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        pixels = seen(plane(rng, 0.25), [IDENTITY, SECOND, THIRD], rng)
        candidates = begun(pixels)
        left.append(len(likely(candidates, GATES)))
        # So small a plane hardly tells turn from shift; the mirrored motion is off by more than 0.2 rad.
        decided = likely(judged(candidates, pixels), GATES)
        assert error(decided[0].poses[2], THIRD)[0] < 0.16
    assert max(left) > 1


@pytest.mark.parametrize("seed", range(4))
def test_points_in_depth_leave_one_motion_in_spite_of_outliers(seed):
    rng = np.random.default_rng(seed)
    pixels = seen(box(rng), [IDENTITY, SECOND, THIRD], rng)
    wrong = rng.choice(200, 40, replace=False)
    pixels[2, wrong] += rng.uniform(-60.0, 60.0, (40, 2))
    decided = likely(judged(likely(begun(pixels), GATES), pixels), GATES)
    assert len(decided) == 1
    turn, direction = error(decided[0].poses[2], THIRD)
    assert turn < 0.01
    assert direction < 0.05
    assert decided[0].agrees[wrong].mean() < 0.2
    assert np.delete(decided[0].agrees, wrong).mean() > 0.95


def test_the_unit_of_length_is_the_usual_depth():
    rng = np.random.default_rng(1)
    places = box(rng)
    pixels = seen(places, [IDENTITY, SECOND, THIRD], rng, sigma=0.05)
    found = judged(begun(pixels)[:1], pixels)[0]
    unit = np.median(places[:, 2])
    np.testing.assert_allclose(np.median(found.places[:, 2]), 1.0, atol=1e-12)
    np.testing.assert_allclose(found.poses[2, 4:], THIRD[4:] / unit, atol=3e-3)


def test_points_at_infinity_begin_far_away_in_front():
    rng = np.random.default_rng(3)
    places = np.concatenate([box(rng, 5), 1e6 * box(rng, 5)])
    one, two = seen(places, [IDENTITY, SECOND], rng, sigma=0.0)
    two[5:] = one[5:] + CAMERA.project(se3.transform_points(SECOND[None], places))[5:] - one[5:] - [3.0, 0.0]  # behind
    found = intersected(CAMERA, one, two, SECOND)
    np.testing.assert_allclose(found[:5], places[:5], rtol=1e-6)
    assert (found[5:, 2] > 100.0 * np.linalg.norm(SECOND[4:])).all()


@pytest.mark.parametrize("seed", range(3))
def test_points_whose_depth_is_not_known_yet_do_not_count_as_outliers(seed):
    """The noise is a third of the parallax: many points are beyond infinity by it, behind a camera that says so."""
    rng = np.random.default_rng(seed)
    places = box(rng, 400) + np.array([0.0, 0.0, 20.0])
    pixels = seen(places, [IDENTITY, pose([0.01, 0.0, 0.0], [0.1, 0.0, 0.0]), SECOND], rng)
    costs = np.array([one.cost for one in judged(begun(pixels), pixels)])
    # Six coordinates a point, three of which its place takes up; an outlier in all views would count 18.
    assert costs.min() < 1.2 * 0.5 * 3 * len(places)
    assert costs.max() < 1.5 * costs.min()


def test_both_ways_are_proposed():
    """A motion the other way sees its points beyond infinity; with little parallax points do not tell."""
    rng = np.random.default_rng(7)
    pixels = seen(box(rng), [IDENTITY, SECOND], rng)
    found = motions(CAMERA, pixels[0], pixels[1], GATES)
    np.testing.assert_array_equal(found[0], [*found[1][:4], *-found[1][4:]])
    assert min(error(motion, SECOND)[1] for motion in found[:2]) < 0.1


@pytest.mark.parametrize("shared", [False, True])
def test_points_that_err_alike_are_few_witnesses(shared):
    """Errors of a pixel, of each point alone or of all in a fifth of the image."""
    rng = np.random.default_rng(8)
    pixels = seen(box(rng, 400), [IDENTITY, SECOND, THIRD], rng, sigma=0.02 if shared else 0.5)
    if shared:
        fifth = (pixels[0] / (CAMERA.width / 5)).astype(int)
        pixels[2] += rng.normal(0.0, 0.5, (5, 5, 2))[fifth[:, 0], fifth[:, 1]]
    best = min(judged(begun(pixels), pixels), key=lambda one: one.cost)
    # Sums over 48 cells scatter by a fifth; the places and poses take up some of what points err alike.
    assert best.witnesses < 100 if shared else best.witnesses > 300


def test_how_far_behind_depends_on_the_witnesses():
    places = np.ones((400, 3))
    right, wrong = (
        Candidate(np.stack([IDENTITY, motion]), places, cost, np.ones(400, bool), 400.0)
        for motion, cost in ((SECOND, 110.0), (THIRD, 100.0))
    )
    assert len(likely([right, wrong], GATES)) == 1  # 19 nats
    assert len(likely([right, replace(wrong, witnesses=40.0)], GATES)) == 2  # 1.9
