# SPDX-License-Identifier: BSD-3-Clause
"""Real sequences: limits are those the tracker was made for, on references of a depth camera, a laboratory and GPS.

Whole sequences are slow tests where the same one is tracked with frames left out, which is harder, or where rendered
ones with a known truth show the same.
"""

import cv2
import numpy as np
import pytest

import groma
from groma.evaluation.trajectory import Alignment, score_trajectory
from groma.geometry import quaternion, so3
from groma.io.sequences import Frame, SequenceCamera, open_sequence
from groma.tracking import Tracker, TrackOptions

pytestmark = pytest.mark.shared


SLOW = pytest.mark.slow


@pytest.mark.parametrize("stride", [pytest.param(3, marks=SLOW), 5])
def test_kitchen_with_frames_left_out(shared_data, stride):
    statuses, _, scores = _track(shared_data / "rgbd_7scenes_redkitchen", stride=stride)
    assert set(statuses) == {"tracked"}
    assert scores.ate.rmse < 0.02


@pytest.mark.parametrize("stride", [pytest.param(2, marks=SLOW), 3])  # the third is harder
def test_cabinet_with_frames_left_out(shared_data, stride):
    """Up to 30 degrees from frame to frame, with few points."""
    statuses, result, scores = _track(shared_data / "rgbd_tum_fr3_cabinet", stride=stride)
    assert set(statuses) == {"tracked"}
    assert scores.ate.rmse < 0.03
    _assert_photographs(result.scene, shared_data / "rgbd_tum_fr3_cabinet")


def test_a_cabinet_seen_again_from_the_opposite_side_is_not_found(shared_data):
    """One keyframe, five frames in which nothing agrees, then 57 points, lines and planes of the other side."""
    sequence = open_sequence(shared_data / "rgbd_tum_fr3_cabinet")
    frames, tracker = list(sequence), Tracker(sequence.camera, TrackOptions(threaded=False))
    first, *lost, last = (tracker.process(frames[number]) for number in (5, 23, 29, 30, 31, 32, 35))
    assert [each.status for each in (first, *lost)] == ["tracked", *["lost"] * 5]
    assert last.pose is None or last.submap > first.submap


@pytest.mark.parametrize("kind", ["stereo", "mono"])
@pytest.mark.parametrize(
    ("stride", "count"), [pytest.param(2, None, marks=SLOW), pytest.param(3, None, marks=SLOW), (3, 8)]
)
def test_street_with_frames_left_out(shared_data, kind, stride, count):
    """Up to 3.6 metres from frame to frame; one per cent of drift is allowed for each step of the full sequence."""
    align = "sim3" if kind == "mono" else "se3"
    statuses, _, scores = _track(shared_data / "stereo_kitti06", align, kind=kind, stride=stride, max_frames=count)
    assert "lost" not in statuses
    assert scores.drift_percent is not None
    assert scores.drift_percent < stride


def _track(folder, align: Alignment = "se3", options=None, **selection):
    frames = open_sequence(folder, **selection)
    tracker = Tracker(frames.camera, options)
    statuses = [tracker.process(frame).status for frame in frames]
    result = tracker.finish()
    assert frames.reference is not None
    return statuses, result, score_trajectory(result.trajectory, frames.reference, align, max_time_difference=0.02)


@SLOW
def test_kitchen(shared_data):
    statuses, result, scores = _track(shared_data / "rgbd_7scenes_redkitchen")
    assert set(statuses) == {"tracked"}
    assert scores.ate.rmse < 0.02
    assert result.scene.num_lines > 30


@SLOW
def test_cabinet_needs_lines_and_planes(shared_data):
    """Few points, wide steps: 3 cm over a path of 8.3 m with all landmarks; points alone are farther off."""
    statuses, result, scores = _track(shared_data / "rgbd_tum_fr3_cabinet")
    assert "lost" not in statuses
    assert len(result.trajectory) == 58
    assert scores.ate.rmse < 0.03
    _assert_photographs(result.scene, shared_data / "rgbd_tum_fr3_cabinet")
    points_alone = _track(shared_data / "rgbd_tum_fr3_cabinet", options=TrackOptions(lines=False, planes=False))[2]
    assert points_alone.ate.rmse > 1.2 * scores.ate.rmse


def _assert_photographs(scene, folder):
    """Keyframes are photographs on disk, each once; every point is seen in two of them."""
    assert len(set(scene.images.names)) == scene.num_images
    assert all((folder / "rgb" / name).is_file() for name in scene.images.names)
    seen = np.unique(np.column_stack([scene.point_observations.image_idx, scene.point_observations.point_idx]), axis=0)
    assert len(seen) == len(scene.point_observations)
    assert np.bincount(seen[:, 1], minlength=scene.num_points).min() >= 2


@pytest.mark.parametrize("count", [10, pytest.param(30, marks=SLOW)])
def test_a_flight_in_uneven_steps(shared_data, count):
    """Pairs 0.05 to 7.3 s apart: steps of up to 1.2 m and 59 degrees, past a radiator whose bars repeat."""
    statuses, result, scores = _track(shared_data / "stereo_euroc_v101_keyframes", max_frames=count)
    assert set(statuses) == {"tracked"}
    assert result.submaps == ()
    assert scores.ate.rmse < 0.03


@SLOW
def test_street_by_a_stereo_pair(shared_data):
    statuses, result, scores = _track(shared_data / "stereo_kitti06")
    assert set(statuses) == {"tracked"}
    assert scores.drift_percent is not None
    assert scores.drift_percent < 1.0
    # The rectification of these images is off by a third of a pixel, which the map tells.
    pitch, yaw, roll = result.statistics["right_camera"]["shift_px"]
    assert 0.1 < pitch < 0.3
    assert 0.1 < yaw < 0.5
    assert -0.4 < roll < -0.1
    assert groma.adjust(result.scene).report.solve.iterations == 0
    height, slope = _ground_below(result.scene)
    assert height == pytest.approx(1.65, abs=0.15)
    assert slope < 2.0


def _ground_below(scene):
    """The plane that most points lie on: how far below the cameras it is, and its slope there, degrees."""
    counts = np.bincount(scene.relations.point_on_plane[:, 1], minlength=scene.num_planes)
    hesse = scene.planes.hesse[int(counts.argmax())]
    centers = scene.cam_centers_in_world
    height = np.abs(centers @ hesse[:3] + hesse[3])
    way = centers[-1] - centers[0]
    down = quaternion.rotate(quaternion.conjugate(scene.cam_from_world[0, :4]), np.array([0.0, 1.0, 0.0]))
    upright = np.degrees(np.arccos(np.abs(hesse[:3] @ down)))
    assert np.degrees(np.arcsin(np.abs(hesse[:3] @ way) / np.linalg.norm(way))) < 2.0
    return float(np.median(height)), float(upright)


@SLOW
def test_street_by_one_camera(shared_data):
    statuses, result, scores = _track(shared_data / "stereo_kitti06", "sim3", kind="mono")
    assert "lost" not in statuses
    assert scores.drift_percent is not None
    assert scores.drift_percent < 2.0
    height, slope = _ground_below(result.scene)
    assert scores.similarity.scale * height == pytest.approx(1.65, abs=0.25)
    assert slope < 2.0


@SLOW
def test_a_board_by_one_camera(shared_data):
    """The board is the plane z = 0 of the reference, up to a similarity."""
    folder = shared_data / "mono_checkerboard_desk"
    _, result, scores = _track(folder, "sim3", stride=3)
    scene, reference = result.scene, open_sequence(folder, stride=3).reference
    assert reference is not None
    assert scores.ate.rmse < 0.005
    counts = np.bincount(scene.relations.point_on_plane[:, 1], minlength=scene.num_planes)
    hesse = scene.planes.hesse[int(counts.argmax())]
    assert counts.max() > 100
    # Seen from each keyframe, plane and board are in the same direction and at the same distance.
    rows = [int(np.abs(reference.timestamps - time).argmin()) for time in result.keyframes]
    world_from_cam = reference.world_from_cam[rows]
    toward = quaternion.rotate(scene.cam_from_world[:, :4], np.tile(hesse[:3], (scene.num_images, 1)))
    true = quaternion.rotate(quaternion.conjugate(world_from_cam[:, :4]), np.tile([0.0, 0.0, 1.0], (len(rows), 1)))
    assert np.degrees(np.arccos(np.abs((toward * true).sum(axis=1)))).max() < 2.0
    distance = np.abs(scene.cam_centers_in_world @ hesse[:3] + hesse[3]) * scores.similarity.scale
    np.testing.assert_allclose(distance, np.abs(world_from_cam[:, 6]), atol=0.01)


def test_the_kitchen_turned_about_the_camera(shared_data):
    """A smaller camera at the same places swings by up to 12 degrees from frame to frame."""
    sequence = open_sequence(shared_data / "rgbd_7scenes_redkitchen", max_frames=30)
    old = sequence.camera
    size = int(0.62 * old.width), int(0.62 * old.height)
    camera = SequenceCamera("PINHOLE", np.array([*old.params[:2], size[0] / 2, size[1] / 2]), *size)
    K, new = (np.array([[p[0], 0, p[2] - 0.5], [0, p[1], p[3] - 0.5], [0, 0, 1]]) for p in (old.params, camera.params))
    rays = np.stack([*np.meshgrid(np.arange(size[0]), np.arange(size[1])), np.ones(size[::-1])], axis=-1)
    tracker, statuses = Tracker(camera), []
    for k, frame in enumerate(sequence):
        swing = np.radians(12.0) * min(k / 6.0, 1.0)
        R = so3.exp(swing * np.array([[0.3 * np.sin(0.7 * k + 1), 0.45 * np.sin(0.9 * k), 0.5 * np.sin(0.8 * k)]]))[0]
        turned = new @ R @ np.linalg.inv(K)
        gray = cv2.warpPerspective(frame.gray, turned, size, flags=cv2.INTER_LINEAR)
        depth = cv2.warpPerspective(frame.depth, turned, size, flags=cv2.INTER_NEAREST)
        depth = (depth / (rays @ np.linalg.inv(new).T @ R)[..., 2]).astype(np.float32)
        statuses.append(tracker.process(Frame(frame.timestamp, gray, depth)).status)
    assert set(statuses) <= {"tracked", "found"}
    assert sequence.reference is not None
    scores = score_trajectory(tracker.finish().trajectory, sequence.reference, max_time_difference=0.02)
    assert scores.ate.rmse < 0.025
