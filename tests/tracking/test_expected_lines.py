# SPDX-License-Identifier: BSD-3-Clause
"""Whether the lines that should be seen at a pose bear it out."""

from types import SimpleNamespace
from typing import Any

import _room
import numpy as np
import pytest

from groma.geometry import se3
from groma.tracking import Tracker, TrackOptions
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.pose import verification
from groma.tracking.pose.expected_lines import line_odds
from groma.tracking.pose.prediction import MotionModel
from groma.tracking.pose.verification import PoseVerification

OPTIONS = TrackOptions(num_points=250, num_features=500, threaded=False)


@pytest.mark.kernels
@pytest.mark.compiled
def test_lines_tell_the_right_pose_from_others():
    camera, poses = TrackCamera.of(_room.camera()), _room.poses(31)
    frames, tracker = _room.frames("rgbd", poses), Tracker(_room.camera(), OPTIONS)
    for k in range(3):
        tracker.process(frames[k])
    track_map, data = tracker.map, FrameFeatures(frames[3], camera, OPTIONS)
    keyframes = track_map.living()
    exact = se3.compose(poses[3:4], se3.inverse(poses[:1]))[0]

    def odds(pose: np.ndarray) -> float | None:
        return line_odds(track_map, camera, data, keyframes, pose)

    right = odds(exact)
    assert right is not None
    assert right > OPTIONS.gates.verification.odds
    for turn in ([0.1, 0.0, 0.0], [0.0, -0.2, 0.0], [0.0, 0.0, 0.1]):
        wrong = odds(se3.compose(se3.exp(np.array([[0.0, 0.0, 0.0, *turn]])), exact[None])[0])
        assert wrong is not None
        assert wrong < 0.0
    # Where no line is expected, none that is missing says anything.
    away = se3.compose(se3.exp(np.array([[0, 0, 0, 0, np.pi, 0]])), exact[None])[0]
    assert odds(away) is None
    without = FrameFeatures(frames[3], camera, TrackOptions(lines=False, threaded=False))
    assert line_odds(track_map, camera, without, keyframes, exact) is None


@pytest.mark.parametrize(
    ("score", "odds", "contradicted", "expected"),
    [
        (200.0, -9.0, True, True),  # so much agrees that nothing else is asked
        (40.0, 9.0, True, True),
        (40.0, -1.0, False, False),  # a road has its depth wherever the car is
        (40.0, 1.0, False, True),
        (40.0, 1.0, True, False),
        (40.0, None, False, True),
        (40.0, None, True, False),
    ],
)
def test_a_weak_pose_needs_a_witness(monkeypatch, score, odds, contradicted, expected):
    monkeypatch.setattr(verification, "line_odds", lambda *_: odds)
    monkeypatch.setattr(PoseVerification, "_contradicted", lambda *_: contradicted)
    nothing: Any = None
    found: Any = SimpleNamespace(
        score=score, known=SimpleNamespace(keyframes=[]), estimate=SimpleNamespace(pose=se3.identity())
    )
    camera = TrackCamera(525.0, 525.0, 320.0, 240.0, 640, 480)
    assert PoseVerification(camera, OPTIONS)._witnessed(nothing, nothing, found) == expected


def test_a_prediction_fades_with_lost_frames_before_a_step_is_known():
    motion = MotionModel()
    motion.update(None, se3.identity(), 0.0)
    sigmas = [motion.predict(se3.identity(), time)[1] for time in (0.7, 1.4, 2.1)]
    np.testing.assert_allclose(sigmas, sigmas[0] * np.array([[1.0], [2.0], [3.0]]))
    motion.update(None, se3.identity(), 2.1)
    np.testing.assert_allclose(motion.predict(se3.identity(), 2.8)[1], sigmas[0])
