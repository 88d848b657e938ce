# SPDX-License-Identifier: BSD-3-Clause
"""A wrong focal length of a stereo pair or a single camera: the images contradict it where the camera turns."""

from dataclasses import replace

import _room
import numpy as np
import pytest

from groma.tracking import Tracker, TrackOptions


@pytest.mark.parametrize(
    ("kind", "count", "turn", "step", "factor", "turns", "told"),
    [
        ("stereo", 16, 0.06, 0.04, 1.0, True, False),
        ("stereo", 16, 0.06, 0.04, 1.15, True, True),
        ("stereo", 16, 0.06, 0.04, 1.15, False, False),
        ("mono", 30, 0.03, 0.06, 1.0, True, False),
        ("mono", 30, 0.03, 0.06, 1.15, True, True),
        pytest.param("mono", 30, 0.03, 0.06, 1.15, False, False, marks=pytest.mark.slow),
    ],
)
def test_a_wrong_focal_length_is_told_where_the_camera_turns(kind, count, turn, step, factor, turns, told):
    camera = _room.camera(_room.BASELINE if kind == "stereo" else None)
    given = replace(camera, params=camera.params * np.array([factor, factor, 1.0, 1.0]))
    few = {"num_points": 250, "num_features": 500} if kind == "stereo" else {}
    tracker = Tracker(given, TrackOptions(threaded=False, lines=False, **few))
    for frame in _room.frames(kind, _room.poses(count, turn=turn * turns, step=step)):
        tracker.process(frame)
    assert any("focal length" in warning for warning in tracker.finish().warnings) == told
