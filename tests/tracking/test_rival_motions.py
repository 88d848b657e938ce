# SPDX-License-Identifier: BSD-3-Clause
"""A track of a single camera whose motion is wrong is told; a right one is not."""

import _room
import numpy as np
import pytest

from groma.geometry import quaternion, se3
from groma.tracking import Tracker, TrackOptions
from groma.tracking.backend.rival_motions import motion_that_does_not_fit
from groma.tracking.map.track_map import TrackMap

OPTIONS = TrackOptions(threaded=False, lines=False, keyframe_motion=0.06, keyframe_turn=0.1)


@pytest.fixture(scope="module")
def tracker():
    tracker = Tracker(_room.camera(), OPTIONS)
    for frame in _room.frames("mono", _room.poses(30)):
        tracker.process(frame)
    return tracker


def told(track_map, tracker):
    return motion_that_does_not_fit(track_map, tracker.camera, OPTIONS.gates, OPTIONS.point_sigma_px)


def test_a_right_track_is_not_told(tracker):
    assert len(tracker.map.living()) > 4
    assert told(tracker.map, tracker) == []


def test_a_wrong_motion_is_told(tracker):
    """The camera seems to move upward and to turn for it, instead of sideways."""
    wrong = tracker.map.copy()
    for number, keyframe in enumerate(wrong.keyframes):
        turn = quaternion.exp(np.array([-0.08 * number, 0.0, 0.0]))
        world = np.concatenate([turn, 0.2 * number * np.array([0.0, -1.0, 0.0])])
        keyframe.pose = se3.inverse(world[None])[0]
    (warning,) = told(wrong, tracker)
    assert "fit another motion clearly better" in warning


def test_a_map_of_two_keyframes_tells_nothing(tracker):
    assert told(TrackMap(keyframes=tracker.map.keyframes[:2]), tracker) == []
    assert told(TrackMap(), tracker) == []
