# SPDX-License-Identifier: BSD-3-Clause
"""Poses at which planes of a frame lie on planes of the map."""

import numpy as np
import pytest

from groma.geometry import se3
from groma.tracking.frame.camera import TrackCamera, into, planes_into
from groma.tracking.frame.planes import FramePlanes
from groma.tracking.gates import DEFAULT
from groma.tracking.pose.plane_poses import poses_on_planes

CAMERA = TrackCamera(525.0, 525.0, 320.0, 240.0, 640, 480)
#: A floor and two walls.
WORLD = np.array([[0.0, 1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, -1.0, 5.0]])
CENTRE = np.array([0.0, 0.0, 4.0])
POSE = se3.exp(np.array([[0.1, -0.2, 0.15, 0.1, 0.3, -0.1]]))[0]


def _seen(planes):
    none = np.zeros(0)
    return FramePlanes(planes, np.zeros((len(planes), 3, 3)), none, np.zeros((0, 3)), none.astype(np.int64))


def _poses(planes, world=WORLD, predicted=POSE):
    return poses_on_planes(CAMERA, _seen(planes), world, predicted, CENTRE, DEFAULT)


def _apart(pose):
    return np.abs(se3.log(se3.compose(pose[None], se3.inverse(POSE[None])))[0])


@pytest.mark.parametrize("turn", [0.0, 0.5, -0.8])
def test_planes_tell_how_the_camera_is_turned_however_wrong_the_prediction_is(turn):
    seen = planes_into(POSE, WORLD)
    predicted = se3.compose(se3.exp(np.array([[0.1, 0.0, 0.0, 0.0, turn, 0.0]])), POSE[None])[0]
    ways = _poses(seen, predicted=predicted)
    step = 6.0 * DEFAULT.finding.near * into(predicted, CENTRE[None])[0, 2] / CAMERA.fx
    for poses in ways:
        assert poses.shape == (2 * DEFAULT.finding.shifts + 1, 7)
        np.testing.assert_allclose(np.linalg.norm(np.diff(poses[:, 4:], axis=0), axis=1), step)
    near = [min((_apart(pose) for pose in poses), key=lambda apart: apart.max()) for poses in ways]
    right = [apart for apart in near if apart[3:].max() < 1e-6]
    # There are three ways to choose two planes; along both, one of the steps is near.
    assert len(right) == 3
    assert min(apart[:3].max() for apart in right) < step


def test_planes_lie_on_each_other_and_views_do_not_leave_what_was_seen():
    seen = planes_into(POSE, WORLD)
    for poses in _poses(seen):
        for pose in poses:
            assert np.linalg.norm(_apart(pose)[3:]) < 2.0 * np.arctan(320.0 / 525.0)
            # Two of the three planes at least are where they were seen.
            off = np.abs(planes_into(pose, WORLD)[:, None] - seen[None]).max(axis=2)
            assert (off < 1e-9).any(axis=1).sum() >= 2


@pytest.mark.parametrize("rows", [[], [0]])
def test_one_plane_tells_no_pose(rows):
    seen = planes_into(POSE, WORLD)
    assert _poses(seen[rows]) == []
    assert _poses(seen, world=WORLD[rows]) == []


def test_planes_that_hardly_cross_tell_no_pose():
    tilted = np.array([0.0, np.cos(0.2), np.sin(0.2), 1.5])
    both = np.stack([WORLD[0], tilted])
    assert _poses(planes_into(POSE, both), world=both) == []


def test_planes_that_cross_otherwise_are_others():
    both = np.stack([WORLD[0], [np.sin(0.8), np.cos(0.8), 0.0, 1.0]])
    assert _poses(planes_into(POSE, WORLD[:2]), world=both) == []
