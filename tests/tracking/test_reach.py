# SPDX-License-Identifier: BSD-3-Clause
"""Where the camera can be after a gap: how often the truth is denied, what is denied, and when nothing is."""

import numpy as np
import pytest

from groma.geometry import se3
from groma.tracking.gates import MotionGates
from groma.tracking.pose.prediction import MotionModel
from groma.tracking.pose.reach import MotionHistory

GATES = MotionGates()
#: The angle of view (radians) and the depth of the scene that a camera sees.
VIEW, DEPTH = 1.0, 2.0
#: Metres and radians in a step: around an object that lies two metres ahead.
STEP = np.array([0.2, 0.0, 0.0, 0.0, -0.1, 0.0])


def poses_of(rng, count, drift=0.0, jitter=0.01, step=STEP):
    """Return the poses (count, 7) of a motion whose velocity drifts; each is off by a jitter of its own."""
    velocity, pose, out = step.copy(), se3.identity(), []
    for _ in range(count):
        velocity = velocity + rng.normal(0.0, drift, 6)
        pose = se3.compose(se3.exp(velocity[None]), pose[None])[0]
        out.append(se3.compose(se3.exp(rng.normal(0.0, jitter, (1, 6))), pose[None])[0])
    return np.array(out)


def history_of(poses, seconds=1.0):
    history = MotionHistory(GATES)
    for twist in se3.log(se3.compose(poses[1:], se3.inverse(poses[:-1]))):
        history.add(twist, seconds)
    return history


@pytest.mark.parametrize("drift", [0.0, 0.003, 0.01])
@pytest.mark.parametrize("steps", [3, 8, 20])
def test_the_truth_is_seldom_denied(drift, steps):
    rng = np.random.default_rng(steps)
    denied = 0
    for _ in range(60):
        poses = poses_of(rng, 15 + steps, drift)
        reach = history_of(poses[:15]).reach(poses[14], float(steps))
        denied += reach.denies(poses[-1], VIEW, DEPTH)
    # Two tests at 1 % deny 1.2 of 60 motions; more than 6 with a probability of 0.0003.
    assert denied <= 6


def test_the_opposite_side_is_denied_and_the_expected_place_is_not():
    poses = poses_of(np.random.default_rng(0), 35)
    reach = history_of(poses[:15]).reach(poses[14], 20.0)
    assert reach.tells(VIEW, DEPTH)
    assert not reach.denies(poses[-1], VIEW, DEPTH)
    turned = se3.compose(se3.exp(np.array([[0.0, 0.0, 0.0, 0.0, np.pi, 0.0]])), poses[-1:])[0]
    away = se3.compose(se3.exp(np.array([[0.0, 0.0, 5.0, 0.0, 0.0, 0.0]])), poses[-1:])[0]
    assert reach.denies(turned, VIEW, DEPTH)
    assert reach.denies(away, VIEW, DEPTH)


def test_a_motion_that_changes_tells_nothing_after_a_long_time():
    poses = poses_of(np.random.default_rng(1), 15, drift=0.03)
    history = history_of(poses)
    turned = se3.compose(se3.exp(np.array([[0.0, 0.0, 0.0, 0.0, np.pi, 0.0]])), poses[-1:])[0]
    assert not history.reach(poses[-1], 100.0).tells(VIEW, DEPTH)
    assert not history.reach(poses[-1], 100.0).denies(turned, VIEW, DEPTH)


def test_places_near_by_are_never_denied():
    # A camera at rest, exactly: the least noise is that of the gates.
    poses = np.tile(se3.identity(), (15, 1))
    reach = history_of(poses).reach(poses[-1], 5.0)
    near = se3.exp(np.array([[0.9, 0.0, 0.0, 0.0, 0.45, 0.0]]))[0]
    assert np.isfinite(reach.variance).all()
    assert not reach.denies(near, VIEW, DEPTH)
    assert reach.denies(se3.exp(np.array([[0.0, 0.0, 0.0, 0.0, 2.0, 0.0]]))[0], VIEW, DEPTH)


def test_the_clock_may_count_frames():
    poses = poses_of(np.random.default_rng(2), 15)
    seconds = history_of(poses, 0.04).reach(poses[-1], 0.8)
    frames = history_of(poses, 1.0).reach(poses[-1], 20.0)
    np.testing.assert_allclose(seconds.variance, frames.variance, rtol=1e-9)
    np.testing.assert_allclose(seconds.pose, frames.pose, atol=1e-9)


def test_too_few_motions_tell_nothing():
    history = MotionHistory(GATES)
    assert history.reach(se3.identity(), 1.0) is None
    history.add(STEP, 1.0)
    assert history.reach(se3.identity(), 1.0) is None
    history.add(STEP, 1.0)
    assert history.reach(se3.identity(), 1.0) is not None
    history.interrupt()  # found again after a loss: its velocity is not known
    assert history.reach(se3.identity(), 1.0) is None


def test_only_gaps_are_asked_about():
    motion, before = MotionModel(GATES), None
    poses = poses_of(np.random.default_rng(3), 8)
    for time, pose in enumerate(poses):
        if before is not None:
            motion.predict(before, float(time))
        motion.update(before, pose, float(time))
        before = pose
    motion.predict(before, 8.0)
    assert not motion.after_gap
    assert motion.reach is None
    motion.predict(before, 20.0)
    assert motion.after_gap
    assert motion.reach is not None
