# SPDX-License-Identifier: BSD-3-Clause
"""Loops of a single camera are closed with their scale, and its maps are joined with theirs: on a rendered ring."""

import _room
import numpy as np
import pytest

from groma.geometry import se3, sim3
from groma.tracking import Tracker, TrackOptions
from groma.tracking.backend.loop_closure import move
from groma.tracking.backend.scaled_loops import close_scaled_loops
from groma.tracking.map.map_scene import stacked

#: Few points, so that a lap of a few seconds drifts.
FEW = {"num_points": 100, "lines": False}
COUNT = 160


@pytest.fixture(scope="module")
def ring():
    return _room.frames("mono", _room.lap(COUNT))


@pytest.fixture(scope="module")
def drifted(ring):
    """A finished track of the whole ring without loops, and what it found."""
    tracker = _track(ring, close_loops=False, **FEW)
    return tracker, tracker.finish()


def _track(frames, **options) -> Tracker:
    tracker = Tracker(_room.camera(), TrackOptions(**options))
    for frame in frames:
        tracker.process(frame)
    return tracker


@pytest.mark.slow
def test_a_lap_of_one_camera_is_closed_with_its_scale(ring, drifted):
    error = {}
    for close_loops, result in ((False, drifted[1]), (True, _track(ring, close_loops=True, **FEW).finish())):
        assert (result.statistics["loops"] > 0) == close_loops
        assert result.statistics["metric"] is False
        error[close_loops] = _room.position_error(result.trajectory, _room.lap(COUNT), scale=True)
    assert error[False] > 0.025
    assert error[True] < 0.6 * error[False]


def _drift(tracker: Tracker, growth: float) -> None:
    """Let the unit of length of a map change from keyframe to keyframe, by ``growth`` in its logarithm over all."""
    living = tracker.map.living()
    unit = np.exp(growth * np.linspace(0.0, 1.0, len(living)))
    world = se3.inverse(np.array([keyframe.pose for keyframe in living]))
    steps = np.diff(world[:, 4:], axis=0, prepend=world[:1, 4:] - world[:1, 4:])
    moved = np.column_stack([world[:, :4], np.cumsum(unit[:, None] * steps, axis=0), unit])
    move(tracker.map, living, sim3.inverse(moved))


@pytest.mark.parametrize("growth", [-0.5, 0.4])
def test_drift_of_scale_that_is_put_in_is_taken_out(drifted, growth):
    """All frames, those between keyframes too, go along."""
    tracker = drifted[0]
    mapper, kept = tracker._mapper, tracker.map.copy()
    before = _error(tracker)
    _drift(tracker, growth)
    without = _error(tracker)
    assert close_scaled_loops(tracker.map, tracker.camera, tracker.options) > 0
    after = _error(tracker)
    mapper.maps[0] = kept
    assert without > 2 * before
    assert after < 0.4 * without


def _error(tracker: Tracker) -> float:
    return _room.position_error(tracker.trajectory(), _room.lap(COUNT), scale=True)


def test_maps_of_one_camera_are_joined_with_their_scale(ring):
    """The camera is covered for half a second and more; the second map sees where the first began."""
    tracker = Tracker(_room.camera(), TrackOptions(num_points=250, num_features=500))
    rows = [tracker.process(frame) for k, frame in enumerate(ring) if not 60 <= k < 85]
    assert {row.submap for row in rows} == {0, 1}
    result = tracker.finish()
    assert result.submaps == ()
    assert result.statistics["maps_joined"] == 1
    # The first frame of each map is placed when the second keyframe is.
    _no_segment_tells_two_lines(tracker)
    assert len(result.trajectory) == sum(row.pose is not None for row in rows) + 2
    assert _room.position_error(result.trajectory, _room.lap(COUNT), scale=True) < 0.02


def _no_segment_tells_two_lines(tracker: Tracker) -> None:
    """Lines that were joined are measured once in each keyframe, and the oldest keyframes' lines are seen again."""
    ages = {}
    for keyframe in tracker.map.living():
        index = stacked(tracker.map, [keyframe])[0].lines.index
        assert len(np.unique(index)) == len(index)
        for line in index.tolist():
            ages.setdefault(line, []).append(keyframe.index)
    assert max(max(seen) - min(seen) for seen in ages.values()) > 15
