# SPDX-License-Identifier: BSD-3-Clause
"""Work that is done ahead or beside other work: the same result with it and without, and errors in their turn."""

import dataclasses
import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import _room
import numpy as np
import pytest

import groma
from groma.io.sequences import Sequence
from groma.tracking import Tracker, TrackOptions
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.sequence import TrackProgress

pytestmark = pytest.mark.filterwarnings("error")
OPTIONS = TrackOptions(num_points=250, num_features=500)


def _with_a_jump(kind: str) -> list:
    """Frames of which one step is so wide that the frame after it has to be searched."""
    poses = _room.poses(40)
    return _room.frames(kind, np.concatenate([poses[:9], poses[34:38]]))


def _tracked(frames, ahead: bool, **options):
    kind = "stereo" if frames[0].right is not None else "rgbd"
    camera = _room.camera(_room.BASELINE if kind == "stereo" else None)
    tracker = Tracker(camera, dataclasses.replace(OPTIONS, **options))
    following = [*frames[1:], None] if ahead else [None] * len(frames)
    rows = [tracker.process(*both) for both in zip(frames, following, strict=True)]
    return rows, tracker.finish()


@pytest.mark.parametrize("kind", ["rgbd", "stereo"])
def test_threads_and_frames_known_ahead_change_no_bit(kind):
    frames = _with_a_jump(kind)
    ways = [(False, False), (False, True), (True, True)] if kind == "rgbd" else [(False, False), (True, True)]
    (rows, alone), *others = [_tracked(frames, ahead, threaded=threaded) for ahead, threaded in ways]
    assert sum(row.keyframe for row in rows) >= 2
    assert any("find" in row.timings for row in rows)
    for other_rows, other in others:
        assert [row.status for row in other_rows] == [row.status for row in rows]
        assert all(np.array_equal(a.pose, b.pose) for a, b in zip(other_rows, rows, strict=True))
        np.testing.assert_array_equal(other.trajectory.world_from_cam, alone.trajectory.world_from_cam)
        np.testing.assert_array_equal(other.scene.points.xyz, alone.scene.points.xyz)
        np.testing.assert_array_equal(other.scene.lines.plucker, alone.scene.lines.plucker)
        np.testing.assert_array_equal(other.scene.planes.hesse, alone.scene.planes.hesse)


def test_a_frame_is_answered_while_the_map_is_at_work(monkeypatch):
    frames = _room.frames("rgbd", _room.poses(3))
    tracker = Tracker(_room.camera(), OPTIONS)
    advance, may_go_on, done = tracker._mapper.advance, threading.Event(), []

    def held_up(*given):
        assert may_go_on.wait(60.0)
        done.append(given)
        return advance(*given)

    monkeypatch.setattr(tracker._mapper, "advance", held_up)
    assert tracker.process(frames[0]).pose is not None
    assert not done
    threading.Timer(0.05, may_go_on.set).start()
    assert tracker.map.keyframes  # who asks for the map waits
    assert len(done) == 1
    tracker.process(frames[1])
    assert tracker.process(frames[2]).pose is not None  # and so does the next frame
    assert len(done) >= 2
    tracker.finish()


def test_an_error_behind_a_frame_is_raised_by_the_next(monkeypatch):
    frames = _room.frames("rgbd", _room.poses(3))
    tracker = Tracker(_room.camera(), OPTIONS)

    def fail(*given):
        raise ZeroDivisionError("behind")

    monkeypatch.setattr(tracker._mapper, "advance", fail)
    tracker.process(frames[0])
    with pytest.raises(ZeroDivisionError, match="behind"):
        tracker.process(frames[1])
    tracker.process(frames[2])
    result = tracker.finish()
    assert len(result.trajectory) == 2
    assert any("what followed the last frame" in warning and "behind" in warning for warning in result.warnings)


def test_another_frame_than_the_one_announced_is_tracked_as_it_is():
    frames = _room.frames("rgbd", _room.poses(7))
    tracker = Tracker(_room.camera(), OPTIONS)
    for frame, announced in [(frames[0], frames[4]), *pairwise(frames[1:])]:
        tracker.process(frame, announced)
    np.testing.assert_array_equal(
        tracker.finish().trajectory.world_from_cam, _tracked(frames[:6], ahead=False)[1].trajectory.world_from_cam
    )


def test_what_several_threads_ask_for_is_found_once(monkeypatch):
    frame = _room.frames("rgbd", _room.poses(1))[0]
    data = FrameFeatures(frame, TrackCamera.of(_room.camera()), OPTIONS)
    calls, ready = [], threading.Barrier(4)

    def counted(*given):
        calls.append(given)
        return find(*given)

    from groma.tracking.frame import features

    find = features.frame_planes
    monkeypatch.setattr(features, "frame_planes", counted)

    def ask(_):
        ready.wait()
        return data.planes

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(ask, range(4)))
    assert len(calls) == 1
    assert all(one is found[0] for one in found)


class _Breaks(Sequence):
    """A sequence whose fifth frame cannot be read."""

    def __init__(self, frames):
        self._frames = frames

    camera, kind, num_frames, reference, warnings = _room.camera(), "rgbd", None, None, ()

    def __iter__(self):
        yield from self._frames[:4]
        raise OSError("the fifth frame is damaged")


def test_a_frame_that_cannot_be_read_ends_the_track_in_its_turn():
    told: list[TrackProgress] = []
    with pytest.raises(OSError, match="fifth"):
        groma.track(_Breaks(_room.frames("rgbd", _room.poses(6))), OPTIONS, told.append)
    assert [event.done for event in told if event.frame] == [1, 2, 3, 4]
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("groma-read")]
