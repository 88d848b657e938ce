# SPDX-License-Identifier: BSD-3-Clause
"""Depths that are off: found in the map of a rendered room, and corrected; left alone where they are right."""

from dataclasses import replace

import _room
import numpy as np
import pytest

from groma.gates import NORMAL
from groma.geometry import se3
from groma.tracking import Tracker, TrackOptions
from groma.tracking.backend.depth_calibration import correct_depths, depths_that_do_not_fit
from groma.tracking.frame.camera import planes_into

COUNT = 40
#: Backward and sideways: near becomes far.
POSES = _room.poses(COUNT, turn=0.02, step=-0.05)


@pytest.fixture(scope="module")
def frames():
    return _room.frames("rgbd", POSES)


def _tracked(frames, offset):
    """A finished track of frames whose inverse depths are too small by an offset."""
    tracker = Tracker(_room.camera(), TrackOptions(keyframe_motion=0.05, lines=False))
    for frame in frames:
        depth = np.where(frame.depth > 0, 1.0 / (1.0 / np.maximum(frame.depth, 1e-6) - offset), 0.0)
        tracker.process(replace(frame, depth=depth.astype(np.float32)))
    return tracker, tracker.finish()


@pytest.mark.parametrize("offset", [0.006, -0.006])
def test_an_offset_of_inverse_depths_is_found(frames, offset):
    """Depths are off by 1 to 2 per cent, and so would be the path."""
    _, result = _tracked(frames, offset)
    found = result.statistics["depth_camera"]
    assert found["used"]
    assert found["inverse_offset"] == pytest.approx(offset, abs=3 * found["sigma"])
    assert found["inverse_offset"] == pytest.approx(offset, rel=0.35)
    assert _scale_error(result) < 0.005


def test_right_depths_stay(frames):
    _, result = _tracked(frames, 0.0)
    found = result.statistics["depth_camera"]
    assert abs(found["inverse_offset"]) < 3 * found["sigma"]
    assert abs(found["inverse_offset"]) < 0.002
    assert found["sigma"] < 0.002
    assert not any("disagree" in sentence for sentence in result.warnings)


def test_depths_that_do_not_fit_the_points_are_told(frames, monkeypatch):
    """Depths of a finished map are put off, to both sides in turn, by half of their noise and by three times that."""
    track_map = _tracked(frames[:16], 0.0)[0].map
    gates = TrackOptions().gates.depth
    assert len(track_map.living()) >= 3
    assert depths_that_do_not_fit(track_map, gates) == []
    for sigmas, told in ((0.5, 0), (3.0, 1)):
        off = track_map.copy()
        for keyframe in off.living():
            points = keyframe.measured.points
            away = sigmas * points.depth_sigma * np.where(np.arange(len(points)) % 2, 1.0, -1.0)
            keyframe.measured = replace(keyframe.measured, points=replace(points, depth=points.depth + away))
        assert len(depths_that_do_not_fit(off, gates)) == told
    monkeypatch.setattr("groma.tracking.backend.depth_calibration.NORMAL", replace(NORMAL, sample=10**6))
    assert depths_that_do_not_fit(off, gates) == []


def test_an_offset_beyond_all_noise_is_told_and_not_used(frames):
    _, result = _tracked(frames, 0.03)
    found = result.statistics["depth_camera"]
    assert found["inverse_offset"] > 0.009
    assert not found["used"]
    assert sum("Depths and images disagree" in sentence for sentence in result.warnings) == 1


def test_correcting_depths_moves_planes_like_points(frames):
    """Places of a measured plane, moved along their rays by the offset, lie on the corrected plane."""
    tracker, _ = _tracked(frames[:6], 0.0)
    keyframe = tracker.map.living()[0]
    before = keyframe.measured
    places = np.array([[0.3, -0.2, 2.0], [-0.5, 0.4, 2.5], [0.2, 0.6, 3.0]])
    plane = before.planes.plane[:1].repeat(3, axis=0)
    assert len(before.planes)
    share = -plane[:, 3] / (plane[:, :3] * places).sum(axis=1)
    on_plane = places * share[:, None]
    correct_depths(tracker.map, 0.01)
    moved = on_plane / (1.0 + 0.01 * on_plane[:, 2:])
    after = keyframe.measured
    corrected = after.planes.plane[0]
    np.testing.assert_allclose(moved @ corrected[:3] + corrected[3], 0.0, atol=1e-12)
    np.testing.assert_allclose(planes_into(se3.identity(), after.planes.plane), after.planes.plane)
    known = np.isfinite(before.points.depth)
    np.testing.assert_allclose(1.0 / after.points.depth[known], 1.0 / before.points.depth[known] + 0.01)


def _scale_error(result) -> float:
    """By what share the path is too long or too short."""
    rows = np.round(result.trajectory.timestamps * 30).astype(int)
    found, true = result.trajectory.world_from_cam[:, 4:], se3.inverse(POSES[rows])[:, 4:]
    spread = [np.linalg.norm(path - path.mean(axis=0)) for path in (found, true)]
    return abs(float(spread[0] / spread[1]) - 1.0)
