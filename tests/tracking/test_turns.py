# SPDX-License-Identifier: BSD-3-Clause
"""Fast turns in rendered rooms: nothing is lost, no pose is said that is wrong, and what cannot be seen is not said.

Limits are those of a camera of 320 x 240 pixels at 2 to 3 units from the walls, where a pixel spans a centimetre.
``benchmarks/turns.py`` does the same in larger rooms, with blur, holes, and a street.
"""

import dataclasses

import _room
import numpy as np
import pytest

from groma.geometry import quaternion, se3, so3
from groma.tracking import Tracker, TrackOptions
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.map.track_map import TrackMap
from groma.tracking.pose.depth_check import depth_agreement
from groma.tracking.pose.estimate import PoseEstimate
from groma.tracking.pose.relocalise import pose_from_matches
from groma.tracking.pose.verification import PoseVerification

pytestmark = pytest.mark.filterwarnings("error")
OPTIONS = TrackOptions(num_points=250, num_features=500)


def _swing(degrees: float, count: int = 22) -> np.ndarray:
    """Looks around by up to some degrees a frame, from rest to full speed in two frames, and turns back at once."""
    speed = np.radians(degrees) * np.clip((np.arange(count) - 1) / 2, 0, 1) * np.where(np.arange(count) % 13 < 9, 1, -1)
    path = np.cumsum(speed)
    yaw, pitch, roll = 0.9 * path, 0.15 * np.sin(1.1 * path), 0.2 * np.sin(1.7 * path)
    R = (
        so3.exp(np.outer(yaw, [0, 1.0, 0]))
        @ so3.exp(np.outer(pitch, [1.0, 0, 0]))
        @ so3.exp(np.outer(roll, [0, 0, 1.0]))
    )
    center = 0.02 * np.arange(count)[:, None] * (1.0, 0.1, 0.3) + R @ (0.0, 0.0, 0.15)
    return se3.inverse(np.hstack([quaternion.from_matrix(R), center]))


def _worst(rows, poses: np.ndarray) -> tuple[float, float]:
    """Largest error of a pose as it was said: scene units, degrees."""
    exact = se3.compose(poses, np.tile(se3.inverse(poses[:1]), (len(poses), 1)))
    said = [k for k, row in enumerate(rows) if row.pose is not None]
    mine = np.array([rows[k].pose for k in said])
    shift = np.linalg.norm(se3.inverse(mine)[:, 4:] - se3.inverse(exact[said])[:, 4:], axis=1)
    turn = np.linalg.norm(se3.log(se3.compose(mine, se3.inverse(exact[said])))[:, 3:], axis=1)
    return float(shift.max()), float(np.degrees(turn.max()))


@pytest.mark.parametrize("degrees", [*(pytest.param(less, marks=pytest.mark.slow) for less in (10, 18)), 25])
def test_a_swinging_depth_camera(degrees):
    poses = _swing(degrees)
    tracker = Tracker(_room.camera(), OPTIONS)
    rows = [tracker.process(frame) for frame in _room.frames("rgbd", poses)]
    result = tracker.finish()
    assert {row.status for row in rows} <= {"tracked", "found"}
    shift, turn = _worst(rows, poses)
    assert shift < 0.04
    assert turn < 1.0
    assert _room.position_error(result.trajectory, poses) < 0.015


def test_a_stereo_pair_turns_fast():
    angle = np.concatenate([np.zeros(4), np.arange(0, 91, 10.0), np.full(3, 90.0)])
    R = so3.exp(np.outer(np.radians(angle), [0, 1.0, 0]))
    center = 0.02 * np.arange(len(angle))[:, None] * (1.0, 0.0, 0.5)
    poses = se3.inverse(np.hstack([quaternion.from_matrix(R), center]))
    tracker = Tracker(_room.camera(_room.BASELINE), OPTIONS)
    rows = [tracker.process(frame) for frame in _room.frames("stereo", poses)]
    tracker.finish()
    assert {row.status for row in rows} <= {"tracked", "found"}
    shift, turn = _worst(rows, poses)
    assert shift < 0.08
    assert turn < 1.5


def test_what_is_covered_is_not_tracked():
    """A hand over the camera while it turns on: grey noise without depth, then the room from elsewhere."""
    poses = _swing(8, 20)
    frames = _room.frames("rgbd", poses)
    rng = np.random.default_rng(0)
    for k in range(9, 12):
        hand = np.clip(60 + 8 * rng.normal(size=frames[k].gray.shape), 0, 255).astype(np.uint8)
        frames[k] = dataclasses.replace(frames[k], gray=hand, depth=np.zeros_like(frames[k].depth))
    tracker = Tracker(_room.camera(), OPTIONS)
    rows = [tracker.process(frame) for frame in frames]
    tracker.finish()
    assert {row.status for row in rows[9:12]} <= {"lost", "skipped"}
    assert all(row.pose is not None for row in rows[14:])
    shift, turn = _worst(rows, poses)
    assert shift < 0.04
    assert turn < 1.0


def test_depth_confirms_a_pose_and_denies_others():
    poses = _room.poses(5)
    frames = _room.frames("rgbd", poses)
    camera = TrackCamera.of(_room.camera())
    tracker = Tracker(_room.camera(), OPTIONS)
    tracker.process(frames[0])
    track_map: TrackMap = tracker.map
    grid = FrameFeatures(frames[4], camera, OPTIONS).depth_grid
    exact = se3.compose(poses[4:5], se3.inverse(poses[:1]))[0]
    agree, through = depth_agreement(camera, track_map.keyframes, grid, exact)
    assert agree > 0.95
    assert through < 0.02
    turned = se3.compose(np.array([[0, np.sin(0.35), 0, np.cos(0.35), 0, 0, 0]]), exact[None])[0]
    agree, through = depth_agreement(camera, track_map.keyframes, grid, turned)
    assert agree < 0.6
    nearer = exact + np.array([0, 0, 0, 0, 0, 0, -0.6])
    assert depth_agreement(camera, track_map.keyframes, grid, nearer)[1] > 0.8
    assert np.isnan(depth_agreement(camera, track_map.keyframes, np.full_like(grid, np.nan), exact)).all()
    tracker.finish()


def test_a_pose_far_from_the_prediction_needs_more_that_agrees():
    """Windows that repeat are followed to the next window, and agree among themselves."""
    verification = PoseVerification(TrackCamera.of(_room.camera()), OPTIONS)
    sigma, none = np.full(6, 0.1), np.zeros(0, bool)
    at = se3.identity()
    away = at + np.array([0, 0, 0, 0, 0.5, 0, 0])

    def estimate(pose: np.ndarray, agree: int) -> PoseEstimate:
        return PoseEstimate(pose, np.arange(100) < agree, none, none, np.eye(6), ())

    assert verification.is_surprised(estimate(away, 55), at, sigma)
    assert not verification.is_surprised(estimate(away, 90), at, sigma)
    assert not verification.is_surprised(estimate(at, 55), at, sigma)


@pytest.mark.parametrize("kind", ["one place", "two places", "three places", "a line", "nearly one place"])
def test_places_that_coincide_give_no_error(kind):
    rng = np.random.default_rng(3)
    count = 30
    few = np.array([[0, 0, 4.0], [1, 0, 4.0], [0, 1, 5.0]])
    places = {
        "one place": np.tile(few[:1], (count, 1)),
        "two places": few[rng.integers(0, 2, count)],
        "three places": few[rng.integers(0, 3, count)],
        "a line": few[0] + np.linspace(0, 1, count)[:, None] * [1.0, 0.3, 0.2],
        "nearly one place": few[0] + 1e-5 * rng.normal(size=(count, 3)),
    }[kind]
    camera = TrackCamera.of(_room.camera())
    for pixel in (camera.project(places), rng.uniform(0, 200, (count, 2))):
        found = pose_from_matches(camera, places, pixel)
        assert found is None or np.isfinite(found[0]).all()


def test_places_give_a_pose():
    rng = np.random.default_rng(4)
    places = rng.uniform([-1, -1, 3], [1, 1, 5], (60, 3))
    pose = np.array([0, np.sin(0.1), 0, np.cos(0.1), 0.2, -0.1, 0.3])
    camera = TrackCamera.of(_room.camera())
    pixel = camera.project(se3.transform_points(pose[None], places)) + rng.normal(0, 0.3, (60, 2))
    pixel[:20] = rng.uniform(0, 200, (20, 2))
    found = pose_from_matches(camera, places, pixel)
    assert found is not None
    assert np.abs(se3.log(se3.compose(found[0][None], se3.inverse(pose[None])))).max() < 0.02
    assert found[1][20:].mean() > 0.95
