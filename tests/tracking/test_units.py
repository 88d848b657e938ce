# SPDX-License-Identifier: BSD-3-Clause
"""The unit of length of a map does not matter: of a pair it is that of its baseline."""

import numpy as np
import pytest
from _room import BASELINE, camera, frames, poses

from groma.geometry import se3
from groma.tracking import Tracker
from groma.tracking.map.landmarks import ALIVE
from groma.tracking.map.planes import merge_planes
from groma.tracking.map.relations import find_lines_on_planes
from groma.tracking.map.track_map import TrackMap
from groma.tracking.options import TrackOptions
from groma.tracking.pose.prediction import MotionModel

pytestmark = pytest.mark.kernels


def _tracked(unit: float) -> np.ndarray:
    options = TrackOptions(num_points=250, num_features=500, lines=False, threaded=False)
    tracker = Tracker(camera(unit * BASELINE), options)
    found = np.array([tracker.process(frame).pose for frame in frames("stereo", poses(8))])
    return found / np.repeat([1.0, unit], (4, 3))


def test_a_pair_in_other_units_has_the_same_path():
    """By rounding alone: no length that is compared with a number may have a say."""
    np.testing.assert_allclose(_tracked(1000.0), _tracked(1.0), atol=1e-9)


def test_errors_of_predictions_count_in_depths():
    sigmas = []
    for unit in (1.0, 10.0):
        model, pose = MotionModel(), se3.identity()
        for k in range(3):
            model.predict(pose, 0.1 * k, 2.0 * unit)
            before, pose = pose, se3.exp(np.array([[0.1 * unit * k**2, 0, 0, 0, 0.01 * k, 0]]))[0]
            model.update(before, pose, 0.1 * k)
        sigmas.append(model.predict(pose, 0.3, 2.0 * unit)[1] / np.repeat([unit, 1.0], 3))
    np.testing.assert_allclose(*sigmas)


def test_lines_on_planes_of_landmarks_stay_there():
    """Such planes come from maps without depth images, whose unit is arbitrary, and have no samples."""
    track_map = TrackMap()
    lines, planes = track_map.lines, track_map.planes
    rows, found = lines.extend(2), planes.extend(2)
    lines.state[rows] = planes.state[found] = ALIVE
    lines.segment[rows], planes.hesse[found] = [[[0, 0, 1], [1, 0, 1]]] * 2, [[0, 0, 1, -1]] * 2
    lines.plane[rows] = [0, -1]
    merge_planes(planes)
    find_lines_on_planes(track_map)
    assert lines.plane.tolist() == [0, -1]
    assert planes.alive.all()
