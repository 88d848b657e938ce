# SPDX-License-Identifier: BSD-3-Clause
"""The tracker on rendered sequences: depth camera, stereo pair, one camera; faults in the frames; getting lost.

The camera moves 0.6 scene units among walls at 2 to 3 units; a pixel spans about 1 cm there, and poses come from some
hundred points, so a centimetre is a generous limit for what is metric.
"""

import dataclasses

import _room
import numpy as np
import pytest

import groma
from groma.errors import InputError, ShapeError
from groma.geometry import se3
from groma.io.sequences import SequenceCamera
from groma.scene import LineDepths, PlaneObservations, PointDepths
from groma.tracking import Tracker, TrackOptions

pytestmark = pytest.mark.filterwarnings("error")
COUNT = 24


@pytest.fixture(scope="module")
def truth():
    return _room.poses(COUNT)


@pytest.fixture(scope="module")
def rgbd(truth):
    return _room.frames("rgbd", truth)


def _run(frames, camera=None, **options):
    tracker = Tracker(camera or _room.camera(), TrackOptions(num_points=250, num_features=500, **options))
    return [tracker.process(frame) for frame in frames], tracker.finish()


@pytest.fixture(scope="module")
def tracked(rgbd):
    return _run(rgbd)


def test_depth_camera(tracked, truth):
    rows, result = tracked
    assert all(row.status == "tracked" for row in rows)
    assert _room.position_error(result.trajectory, truth) < 0.01
    assert len(result.trajectory) == COUNT


def test_the_scene_holds_what_was_seen(tracked, truth):
    _, result = tracked
    scene = result.scene
    assert scene.num_images == len(result.keyframes) >= 2
    assert scene.num_points > 50
    assert scene.num_lines > 5
    assert len(scene.relations.line_on_plane) > 0
    # The first frame is the world; walls lie where the room says, seen from there.
    walls = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            normal = np.zeros(3)
            normal[axis] = sign
            walls.append(np.append(normal, _room.ROOM[axis]))
    walls = np.array(walls)
    assert scene.num_planes >= 2
    for hesse in scene.planes.hesse:
        nearest = walls[np.argmax(walls[:, :3] @ hesse[:3])]
        assert nearest[:3] @ hesse[:3] > np.cos(0.02)
        assert abs(hesse[3] - nearest[3]) < 0.03


@pytest.mark.parametrize(
    "options",
    [{"lines": False, "planes": False}, {"points": False}, {"lines": False}],
    ids=["points", "lines and planes", "points and planes"],
)
def test_kinds_of_landmarks_apart(rgbd, truth, options):
    rows, result = _run(rgbd[:12], **options)
    lost = [row.status for row in rows if row.status not in ("tracked", "weak")]
    assert not lost
    assert _room.position_error(result.trajectory, truth) < 0.02


@pytest.fixture(scope="module")
def stereo(truth):
    return _run(_room.frames("stereo", truth[:16]), _room.camera(_room.BASELINE))


def test_stereo_pair(stereo, truth):
    rows, result = stereo
    assert all(row.status == "tracked" for row in rows)
    # A disparity of half a pixel at 2.5 units is 4 cm; hundreds of points bring that below 2 cm.
    assert _room.position_error(result.trajectory, truth) < 0.02


def _adjusted_again(result):
    """Solve the scene of a track further; return the report, and how far keyframes move against each other, scene
    units.
    """
    again = groma.adjust(result.scene, groma.AdjustOptions(start_tolerance=0.0))
    before, after = (
        se3.compose(s.cam_from_world, np.repeat(se3.inverse(s.cam_from_world[:1]), s.num_images, axis=0))
        for s in (result.scene, again.scene)
    )
    return again.report, float(np.abs(before - after)[:, 4:].max())


def test_adjusting_a_tracked_scene_is_the_same_problem(tracked):
    """All measurements are in the scene, so its adjustment hardly improves on that at the end of the track."""
    _, result = tracked
    scene = result.scene
    assert set(scene.num_measurements) >= {"point depths", "plane observations"}
    assert len(scene.relations.perpendicular_planes) > 0
    report, moved = _adjusted_again(result)
    assert report.num_measurements == scene.num_measurements
    assert report.solve.initial_cost < 1.025 * report.solve.final_cost
    assert moved < 1e-3  # of a room of 5 units, by a tracker that stops at a thousandth of its cost
    bare = scene.replace(point_depths=PointDepths(), plane_observations=PlaneObservations(), line_depths=LineDepths())
    assert len(groma.adjust(bare).report.num_measurements) == 0


def test_adjusting_a_tracked_stereo_scene_is_the_same_problem(stereo):
    _, result = stereo
    assert "right columns" in result.scene.num_measurements
    report, moved = _adjusted_again(result)
    assert report.solve.initial_cost < 1.02 * report.solve.final_cost
    assert moved < 5e-3


def test_one_camera(truth):
    rows, result = _run(_room.frames("mono", truth))
    statuses = [row.status for row in rows]
    assert "lost" not in statuses
    assert statuses.count("tracked") > COUNT // 2
    assert not result.statistics["metric"]
    assert _room.position_error(result.trajectory, truth, scale=True) < 0.02


def test_runs_repeat_exactly(rgbd, tracked):
    again = _run(rgbd)[1]
    assert np.array_equal(again.trajectory.world_from_cam, tracked[1].trajectory.world_from_cam)


def test_looking_at_a_running_track_changes_nothing(rgbd, tracked):
    tracker = Tracker(_room.camera(), TrackOptions(num_points=250, num_features=500))
    for number, frame in enumerate(rgbd):
        tracker.process(frame)
        assert len(tracker.trajectory()) <= len(rgbd)
        assert number % 3 or tracker.scene().num_images <= len(rgbd)
    np.testing.assert_array_equal(tracker.finish().trajectory.world_from_cam, tracked[1].trajectory.world_from_cam)


def test_a_track_without_threads(rgbd, truth):
    result = _run(rgbd[:12], threaded=False)[1]
    assert _room.position_error(result.trajectory, truth) < 0.01


def test_frames_with_nothing_to_see_are_skipped(rgbd, truth):
    spoilt = list(rgbd[:14])
    spoilt[6] = dataclasses.replace(spoilt[6], gray=np.zeros_like(spoilt[6].gray))
    spoilt[7] = dataclasses.replace(spoilt[7], gray=np.full_like(spoilt[7].gray, 255))
    spoilt[9], spoilt[10] = spoilt[10], spoilt[9]
    rows, result = _run(spoilt)
    assert [k for k, row in enumerate(rows) if row.status == "skipped"] == [6, 7, 10]
    assert "black" in rows[6].reason
    assert "overexposed" in rows[7].reason
    assert "time stamp" in rows[10].reason
    assert len(result.warnings) == 3
    assert _room.position_error(result.trajectory, truth) < 0.01


def test_holes_in_depth(rgbd, truth):
    rng = np.random.default_rng(3)
    spoilt = []
    for frame in rgbd[:14]:
        holes = np.kron(rng.random((24, 32)), np.ones((10, 10))) < 0.9
        spoilt.append(dataclasses.replace(frame, depth=np.where(holes, 0, frame.depth).astype(np.float32)))
    rows, result = _run(spoilt)
    assert all(row.pose is not None for row in rows)
    assert _room.position_error(result.trajectory, truth) < 0.02


def test_depths_of_a_wrong_unit_are_told(rgbd):
    """Depths of ten times the unit lie beyond what is used; of a tenth of it they do not."""
    far = [dataclasses.replace(frame, depth=10.0 * frame.depth) for frame in rgbd[:3]]
    result = _run(far)[1]
    assert not len(result.trajectory)
    assert [warning for warning in result.warnings if warning.startswith("3 frames had depth of up to 6 m")]
    near = [dataclasses.replace(frame, depth=np.float32(0.1) * frame.depth) for frame in rgbd[:3]]
    assert not any("depth of up to" in warning for warning in _run(near)[1].warnings)


def test_frozen_and_missing_frames(rgbd, truth):
    frozen = [dataclasses.replace(rgbd[8], timestamp=frame.timestamp) if 8 <= k < 11 else frame
              for k, frame in enumerate(rgbd[:20])]  # fmt: skip
    rows, result = _run(frozen)
    assert all(row.pose is not None for row in rows)
    assert any("repeated" in sentence for sentence in result.warnings)
    rows, result = _run([*rgbd[:6], *rgbd[10:16]])
    assert all(row.pose is not None for row in rows)
    assert _room.position_error(result.trajectory, truth) < 0.01


def test_finds_its_place_again(rgbd, truth):
    """The camera is turned to the opposite wall, which was never seen, and back to a place seen before."""
    away = _room.poses(1)
    away[0, :4] = [0, 1, 0, 0]
    elsewhere = [
        dataclasses.replace(frame, timestamp=(14 + k) / 30.0)
        for k, frame in enumerate(_room.frames("rgbd", np.repeat(away, 3, axis=0)))
    ]
    back = [dataclasses.replace(rgbd[k], timestamp=(20 + k) / 30.0) for k in (5, 6, 7)]
    tracker = Tracker(_room.camera(), TrackOptions(num_points=250, num_features=500))
    for frame in rgbd[:14]:
        tracker.process(frame)
    assert {tracker.process(frame).status for frame in elsewhere} == {"lost"}
    found = tracker.process(back[0])
    assert found.status == "found"
    assert found.pose is not None
    expected = truth[5]
    assert np.abs(found.pose[4:] - expected[4:]).max() < 0.02
    assert tracker.process(back[1]).status == "tracked"
    tracker.finish()


def _turned(degrees: float, sideways: float = 0.0) -> np.ndarray:
    """cam_from_world of a camera turned to the side in the middle of the room."""
    twist = np.zeros((1, 6))
    twist[0, 4] = np.radians(degrees)
    world = se3.exp(twist)
    world[0, 4] = sideways
    return se3.inverse(world)[0]


def test_a_fast_turn_about_all_axes():
    """Up to 8 degrees from frame to frame, swinging back and forth: constant velocity predicts it wrongly each time."""
    time = np.arange(30)
    twist = np.zeros((30, 6))
    twist[:, 0] = 0.01 * time
    swing = np.clip((time - 4) / 6, 0, 1)
    twist[:, 4] = np.radians(10.0) * swing * np.sin(2 * np.pi * time / 8)
    twist[:, 3] = np.radians(4.0) * swing * np.sin(2 * np.pi * time / 11)
    twist[:, 5] = np.radians(4.0) * swing * np.sin(2 * np.pi * time / 13)
    poses = se3.inverse(se3.exp(twist))
    rows, result = _run(_room.frames("rgbd", poses))
    assert {row.status for row in rows} == {"tracked"}
    assert _room.position_error(result.trajectory, poses) < 0.01


def test_a_stereo_pair_turns():
    """A quarter turn at 5 degrees a frame while driving on: nothing of the first view is left at its end."""
    angle = np.concatenate([np.zeros(5), np.arange(0, 90, 5.0), np.full(5, 90.0)])
    poses = np.array([_turned(a, 0.02 * k) for k, a in enumerate(angle)])
    rows, result = _run(_room.frames("stereo", poses), _room.camera(_room.BASELINE))
    assert {row.status for row in rows} == {"tracked"}
    assert _room.position_error(result.trajectory, poses) < 0.03


def _to_the_opposite_wall() -> tuple[np.ndarray, np.ndarray]:
    """Poses that jump to a wall never seen, stay there until a new map is begun, and a way of turning back."""
    there = np.array(
        [_turned(1.5 * k, 0.02 * k) for k in range(10)] + [_turned(180, 0.1 + 0.01 * k) for k in range(24)]
    )
    back = np.array([_turned(180 - 9 * k, 0.3) for k in range(1, 20)] + [_turned(4 - 0.5 * k, 0.3) for k in range(8)])
    return there, back


def test_a_new_map_after_a_long_loss_is_joined_when_the_place_is_seen_again():
    poses = np.concatenate(_to_the_opposite_wall())
    rows, result = _run(_room.frames("rgbd", poses))
    statuses = [row.status for row in rows]
    lost = statuses.count("lost")
    # Half a second at thirty frames a second.
    assert 10 <= lost <= 18
    assert rows[9].submap == 0
    assert rows[-1].submap == 1
    assert result.submaps == ()
    assert len(result.trajectory) == len(poses) - lost
    assert _room.position_error(result.trajectory, poses) < 0.01
    assert any("lost" in sentence for sentence in result.warnings)
    assert any("Joined to an older map" in sentence for sentence in result.warnings)
    assert len(result.scene.images.names) == len(set(result.scene.images.names))


def test_maps_that_never_meet_stay_apart():
    poses = _to_the_opposite_wall()[0]
    rows, result = _run(_room.frames("rgbd", poses))
    lengths = sorted([len(result.trajectory), *(len(submap.trajectory) for submap in result.submaps)])
    assert len(lengths) == 2
    assert len(result.trajectory) == lengths[-1]
    assert sum(lengths) == sum(row.pose is not None for row in rows)
    for submap in (result, *result.submaps):
        assert _room.position_error(submap.trajectory, poses) < 0.01
        assert submap.scene.num_images == len(submap.keyframes) >= 1
    assert "Not joined" in result.warnings[-1]


def test_visiting_again_makes_few_keyframes(rgbd):
    """Back and forth over the same views: keyframes of the first visit stand for the later ones."""
    tracker = Tracker(_room.camera(), TrackOptions(num_points=250, num_features=500))
    counts, time = [], 0.0
    for order in (range(16), range(15, -1, -1), range(16)):
        for k in order:
            tracker.process(dataclasses.replace(rgbd[k], timestamp=time))
            time += 1 / 30
        counts.append(len(tracker.map.living()))
    tracker.finish()
    assert counts[2] <= 2 * counts[0]


def test_wrong_frames_are_errors(rgbd):
    tracker = Tracker(_room.camera())
    with pytest.raises(ShapeError, match="size of the camera"):
        tracker.process(dataclasses.replace(rgbd[0], gray=rgbd[0].gray[:100]))
    with pytest.raises(InputError, match="float32"):
        tracker.process(dataclasses.replace(rgbd[0], depth=rgbd[0].depth.astype(np.float64)))
    with pytest.raises(InputError, match="baseline"):
        tracker.process(dataclasses.replace(rgbd[0], depth=None, right=rgbd[0].gray))
    tracker.finish()
    with pytest.raises(InputError, match="finished"):
        tracker.process(rgbd[0])


def test_wrong_cameras_and_options_are_errors():
    with pytest.raises(InputError, match="undistorted"):
        Tracker(SequenceCamera("OPENCV", np.array([300, 300, 160, 120, 0.1, 0, 0, 0.0]), 320, 240))
    with pytest.raises(InputError, match="Nothing to track"):
        TrackOptions(points=False, lines=False, planes=False)
    with pytest.raises(InputError, match="window"):
        TrackOptions(window=1)


def test_a_track_without_frames():
    result = Tracker(_room.camera()).finish()
    assert len(result.trajectory) == 0
    assert result.scene.num_images == 0
    assert "No map" in result.warnings[-1]


@pytest.mark.parametrize("kind", ["rgbd", "stereo"])
def test_a_camera_at_rest_has_the_map_of_its_one_view(truth, kind):
    """Half a pixel of disparity at 2.5 units is 0.1 units, and depth is better; the first frame is the world."""
    frames = _room.frames(kind, np.repeat(truth[:1], 4, axis=0))
    _, result = _run(frames, _room.camera(_room.BASELINE) if kind == "stereo" else None)
    assert len(result.keyframes) == 1
    assert result.statistics["points"] == result.scene.num_points > 50
    assert any("one keyframe" in sentence for sentence in result.warnings)
    off_walls = np.abs(_room.ROOM - np.abs(result.scene.points.xyz)).min(axis=1)
    assert np.median(off_walls) < 0.1
