# SPDX-License-Identifier: BSD-3-Clause
"""Keyframes: each is another frame, whatever failed on the way; described features in all parts of an image."""

import math
from dataclasses import replace

import _room
import numpy as np
import pytest

from groma._stopwatch import Stopwatch
from groma.geometry import se3
from groma.tracking import Tracker, TrackOptions
from groma.tracking.backend.local_adjustment import window_job
from groma.tracking.backend.loop_closure import LoopSearch
from groma.tracking.backend.mapper import Mapper
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.features import Features, FrameFeatures, describe
from groma.tracking.frame.measurements import LineMeasurements, Measurements, PlaneMeasurements, PointMeasurements
from groma.tracking.map.culling import drop_unseen
from groma.tracking.map.landmarks import ALIVE, DEAD
from groma.tracking.map.map_scene import stacked
from groma.tracking.map.points import PointTracks, find_again
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.pose import following
from groma.tracking.pose.following import follow_frame
from groma.tracking.pose.verification import PoseVerification, misses_much

OPTIONS = TrackOptions(num_points=250, num_features=500)


def _wide(count: int) -> np.ndarray:
    """Steps of 12 degrees there and back, each other than the one before: constant velocity is wrong every time."""
    twist = np.zeros((count, 6))
    twist[:, 4] = np.radians(12.0) * np.array([0, 1, 3, 2, 0, 2, 1, 3, 4, 2, 3, 1])[:count]
    twist[:, 0] = 0.03 * np.arange(count)
    return se3.inverse(se3.exp(twist))


@pytest.mark.parametrize("kind", ["rgbd", "stereo"])
def test_each_keyframe_is_another_frame(kind, monkeypatch):
    """Frames are searched all the time, so that keyframes are made at once and again."""
    searched = []
    keep = Mapper.keep_present
    monkeypatch.setattr(Mapper, "keep_present", lambda self, *more: (searched.append(1), keep(self, *more)))
    monkeypatch.setattr(PoseVerification, "is_surprised", lambda self, *_: True)
    frames = _room.frames(kind, _wide(12))
    tracker = Tracker(_room.camera(_room.BASELINE if kind == "stereo" else None), OPTIONS)
    rows = [tracker.process(frame) for frame in frames]
    assert len(searched) >= 8
    assert {row.status for row in rows} <= {"tracked", "found"}
    times = [keyframe.timestamp for keyframe in tracker.map.keyframes]
    assert len(times) == len(set(times))
    result = tracker.finish()
    names = result.scene.images.names
    assert set(names) <= {frame.name for frame in frames}
    assert len(set(names)) == len(names)
    seen = result.scene.point_observations
    # A photograph shows a point once, and every point is seen in two photographs at least.
    pairs = np.column_stack([seen.image_idx, seen.point_idx])
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    assert np.bincount(pairs[:, 1], minlength=result.scene.num_points).min() >= 2
    assert _room.position_error(result.trajectory, _wide(12)) < 0.02


@pytest.mark.parametrize(("step", "calls"), [(1, 2), (12, 1)])
def test_where_most_points_are_gone_after_a_searched_frame_the_others_are_not_followed(step, calls, monkeypatch):
    asked, carry_on = [], following.follow_points
    monkeypatch.setattr(following, "follow_points", lambda *all: (asked.append(len(all[2])), carry_on(*all))[1])
    frames = _room.frames("rgbd", _room.poses(6 + step))
    tracker = Tracker(_room.camera(), OPTIONS)
    for frame in frames[:6]:
        tracker.process(frame)
    track_map, present = tracker.map, tracker._present
    data = FrameFeatures(frames[-1], TrackCamera.of(_room.camera()), OPTIONS)
    expected = present.pose, np.full(6, 0.1)
    given = track_map, present.data, data, present.followed, present.pose, expected, Stopwatch()
    whole, followed = follow_frame(*given)
    asked.clear()
    estimate, part = follow_frame(*given, searched=True)
    assert len(asked) == calls
    assert asked[0] == math.ceil(len(present.followed.points) / 4)
    if calls == 1:
        assert estimate is None or np.isin(part.points.index, present.followed.points.index[::4]).all()
    else:
        np.testing.assert_array_equal(estimate.pose, whole.pose)
        np.testing.assert_array_equal(part.points.index, followed.points.index)
    tracker.finish()


def test_what_is_worked_out_is_taken_up_before_a_frame_is_searched():
    """A frame that is a keyframe already is not made one again; its window is adjusted before the next is found."""
    tracker = Tracker(_room.camera(), OPTIONS)
    for frame in _room.frames("rgbd", _room.poses(14)):
        tracker.process(frame)
    assert tracker.map.keyframes  # what goes on behind the last frame is done
    mapper, present = tracker._mapper, tracker._present
    mapper.keep_present(present, Stopwatch())
    made = len(tracker.map.keyframes)
    assert present.data is not None and tracker.map.last.timestamp == present.data.frame.timestamp
    assert mapper.busy
    mapper.keep_present(present, Stopwatch())
    assert len(tracker.map.keyframes) == made
    assert not mapper.busy
    tracker.finish()


def test_a_window_is_adjusted_until_noise_moves_its_cost_as_much():
    """The next keyframe's window goes on; what is left open is less than noise leaves of a cost."""
    tracker = Tracker(_room.camera(), OPTIONS)
    for frame in _room.frames("rgbd", _wide(8)):
        tracker.process(frame)
    track_map = tracker.map
    track_map.last.pose[4:] += 0.05
    window = window_job(track_map, tracker.camera, OPTIONS.window, OPTIONS.relations, metric=True)
    assert window is not None
    whole = replace(window, function_tolerance=1e-3)
    reports = []
    for job in (window, whole):
        job.solve()
        assert job.report is not None
        reports.append(job.report)
    tracker.finish()
    ended, converged = reports
    assert ended.iterations < converged.iterations
    left = ended.final_cost - converged.final_cost
    deviation = np.sqrt(0.5 * (ended.num_residuals - ended.num_unknowns))
    assert left < deviation < 0.1 * ended.initial_cost


def test_keyframes_are_compared_by_what_stands_out_in_both():
    bits = np.random.default_rng(0).integers(0, 256, (300, 32)).astype(np.uint8)
    gates = replace(OPTIONS.gates, loops=replace(OPTIONS.gates.loops, voters=100, searched=1, min_matches=1))

    def seen(index: int, strength: np.ndarray) -> Keyframe:
        features = replace(Features.none(), descriptor=bits, response=strength)
        gray = np.zeros((1, 1), np.uint8)
        return Keyframe(index, 0.0, "", se3.identity(), gray, Measurements.empty(), features, np.zeros(1))

    strong, weak = np.arange(300.0), -np.arange(300.0)
    candidates = [seen(0, weak), seen(1, strong)]
    search = LoopSearch(seen(2, strong), candidates, gates)
    candidates[1].forget()  # as a keyframe that is dropped while other threads search
    assert [(keyframe.index, len(first)) for keyframe, first, _ in search.run()] == [(1, 300)]
    assert search.run()[0][0] is candidates[1]


@pytest.mark.parametrize(("rate", "frames"), [(10.0, 2), (30.0, 3), (60.0, 4)])
def test_a_keyframe_waits_for_its_features_by_the_clock_of_the_camera(rate, frames):
    """Two frames at least, and with 45 ms three at 30 frames a second and four at 60; nobody looks at another clock."""
    tracker = Tracker(_room.camera(), OPTIONS)
    made, chosen = [], []
    for k, frame in enumerate(_room.frames("rgbd", _room.poses(14, turn=0.04), rate)):
        if tracker.process(frame).keyframe and k:
            chosen.append(k)
        made.append(len(tracker.map.keyframes))  # waits for what goes on behind the answer
    assert chosen
    steps = np.flatnonzero(np.diff(made)) + 1
    # Behind the answer of the last of these frames, so that the one after it is followed with the keyframe.
    np.testing.assert_array_equal(steps, np.array(chosen)[: len(steps)] + frames - 1)
    assert len(steps) >= 1
    tracker.finish()


def test_features_are_described_in_all_parts_of_an_image():
    """Bars of high contrast on the left would take all features; what is on the right has a tenth of their contrast."""
    rng = np.random.default_rng(3)
    image = np.full((240, 320), 128.0)
    image[:, :100] = 60 + 140 * rng.integers(0, 2, (60, 25)).repeat(4, axis=0).repeat(4, axis=1)
    image[:, 120:] += 14 * rng.integers(-1, 2, (40, 34)).repeat(6, axis=0).repeat(6, axis=1)[:, :200]
    features = describe(image.astype(np.uint8), 300, lambda pixels: np.full(len(pixels), np.nan))
    assert 250 <= len(features.pixel) <= 310
    right = features.pixel[:, 0] > 120
    # Two thirds of the image are there; by contrast alone it would have none.
    assert right.mean() > 0.25
    columns, rows = (
        np.histogram(features.pixel[right, k], 4, limits)[0] for k, limits in ((0, (120, 320)), (1, (0, 240)))
    )
    assert columns.min() > 0 and rows.min() > 0


def test_points_that_are_not_found_are_looked_for_ever_more_rarely(monkeypatch):
    camera, track_map, gates = TrackCamera.of(_room.camera()), TrackMap(), OPTIONS.gates.points
    rows = track_map.points.extend(3)
    pixel = np.array([[60.0, 60.0], [120.0, 80.0], [200.0, 90.0]])
    track_map.points.xyz[rows], track_map.points.state[rows] = 2.0 * camera.bearings(pixel), ALIVE
    track_map.points.keyframe[rows], track_map.points.pixel[rows] = 0, pixel
    image, pose = np.zeros((camera.height, camera.width), np.uint8), se3.identity()
    track_map.keyframes.append(Keyframe(0, 0.0, "0", pose, image, Measurements.empty(), Features.none(), np.zeros(0)))
    asked = []

    def follow(_before, _now, _pixels, guesses, levels, max_shift):
        """Only the first is ever found."""
        asked.append(len(guesses))
        return guesses, guesses[:, 0] < 100

    monkeypatch.setattr("groma.tracking.map.points.follow", follow)
    for _ in range(gates.max_misses + 1):
        found = find_again(track_map, camera, image, pose, PointTracks.empty(), 10, gates)
        assert found.index.tolist() == [0]
    assert asked == [3, 3, 1, 3, 1, 1, 1, 3, 1, 1, 1, 1, 1]
    assert track_map.points.misses.tolist() == [0, 13, 13]
    drop_unseen(track_map, gates.max_misses)
    assert track_map.points.alive.tolist() == [True, False, False]


def test_measurements_of_keyframes_are_stacked_under_the_numbers_of_today():
    """Landmarks that are gone are left out; a plane that was merged twice has the number that is left."""
    track_map = TrackMap()
    track_map.points.extend(3)
    track_map.points.state[:] = [ALIVE, DEAD, ALIVE]
    track_map.planes.extend(4)
    track_map.planes.state[:] = [DEAD, DEAD, ALIVE, DEAD]
    track_map.planes.merged_into[:2] = [1, 2]

    def keyframe(points: list[int], planes: list[int]) -> Keyframe:
        one, two = np.zeros(len(points)), np.zeros((len(points), 2))
        measured = Measurements(
            PointMeasurements(np.array(points), two, one, one, one, two), LineMeasurements.empty(),
            PlaneMeasurements(np.array(planes), np.zeros((len(planes), 4)), np.zeros((len(planes), 3, 3))),
        )  # fmt: skip
        return Keyframe(0, 0.0, "", se3.identity(), np.zeros((0, 0), np.uint8), measured, Features.none(), np.zeros(0))

    measured, of, row = stacked(track_map, [keyframe([1, 2, 0], [2, 0]), keyframe([0, 1], [3, 1])])
    points = np.column_stack([measured.points.index, of["points"], row["points"]])
    assert points.tolist() == [[2, 0, 1], [0, 0, 2], [0, 1, 0]]
    planes = np.column_stack([measured.planes.index, of["planes"], row["planes"]])
    assert planes.tolist() == [[2, 0, 0], [2, 0, 1], [2, 1, 1]]
    assert len(measured.lines) == len(of["lines"]) == 0
    assert len(stacked(track_map, [])[0].points) == 0


def test_a_pose_that_most_points_do_not_agree_with_is_in_doubt():
    camera, track_map = TrackCamera.of(_room.camera()), TrackMap()
    rows = track_map.points.extend(40)
    pixel = np.random.default_rng(2).uniform(20, 220, (40, 2))
    track_map.points.xyz[rows] = 2.0 * camera.bearings(pixel)
    track_map.points.state[rows] = ALIVE
    before = PointTracks(rows, pixel)
    for agree, doubt in ((15, True), (25, False)):
        assert misses_much(track_map, camera, before, se3.identity(), agree, OPTIONS.gates) is doubt
    # Points that leave the view are not missed.
    away = se3.exp(np.array([[0, 0, 0, 0, 1.2, 0.0]]))[0]
    assert not misses_much(track_map, camera, before, away, 1, OPTIONS.gates)
