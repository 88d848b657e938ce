# SPDX-License-Identifier: BSD-3-Clause
"""The end of a track: maps joined by value, steps that fail or are interrupted, and what is told and written then."""

import dataclasses
import json

import _room
import numpy as np
import pytest

import groma
from groma.evaluation.trajectory import score_trajectory
from groma.geometry import se3
from groma.io import read_scene
from groma.io.sequences import Frame, SequenceCamera
from groma.io.sequences.frame import Kind
from groma.io.trajectories import Trajectory, read_tum
from groma.solver.report import SolveReport
from groma.solver.termination import Termination
from groma.tracking import Tracker, TrackOptions
from groma.tracking.backend.mapper import Mapper
from groma.tracking.backend.submaps import Joint, PlacedMaps, joined_map
from groma.tracking.ending import Ending
from groma.tracking.frame.features import Features
from groma.tracking.frame.measurements import Measurements, PointMeasurements
from groma.tracking.map.landmarks import ALIVE
from groma.tracking.map.track_map import Keyframe, TrackMap

COUNT = 18
OPTIONS = TrackOptions(num_points=250, num_features=500, lines=False)


def _map(shift: float, count: int = 6) -> TrackMap:
    """Two keyframes that share one features object, and points that all of them see; its world is moved along x."""
    rng = np.random.default_rng(4)
    track_map = TrackMap()
    rows = track_map.points.extend(count)
    track_map.points.xyz[rows] = rng.uniform(-1, 1, (count, 3)) + np.array([shift, 0, 4])
    track_map.points.state[rows] = ALIVE
    track_map.points.keyframe[rows] = track_map.points.first_keyframe[rows] = 0
    pixel, unknown = rng.uniform(0, 200, (count, 2)), np.full(count, np.nan)
    descriptor = rng.integers(0, 256, (count, 32)).astype(np.uint8)
    features = Features(pixel, np.ones(count), np.ones(count), descriptor, np.ones(count), rows)
    for index in range(2):
        points = PointMeasurements(rows, pixel, np.ones(count), unknown, unknown, unknown)
        measured = dataclasses.replace(Measurements.empty(), points=points)
        pose = np.array([0, 0, 0, 1, -shift - 0.1 * index, 0, 0.0])
        track_map.keyframes.append(Keyframe(index, float(index), "", pose, None, measured, features, np.zeros(0)))
    return track_map


def _state(track_map: TrackMap) -> list[np.ndarray]:
    out = [track_map.points.xyz, track_map.points.state, track_map.points.keyframe]
    for keyframe in track_map.keyframes:
        out += [keyframe.pose, keyframe.features.point, keyframe.measured.points.index, np.array(keyframe.index)]
    return [np.array(array) for array in out]


def test_joining_maps_changes_neither_of_them_and_shifts_shared_features_once():
    one, two = _map(0.0), _map(3.0)
    before = [*_state(one), *_state(two)]
    there = np.array([0, 0, 0, 1, -3.0, 0, 0, 1])
    for _ in range(2):
        joined = joined_map(one, two, there)
        np.testing.assert_allclose(joined.points.xyz[6:], one.points.xyz, atol=1e-12)
        for old, new in zip(one.keyframes, joined.keyframes[2:], strict=True):
            np.testing.assert_allclose(new.pose, old.pose, atol=1e-12)
            assert new.features.point.tolist() == new.measured.points.index.tolist() == [6, 7, 8, 9, 10, 11]
            assert new.index == old.index + 2
    for was, now in zip(before, [*_state(one), *_state(two)], strict=True):
        np.testing.assert_array_equal(was, now)
    with pytest.raises(ValueError, match="read-only"):
        one.keyframes[0].features.point[:] = 1


def _joint(older: int, newer: int) -> Joint:
    same = np.arange(6)
    return Joint(older, 0, newer, 0, np.array([0, 0, 0, 1, 0, 0, 0.0, 1]), same, same)


@pytest.mark.parametrize("order", [[(0, 1), (0, 2)], [(1, 2), (0, 2)], [(0, 2), (1, 2)], [(0, 1), (1, 2), (0, 2)]])
def test_maps_are_joined_whichever_of_them_met(order):
    maps = [_map(shift) for shift in (0.0, 3.0, -5.0)]
    places = PlacedMaps.apart(maps)
    for older, newer in order:
        places = places.joined(_joint(older, newer))
    assert [root for root, _ in places.where] == [0, 0, 0]
    assert sorted(shift for _, shift in places.where) == [0, 2, 4]
    whole = places.maps[0]
    # All three saw the same six points; each is in the map once, where the oldest has it, and all keyframes see it.
    assert whole.points.alive.sum() == 6
    np.testing.assert_allclose(whole.points.xyz[whole.points.alive], maps[0].points.xyz, atol=1e-12)
    alive = np.flatnonzero(whole.points.alive)
    for keyframe in whole.keyframes:
        assert sorted(keyframe.measured.points.index) == alive.tolist()
        assert sorted(keyframe.features.point) == alive.tolist()
    assert len(whole.loops) == len(order)


def _tracked(count: int) -> Tracker:
    tracker = Tracker(_room.camera(), OPTIONS)
    for frame in _room.frames("rgbd", _room.poses(count)):
        tracker.process(frame)
    return tracker


@pytest.mark.parametrize("error", [RuntimeError("out of luck"), KeyboardInterrupt()])
@pytest.mark.parametrize("step", ["make_keyframe", "take_up", "adjust_at_end"])
def test_a_step_that_fails_at_the_end_is_told_and_left_out(monkeypatch, step, error):
    tracker = _tracked(COUNT)
    poses = tracker.trajectory()

    def failing(self, *_arguments, **_more):
        # Half done when it fails.
        self.map.points.xyz[:] = np.nan
        self.map.keyframes[-1].pose[:] = np.nan
        raise error

    present = tracker._present
    if step == "make_keyframe" and tracker._mapper.due is None:
        assert present.data is not None
        tracker._mapper.choose(present, present.data)
    monkeypatch.setattr(Mapper, step, failing)
    result = tracker.finish()
    assert len(result.trajectory) == COUNT
    assert np.isfinite(result.scene.points.xyz).all() and result.scene.num_points > 20
    assert _room.position_error(result.trajectory, _room.poses(COUNT)) < 0.02
    if step == "adjust_at_end":
        np.testing.assert_allclose(result.trajectory.timestamps, poses.timestamps)
    told = [sentence for sentence in result.warnings if "at the end of the track" in sentence]
    assert len(told) == 1
    assert ("Interrupted" if isinstance(error, KeyboardInterrupt) else "out of luck") in told[0]


def test_an_adjustment_that_does_not_converge_is_told(monkeypatch):
    tracker = _tracked(4)
    report = SolveReport(termination=Termination.MAX_ITERATIONS, iterations=15)
    monkeypatch.setattr(Mapper, "adjust_at_end", lambda self, part: (report, self.right.turn))
    assert any("did not converge in 15 steps" in sentence for sentence in tracker.finish().warnings)


@dataclasses.dataclass
class _Rendered:
    """A sequence in memory."""

    frames: list[Frame]
    camera: SequenceCamera = dataclasses.field(default_factory=_room.camera)
    kind: Kind = "rgbd"
    reference: Trajectory | None = None
    warnings: list[str] = dataclasses.field(default_factory=list)
    num_frames: int | None = None

    def __iter__(self):
        return iter(self.frames)


def test_a_report_that_fails_loses_nothing_else(monkeypatch, tmp_path):
    result = groma.track(_Rendered(_room.frames("rgbd", _room.poses(6))), OPTIONS)

    def failing(*_arguments, **_more):
        raise RuntimeError("no ink")

    monkeypatch.setattr("groma.tracking.sequence.write_track_report", failing)
    told = result.write(tmp_path / "out")
    assert len(told) == 1 and "report.html" in told[0] and "no ink" in told[0]
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 6
    assert read_scene(tmp_path / "out").num_images == read_scene(tmp_path / "out" / "scene.npz").num_images
    assert told[0] in json.loads((tmp_path / "out" / "summary.json").read_text())["warnings"]


def test_frames_without_a_pose_are_named():
    frames = _room.frames("rgbd", _room.poses(8))
    frames[5] = dataclasses.replace(frames[5], gray=np.full_like(frames[5].gray, 90))
    result = groma.track(_Rendered(frames), OPTIONS)
    assert result.summary()["frames_without_pose"] == ["0005.png"]
    assert any("No pose: 1 frame of 8: 0005.png." in sentence for sentence in result.warnings)


def test_the_first_frame_of_one_camera_is_not_named_once_it_has_a_pose():
    frames = _room.frames("mono", _room.poses(14))
    result = groma.track(_Rendered(frames, kind="mono"), OPTIONS)
    with_pose = set(result.trajectory.timestamps.tolist())
    assert result.frames[0].pose is None and frames[0].timestamp in with_pose
    without = [frame.name for frame in frames if frame.timestamp not in with_pose]
    assert without and result.summary()["frames_without_pose"] == without


def _turned(degrees: float, sideways: float) -> np.ndarray:
    twist = np.zeros((1, 6))
    twist[0, 4] = np.radians(degrees)
    world = se3.exp(twist)
    world[0, 4] = sideways
    return se3.inverse(world)[0]


def test_maps_are_joined_at_the_end_where_they_saw_the_same_place(monkeypatch):
    """While tracking no place is looked for: the camera jumps to the opposite wall, and turns back."""
    monkeypatch.setattr(Mapper, "_what_to_search", lambda self: None)
    poses = [_turned(1.5 * k, 0.02 * k) for k in range(10)] + [_turned(180, 0.1 + 0.01 * k) for k in range(20)]
    poses = np.array(poses + [_turned(180 - 9 * k, 0.3) for k in range(1, 20)])
    tracker = Tracker(_room.camera(), OPTIONS)
    rows = [tracker.process(frame) for frame in _room.frames("rgbd", poses)]
    assert {row.submap for row in rows} == {0, 1}
    result = tracker.finish()
    assert result.submaps == ()
    assert len(result.trajectory) == sum(row.pose is not None for row in rows)
    truth = Trajectory(np.arange(len(poses)) / 30.0, se3.inverse(poses))
    assert score_trajectory(result.trajectory, truth, max_time_difference=0.001).ate.rmse < 0.02


def test_only_the_maps_that_a_step_changes_are_copied():
    tracker = _tracked(2)
    mapper = tracker._mapper
    mapper.maps, ending = [_map(0.0), _map(3.0), _map(-5.0)], Ending(mapper, tracker._history)
    before, held = list(mapper.maps), [_state(track_map) for track_map in mapper.maps]

    def failing():
        mapper.maps[1].points.xyz[:] = np.nan
        mapper.current = 1
        raise RuntimeError("half done")

    assert ending.attempt("a step", failing, "left out", changes=(1,)) == "left out"
    assert mapper.current == 0
    assert [now is was for now, was in zip(mapper.maps, before, strict=True)] == [True, False, True]
    for was, track_map in zip(held, mapper.maps, strict=True):
        for one, two in zip(was, _state(track_map), strict=True):
            np.testing.assert_array_equal(one, two)
