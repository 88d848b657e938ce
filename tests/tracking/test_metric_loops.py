# SPDX-License-Identifier: BSD-3-Clause
"""Loops of a stereo pair: weighed by what the features and the map know, on a rendered lap with a known path."""

import _room
import numpy as np
import pytest

from groma.geometry import se3
from groma.tracking import Tracker, TrackOptions
from groma.tracking.backend.loop_closure import agreeing_pose, search_for_loop
from groma.tracking.backend.metric_loops import adjusted_with
from groma.tracking.backend.place_again import KnownMap, PlaceAgain, measure_place
from groma.tracking.pose.relocalise import known_features

COUNT = 160
#: Few points, so that a lap of a few seconds drifts.
OPTIONS = {"num_points": 100, "lines": False, "planes": False}


@pytest.fixture(scope="module")
def lap():
    return _room.frames("stereo", _room.lap(COUNT))


@pytest.fixture(scope="module")
def drifted(lap) -> Tracker:
    """All frames tracked without loops, and nothing adjusted at the end."""
    return _track(lap, close_loops=False)


def _track(frames, **options) -> Tracker:
    tracker = Tracker(_room.camera(_room.BASELINE), TrackOptions(**OPTIONS, **options))
    for frame in frames:
        tracker.process(frame)
    return tracker


def _relative(first, second) -> np.ndarray:
    """True pose of a keyframe's camera in that of another (7,): second_from_first."""
    rows = [round(keyframe.timestamp * 30) for keyframe in (first, second)]
    poses = _room.lap(COUNT)[rows]
    return se3.compose(poses[1:], se3.inverse(poses[:1]))[0]


def _error(first, second, poses) -> np.ndarray:
    """Left twist (6,) from where one keyframe is in terms of another to where it should be."""
    found = se3.compose(poses[1][None], se3.inverse(poses[0][None]))
    return se3.log(se3.compose(_relative(first, second)[None], se3.inverse(found)))[0]


def _ends(tracker: Tracker):
    """A keyframe of the start, and the one that sees most of the same place a lap later."""
    living = tracker.map.living()
    first = living[1]
    world = se3.inverse(np.array([_relative(first, keyframe) for keyframe in living]))
    far = np.linalg.norm(world[:, 4:], axis=1)
    far[: len(living) // 2] = np.inf
    return first, living[int(far.argmin())]


def _place(tracker: Tracker, shift: float, sigma: float) -> PlaceAgain:
    """A place measured as it is, but for a shift along x, with so sure a pose (scene units, and a third in radians)."""
    first, last = _ends(tracker)
    pose = se3.compose(_relative(first, last)[None], first.pose[None])[0] + [0, 0, 0, 0, shift, 0, 0]
    covariance = np.diag([sigma**2] * 3 + [sigma**2 / 9] * 3 + [0.0])
    known = known_features(tracker.map, tracker.camera, [first])
    none = np.zeros((0, 2), np.int64)
    return PlaceAgain(first, last, pose, np.zeros(8), covariance, known, none, none)


def _after(tracker: Tracker, place: PlaceAgain) -> np.ndarray | None:
    """Error (6,) of the motion between both keyframes of a place, after the adjustment with it."""
    job = adjusted_with(tracker.map, tracker.camera, place, tracker.options)
    if job is None:
        return None
    living = tracker.map.living()
    poses = job.solved.variables["frames"].state
    rows = living.index(place.keyframe), living.index(place.newest)
    return _error(place.keyframe, place.newest, [poses[row] for row in rows])


def test_a_lap_is_closed(lap, drifted):
    result = _track(lap, close_loops=True).finish()
    assert result.statistics["loops"] > 0
    assert not drifted.map.loops
    before, after = (
        _room.position_error(found, _room.lap(COUNT)) for found in (drifted.trajectory(), result.trajectory)
    )
    assert before > 0.02
    assert after < 0.6 * before


def test_the_path_moves_as_far_as_the_loop_is_sure(drifted):
    first, last = _ends(drifted)
    before = np.linalg.norm(_error(first, last, [first.pose, last.pose])[:3])
    sure, unsure = (_after(drifted, _place(drifted, 0.0, sigma)) for sigma in (0.005, 50.0))
    assert before > 0.02
    assert np.linalg.norm(sure[:3]) < 0.01
    assert np.linalg.norm(unsure[:3]) > 0.5 * before


def test_another_place_that_looks_alike_is_left_out(drifted):
    """It would have to be two metres away; a loop that knows nothing contradicts nothing.

    A lap with so few points can be a metre off, by what it knows of itself.
    """
    assert _after(drifted, _place(drifted, 2.0, 0.005)) is None
    assert _after(drifted, _place(drifted, 2.0, 50.0)) is not None


def test_a_search_asks_the_map_as_it_was(drifted):
    """Matches agree on a pose, or not, whatever becomes of the map while other threads search."""
    track_map, camera, gates = drifted.map.copy(), drifted.camera, drifted.options.gates
    searches, expected = [], []
    for newest in track_map.living():
        search = search_for_loop(track_map, newest, gates)
        for keyframe, *matches in search.run() if search is not None else []:
            if agreeing_pose(track_map, camera, keyframe, newest, *matches, gates) is not None:
                expected.append((newest.index, keyframe.index))
        searches.append(search_for_loop(track_map, newest, gates, camera))
    assert expected
    track_map.points.xyz[:] = 0.0
    for keyframe in track_map.living():
        keyframe.pose = se3.identity()
    found = [(search.newest.index, pair[0].index) for search in searches if search is not None for pair in search.run()]
    assert found == expected


def test_deviations_of_places_are_those_of_their_errors(drifted):
    """Squared errors in variances are six on average, for keyframes that see the start again."""
    track_map, camera, options = drifted.map, drifted.camera, drifted.options
    known, squares = KnownMap(track_map, camera), []
    for newest in track_map.living():
        search = search_for_loop(track_map, newest, options.gates)
        for keyframe, *matches in search.run() if search is not None else []:
            place = measure_place(known, known, keyframe, newest, tuple(matches), options)
            if place is not None:
                error = _error(keyframe, newest, [keyframe.pose, place.pose])
                squares.append(error @ np.linalg.solve(place.covariance[:6, :6], error))
    assert len(squares) >= 3
    assert 1.0 < np.median(squares) < 18.0
