# SPDX-License-Identifier: BSD-3-Clause
"""Covers planes fitted again to members that deviate from them: a rough wall, a flat one, and lines on a wall."""

import numpy as np
import pytest

from groma.estimators.plane_search import PlaneSet
from groma.gates import chi_square_gate
from groma.mapping.noise.landmarks import LineNoise, PointNoise
from groma.mapping.structure.relations import Landmarks, on_planes, spacings
from groma.mapping.structure.rough_planes import on_fitted_planes
from groma.scene import LineIntervals

SIGMA, LEVEL, LEAST, SUPPORT = 0.002, 0.99, (0.7, 0.9), 20
#: Of the plane that the search found: it cuts through the wall.
TILT = 0.004


def wall(deviation, num_points=400, num_lines=40):
    """Landmarks on the plane z = 0, each off by its noise and by how rough the wall is."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-2.0, 2.0, (num_points, 2)), np.zeros(num_points)])
    start = np.column_stack([rng.uniform(-1.5, 1.5, (num_lines, 2)), np.zeros(num_lines)])
    segments = np.stack([start, start + np.array([0.5, 0.0, 0.0])], axis=1)
    points += SIGMA * rng.standard_normal(points.shape)
    points[:, 2] += deviation * rng.standard_normal(num_points)
    segments[..., 1:] += SIGMA * rng.standard_normal((num_lines, 2, 2))
    segments[..., 2] += deviation * rng.standard_normal((num_lines, 1))
    across = np.broadcast_to(np.eye(3)[1:], (num_lines, 2, 3)).copy()
    lines = LineNoise(across, np.broadcast_to(SIGMA**2 * np.eye(4), (num_lines, 4, 4)).copy(), np.ones(num_lines), 0.1)
    return Landmarks(
        points,
        PointNoise(np.broadcast_to(SIGMA**2 * np.eye(3), (num_points, 3, 3)).copy(), np.ones(num_points), 0.1),
        np.ones(num_points, bool),
        segments,
        lines,
        lines,
        np.ones(num_lines, bool),
        *spacings(points, segments),
        LineIntervals(),
        np.full(num_points, 0.01),
        np.full(num_lines, 0.01),
    )


def found_in(marks, tilt):
    """A plane through the middle of the wall, as known as the noise of a few hundred flat features allows."""
    plane = np.array([[np.sin(tilt), 0.0, np.cos(tilt), 0.0]])
    covariance = np.diag([SIGMA**2, SIGMA**2, 0.0, SIGMA**2])[None] / 200
    labels = np.full(len(marks.points), -1), np.full(len(marks.segments), -1)
    numbers = np.array([200]), np.ones(1), np.full(1, 4 * SIGMA), np.full(1, -9.0)
    return PlaneSet(plane, covariance, *numbers, *labels, [marks.points])


def off(planes):
    """Squared distance of the plane from z = 0, in the coordinates that are free, by its covariance."""
    moved, free = planes.planes[0] - [0.0, 0.0, 1.0, 0.0], [0, 1, 3]
    return float(moved[free] @ np.linalg.solve(planes.covariance[0][np.ix_(free, free)], moved[free]))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_plane_that_cuts_through_a_rough_wall_becomes_that_of_the_wall(sign):
    marks = wall(0.004)
    cut = found_in(marks, sign * TILT)
    before = on_planes(marks, cut, LEVEL, LEAST)
    fitted, points, lines = on_fitted_planes(marks, cut, LEVEL, LEAST, SUPPORT)
    assert off(cut) > chi_square_gate(1e-6, 3)
    assert off(fitted) < chi_square_gate(0.001, 3)
    # 0.4 pixels; around the plane that was found members seem to deviate more. Deviations are tried in steps of 1.4.
    assert 0.4 / 1.2 < points.deviation.max() < 0.4 * 1.2 < before[0].deviation.max()
    # One of a hundred fails the test of a member; more than three of 40 do with a probability of a thousandth.
    assert len(lines.pairs) >= 37
    np.testing.assert_array_equal(cut.planes[0, :3], found_in(marks, sign * TILT).planes[0, :3])  # not changed


def test_a_flat_wall_keeps_its_plane():
    marks = wall(0.0)
    flat = found_in(marks, 0.0)
    fitted, points, lines = on_fitted_planes(marks, flat, LEVEL, LEAST, SUPPORT)
    assert fitted is flat
    for one, other in zip((points, lines), on_planes(marks, flat, LEVEL, LEAST), strict=True):
        np.testing.assert_array_equal(one.pairs, other.pairs)
        np.testing.assert_array_equal(one.probability, other.probability)


def test_a_plane_of_few_members_stays():
    marks = wall(0.004)
    cut = found_in(marks, TILT)
    many = len(marks.points) + 2 * len(marks.segments) + 1
    assert on_fitted_planes(marks, cut, LEVEL, LEAST, many)[0] is cut


def test_no_planes():
    marks = wall(0.0)
    none = PlaneSet(np.zeros((0, 4)), np.zeros((0, 4, 4)), *np.zeros((4, 0)), np.full(400, -1), np.full(40, -1))
    planes, points, lines = on_fitted_planes(marks, none, LEVEL, LEAST, SUPPORT)
    assert len(planes) == len(points.pairs) == len(lines.pairs) == 0
