# SPDX-License-Identifier: BSD-3-Clause
"""Masks of frames: a camera that sees what it is mounted on, which stays where it is in the image."""

import dataclasses

import _room
import numpy as np
import pytest

from groma.geometry import se3
from groma.tracking import Tracker, TrackOptions
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.features import FrameFeatures

OPTIONS = TrackOptions(num_points=250, num_features=500, threaded=False)
#: The lower third shows a dashboard.
ROW = 2 * _room.HEIGHT // 3
USED = np.arange(_room.HEIGHT)[:, None] < np.full(_room.WIDTH, ROW)


@pytest.fixture(scope="module")
def frames():
    """A room behind a dashboard with sharp edges, half a metre away."""
    rng = np.random.default_rng(0)
    board = np.kron(rng.integers(0, 255, (_room.HEIGHT // 20 + 1, _room.WIDTH // 20 + 1)), np.ones((20, 20)))
    board = board[: _room.HEIGHT, : _room.WIDTH].astype(np.uint8)
    return [
        dataclasses.replace(
            frame,
            gray=np.where(USED, frame.gray, board),
            depth=np.where(USED, np.asarray(frame.depth), np.float32(0.5)),
        )
        for frame in _room.frames("rgbd", _room.poses(8))
    ]


def test_nothing_is_found_where_a_mask_is_black(frames):
    camera = TrackCamera.of(_room.camera())
    plain, masked = (FrameFeatures(dataclasses.replace(frames[0], used=used), camera, OPTIONS) for used in (None, USED))
    for data, hidden in ((plain, True), (masked, False)):
        rows = data.features.pixel[:, 1], data.corners[:, 1], data.detected.segments.ends[:, 1::2].ravel()
        assert [bool((row > ROW).any()) for row in rows] == [hidden] * 3
    assert masked.depth is not None and not masked.depth[ROW:].any() and masked.depth[:ROW].any()


def test_a_dashboard_that_is_masked_does_not_hold_the_camera(frames):
    """What stays in the image says that the camera stands still; masked, it is followed to millimetres as without."""
    moved = {}
    for name, used in (("plain", None), ("masked", USED)):
        tracker = Tracker(_room.camera(), OPTIONS)
        for frame in frames:
            tracker.process(dataclasses.replace(frame, used=used))
        places = tracker.finish().trajectory.world_from_cam[:, 4:]
        moved[name] = float(np.linalg.norm(places[-1] - places[0]))
    true = se3.inverse(_room.poses(len(frames)))[:, 4:]
    moved["true"] = float(np.linalg.norm(true[-1] - true[0]))
    assert moved["plain"] < 0.8 * moved["true"]
    assert moved["masked"] == pytest.approx(moved["true"], abs=3e-3)  # three times the noise of depths at half a metre
