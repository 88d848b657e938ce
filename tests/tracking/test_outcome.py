# SPDX-License-Identifier: BSD-3-Clause
"""Poses of all frames once the keyframes have been adjusted."""

from types import SimpleNamespace

import _room
import numpy as np

from groma.geometry import se3
from groma.tracking import Tracker, TrackOptions
from groma.tracking.frame.features import Features
from groma.tracking.frame.measurements import Measurements
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.outcome import History
from groma.tracking.result import about_rest

NO_FEATURES = Features(
    np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 32), np.uint8), np.zeros(0), np.zeros(0, int)
)


def _keyframe(index: int, time: float, pose: np.ndarray) -> Keyframe:
    return Keyframe(index, time, "", pose, None, Measurements.empty(), NO_FEATURES, np.zeros(0))


def _at(x: float) -> np.ndarray:
    """A camera at x along its first axis."""
    return np.array([0, 0, 0, 1, -x, 0, 0.0])


def test_frames_move_with_the_keyframes_before_and_after_them():
    """Tracked at 0, 1, 2, ... 7; frames 0 and 4 became keyframes, and adjusting shows that frame 4 was at 4.8."""
    track_map, history = TrackMap(), History()
    track_map.keyframes.append(_keyframe(0, 0.0, _at(0.0)))
    track_map.reference = 0
    for k in range(6):
        # The keyframe is made two frames later; frame 5 is tracked against the old one.
        history.note_pose(track_map, float(k), _at(float(k)))
    track_map.keyframes.append(_keyframe(1, 4.0, _at(4.8)))
    track_map.reference = 1
    history.note_pose(track_map, 6.0, _at(6.9))
    where = history.trajectory(track_map).world_from_cam[:, 4]
    # In proportion to time up to the keyframe, wholly after it; what was tracked against it is where it was said to be.
    np.testing.assert_allclose(where, [0.0, 1.2, 2.4, 3.6, 4.8, 5.8, 6.9], atol=1e-12)


def test_nothing_moves_without_an_adjustment():
    track_map, history = TrackMap(), History()
    poses = _room.poses(5)
    track_map.keyframes.append(_keyframe(0, 0.0, poses[0]))
    track_map.reference = 0
    for k, pose in enumerate(poses):
        history.note_pose(track_map, float(k), pose)
    track_map.keyframes.append(_keyframe(1, 3.0, poses[3]))
    np.testing.assert_allclose(history.trajectory(track_map).world_from_cam, se3.inverse(poses), atol=1e-12)
    assert len(History().trajectory(track_map)) == 0


def test_keyframes_of_a_track_are_where_the_map_has_them():
    tracker = Tracker(_room.camera(), TrackOptions(num_points=250, num_features=500))
    for frame in _room.frames("rgbd", _room.poses(16)):
        tracker.process(frame)
    result = tracker.finish()
    rows = np.searchsorted(result.trajectory.timestamps, result.keyframes)
    expected = se3.inverse(result.scene.cam_from_world)
    np.testing.assert_allclose(result.trajectory.world_from_cam[rows], expected, atol=1e-9)


def test_a_map_of_one_keyframe_says_why():
    alone = SimpleNamespace(num_images=1)
    assert "hardly moved" in about_rest(alone, 10)[0]
    assert "no other frame has a pose" in about_rest(alone, 1)[0]
    assert about_rest(SimpleNamespace(num_images=2), 1) == []
