# SPDX-License-Identifier: BSD-3-Clause
"""Whether a place that was found stands out: against chance, and on what repeats itself."""

from types import SimpleNamespace
from typing import Any

import _room
import numpy as np
import pytest

from groma.geometry import se3
from groma.tracking import Tracker, TrackOptions
from groma.tracking.frame.camera import TrackCamera, back, into
from groma.tracking.frame.descriptor_pairs import PlacedFeatures, pair_near
from groma.tracking.pose import verification
from groma.tracking.pose.prediction import MotionModel
from groma.tracking.pose.rivals import num_cells, poses_beside, stands_out
from groma.tracking.pose.verification import PoseVerification

CAMERA = TrackCamera(525.0, 525.0, 320.0, 240.0, 640, 480)
POSE = se3.exp(np.array([[0.3, -0.2, 0.5, 0.4, -0.8, 0.3]]))[0]
#: Distance at which a feature agrees, pixels; others are looked at five times as far away.
NEAR = 6.0


def test_poses_beside_see_everything_a_little_elsewhere():
    pixel = np.array([[320.0, 240.0], [330.0, 235.0]])
    places = back(POSE, CAMERA.bearings(pixel) * [[2.0], [7.0]])
    beside = list(poses_beside(CAMERA, POSE, 30.0))
    way = np.array([CAMERA.project(into(pose, places)) - pixel for pose in beside])
    np.testing.assert_allclose(np.linalg.norm(way, axis=2), np.repeat([30.0, 60.0], 8)[:, None] * [1, 1], rtol=0.02)
    assert len({tuple(np.round(one[0]).astype(int)) for one in way}) == 16


@pytest.mark.parametrize(
    ("votes", "beside", "expected"),
    [(20, 0, True), (20, 2, True), (20, 8, False), (60, 20, True), (60, 40, False), (8, 0, False), (0, 0, False)],
)
def test_the_sign_test_decides(votes, beside, expected):
    assert stands_out(CAMERA, POSE, votes, lambda pose: beside, NEAR) == expected


def _votes_at(pixel, descriptor):
    """Votes of poses for features on a wall that is seen by one camera at a pose and known by itself."""
    places = back(POSE, CAMERA.bearings(pixel) * 3.0)
    features = PlacedFeatures.of(pixel, descriptor)

    def votes_at(pose):
        pairs = pair_near(CAMERA.project(into(pose, places)), descriptor, features, NEAR, 64)
        return num_cells(CAMERA, pixel[pairs[:, 1]])

    return votes_at


def test_what_repeats_itself_does_not_stand_out():
    """Tiles 30 pixels wide: those that look alike are seen a tile away, those that differ are not."""
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.arange(35.0, 620.0, 30.0), np.arange(35.0, 460.0, 30.0))
    pixel = np.column_stack([u.ravel(), v.ravel()])
    own = rng.integers(0, 256, (len(pixel), 32), dtype=np.uint8)
    for descriptor, expected in ((own, True), (np.repeat(own[:1], len(pixel), axis=0), False)):
        votes_at = _votes_at(pixel, descriptor)
        assert votes_at(POSE) > 200
        assert stands_out(CAMERA, POSE, votes_at(POSE), votes_at, NEAR) == expected


def test_votes_are_of_cells():
    """Ten features within ten pixels are one thing that looks alike."""
    pixel = np.array([325.0, 245.0]) + np.arange(10)[:, None]
    assert num_cells(CAMERA, pixel) == 1
    assert num_cells(CAMERA, np.zeros((0, 2))) == 0
    assert num_cells(CAMERA, np.array([[10.0, 10.0], [10.0, 50.0], [50.0, 10.0]])) == 3


def test_a_gap_is_longer_than_what_is_extrapolated():
    motion = MotionModel()
    motion.update(None, POSE, 0.0)
    motion.update(POSE, POSE, 0.1)
    for time, expected in ((0.2, False), (0.39, False), (0.55, True), (0.2, False)):
        motion.predict(POSE, time)
        assert motion.after_gap == expected


def test_a_prediction_says_nothing_where_the_camera_may_see_something_else():
    """The field of view is 62.7 degrees, and what is seen 2 units away."""
    says_nothing = PoseVerification(CAMERA, TrackOptions())._says_nothing
    near: Any = SimpleNamespace(near=SimpleNamespace(depth=2.0))
    for shift, turn, expected in ((0.1, 60.0, False), (0.1, 65.0, True), (1.9, 1.0, False), (2.1, 1.0, True)):
        assert says_nothing(near, np.array([shift, 0, 0, 0, np.radians(turn), 0])) == expected


@pytest.mark.kernels
@pytest.mark.compiled
@pytest.mark.parametrize("says_nothing", [False, True])
def test_a_frame_after_a_gap_that_does_not_stand_out_is_lost(monkeypatch, says_nothing):
    monkeypatch.setattr(verification, "stands_out", lambda *_: False)
    monkeypatch.setattr(PoseVerification, "_says_nothing", lambda *_: says_nothing)
    tracker = Tracker(_room.camera(), TrackOptions(num_points=250, num_features=500, threaded=False))
    frames = _room.frames("rgbd", _room.poses(31))
    statuses = [tracker.process(frames[k]).status for k in (*range(6), 30)]
    assert statuses == ["tracked"] * 6 + ["lost" if says_nothing else "tracked"]
