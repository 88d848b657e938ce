# SPDX-License-Identifier: BSD-3-Clause
"""A wrong focal length of a stereo pair: the images contradict it where the camera turns, and only there."""

from dataclasses import replace

import _room
import numpy as np
import pytest

from groma.tracking import Tracker, TrackOptions


@pytest.mark.parametrize(("factor", "turn", "told"), [(1.0, 0.06, False), (1.15, 0.06, True), (1.15, 0.0, False)])
def test_a_wrong_focal_length_is_told_where_the_camera_turns(factor, turn, told):
    pair = _room.camera(_room.BASELINE)
    given = replace(pair, params=pair.params * np.array([factor, factor, 1.0, 1.0]))
    tracker = Tracker(given, TrackOptions(num_points=250, num_features=500, lines=False, threaded=False))
    for frame in _room.frames("stereo", _room.poses(16, turn=turn, step=0.04)):
        tracker.process(frame)
    assert any("focal length" in warning for warning in tracker.finish().warnings) == told
