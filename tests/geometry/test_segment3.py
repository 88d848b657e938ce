# SPDX-License-Identifier: BSD-3-Clause
"""Covers distances between segments in space: against minimisation and sampling, by hand, and at degeneracies."""

import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar

from groma.errors import InputError, ShapeError
from groma.geometry import segment3

FIRST = np.array([[0.0, 0, 1], [4, 0, 1]])
SECOND = np.array([[2.0, 0, 0], [10, 0, 0]])
DOT = np.array([[3.0, 4, 0], [3, 4, 0]])
DEPTHS = np.array([2.0, 5.0])
SYMMETRIC = [
    "angle",
    "angular_distance",
    "endpoint_distance",
    "midpoint_distance",
    "midpoint_perpendicular_distance",
    "perpendicular_distance",
    "line_distance",
    "nearest_distance",
    "mutual_overlap",
    "overlap_distance",
    "inner_segment_distance",
]


@pytest.fixture
def pairs():
    return np.random.default_rng(5).uniform(-2, 2, (2, 40, 2, 3))


def place(segment, t):
    return segment[0] + t * (segment[1] - segment[0])


def away(point, segment):
    """Distance from an infinite line, by its defining minimum."""
    return minimize_scalar(lambda t: np.sum((place(segment, t) - point) ** 2)).fun ** 0.5


def apart(first, second):
    """Distance of two infinite lines, by its defining minimum."""
    return minimize(lambda t: np.sum((place(first, t[0]) - place(second, t[1])) ** 2), [0.5, 0.5], tol=1e-12).fun ** 0.5


def moved(segment, *by):
    """A segment moved by a vector."""
    return segment + np.array(by)


def test_by_hand():
    assert segment3.angle(FIRST, SECOND) == segment3.angle(FIRST, SECOND[::-1]) == 0.0
    assert segment3.angle(FIRST, np.array([[0.0, 0, 0], [1, 0, 1]])) == pytest.approx(np.pi / 4)
    assert segment3.angular_distance(FIRST, np.array([[0.0, 0, 0], [1, 0, 1]])) == pytest.approx(1 - 0.5**0.5)
    assert segment3.endpoint_distance(FIRST, SECOND[::-1]) == pytest.approx(np.hypot(2, 1) + np.hypot(6, 1))
    assert segment3.midpoint_distance(FIRST, SECOND) == pytest.approx(np.hypot(4, 1))
    for name in ("midpoint_perpendicular_distance", "perpendicular_distance", "line_distance", "nearest_distance"):
        assert getattr(segment3, name)(FIRST, SECOND) == pytest.approx(1.0)
    assert segment3.overlap(FIRST, SECOND) == pytest.approx(2 / 8)
    assert segment3.overlap(SECOND, FIRST) == segment3.mutual_overlap(FIRST, SECOND) == pytest.approx(2 / 4)
    assert segment3.overlap_distance(FIRST, moved(SECOND, 10, 0, 0)) == pytest.approx(1 + 8 / 8)
    inner, exists = segment3.inner_segment(FIRST, SECOND)
    assert exists
    np.testing.assert_allclose(inner, [[2, 0, 0], [4, 0, 0]])
    assert segment3.inner_segment_distance(FIRST, SECOND) == pytest.approx(1.0)


def test_distances_are_the_minima_that_define_them(pairs):
    for first, second in pairs.swapaxes(0, 1)[:10]:
        there = [away(point, second) for point in first]
        back = [away(point, first) for point in second]
        assert segment3.perpendicular_distance(first, second, one_way=True) == pytest.approx(max(there), rel=1e-5)
        assert segment3.perpendicular_distance(first, second) == pytest.approx(max(there + back), rel=1e-5)
        middles = 0.5 * (away(first.mean(0), second) + away(second.mean(0), first))
        assert segment3.midpoint_perpendicular_distance(first, second) == pytest.approx(middles, rel=1e-5)
        assert segment3.line_distance(first, second) == pytest.approx(apart(first, second), abs=1e-5)
        nearest = min(
            min(away(place(one, t), two) for t in np.linspace(0, 1, 201))
            for one, two in ((first, second), (second, first))
        )
        found = float(segment3.nearest_distance(first, second))
        assert found <= nearest + 1e-5 and found == pytest.approx(nearest, abs=0.02)


def test_inner_segment_is_what_lies_between_the_planes(pairs):
    inner, exists = segment3.inner_segment(*pairs)
    assert 0 < exists.sum() < len(exists)
    t = np.linspace(0, 1, 401)[:, None, None]
    places = pairs[1, :, 0] + t * (pairs[1, :, 1] - pairs[1, :, 0])
    along = segment3.direction(pairs[0])
    height = np.einsum("tni,ni->tn", places - pairs[0, :, 0], along)
    between = (height >= 0) & (height <= segment3.length(pairs[0]))
    share = segment3.length(np.nan_to_num(inner)) / segment3.length(pairs[1])
    np.testing.assert_allclose(between.mean(0), share, atol=0.006)
    assert np.isnan(inner[~exists]).all() and np.isinf(segment3.inner_segment_distance(*pairs)[~exists]).all()


def test_functions_broadcast_and_are_symmetric(pairs):
    for name in SYMMETRIC:
        function = getattr(segment3, name)
        np.testing.assert_allclose(function(*pairs), function(*pairs[::-1]), err_msg=name)
        matrix = function(pairs[0, :4, None], pairs[1, None, :3])
        assert matrix.shape == (4, 3)
        np.testing.assert_allclose(matrix[2, 1], function(pairs[0, 2], pairs[1, 1]), err_msg=name)


def test_scale_invariant_distances_by_hand():
    assert segment3.scale_invariant_endpoint_distance(FIRST, SECOND, DEPTHS) == pytest.approx(
        max(np.hypot(2, 1) / 2, np.hypot(6, 1) / 5)
    )
    both = segment3.scale_invariant_endpoint_distance(FIRST, SECOND, DEPTHS, DEPTHS / 10)
    assert both == pytest.approx(np.hypot(6, 1) / 0.5)
    distance = segment3.scale_invariant_perpendicular_distance
    assert distance(FIRST, SECOND, DEPTHS, DEPTHS, one_way=True, own_depths=True) == pytest.approx(1 / 2)
    # At the feet x = 0 and 4 of the second, whose depth is 2 at x = 2 and 5 at 10.
    assert distance(FIRST, SECOND, DEPTHS, DEPTHS, one_way=True) == pytest.approx(1 / (2 - 0.75))
    assert distance(FIRST, moved(SECOND, -80, 0, 0), DEPTHS, DEPTHS[::-1], one_way=True) == np.inf  # depth below zero


def test_scale_invariant_line_distance_is_the_minimum_over_all_places(pairs):
    for first, second in pairs.swapaxes(0, 1)[:10]:
        t = np.tan(np.linspace(-1.57, 1.57, 200_001))[:, None]
        places, depth = first[0] + t * (first[1] - first[0]), DEPTHS[0] + t[:, 0] * (DEPTHS[1] - DEPTHS[0])
        across = np.linalg.norm(np.cross(places - second[0], segment3.direction(second)), axis=1)
        expected = (across / np.abs(depth)).min()
        assert segment3.scale_invariant_line_distance(first, second, DEPTHS) == pytest.approx(expected, rel=1e-3)
        least = min(
            segment3.scale_invariant_line_distance(first, second, DEPTHS),
            segment3.scale_invariant_line_distance(second, first, DEPTHS[::-1]),
        )
        assert segment3.scale_invariant_line_distance(first, second, DEPTHS, DEPTHS[::-1]) == least
    assert segment3.scale_invariant_line_distance(FIRST, SECOND, np.array([2.0, 2.0])) == pytest.approx(0.5)
    assert segment3.scale_invariant_line_distance(FIRST, SECOND, DEPTHS) == 0.0  # they meet at infinity


@pytest.mark.filterwarnings("error")
def test_degenerate_segments():
    upright = np.array([[3.0, 0, 2], [3, 0, 7]])
    assert segment3.angle(FIRST, upright) == pytest.approx(np.pi / 2)
    assert segment3.overlap(upright, FIRST) == 0.0
    np.testing.assert_allclose(segment3.inner_segment(FIRST, upright)[0], upright)  # between the planes, all of it
    assert not segment3.inner_segment(FIRST, moved(upright, 2, 0, 0))[1]
    assert not segment3.inner_segment(upright, FIRST)[1]  # in the plane below the first end
    for name in SYMMETRIC:
        for one, two in ((DOT, SECOND), (SECOND, DOT), (DOT, DOT), (FIRST, FIRST)):
            assert not np.isnan(getattr(segment3, name)(one, two)), name
    assert segment3.perpendicular_distance(SECOND, DOT, one_way=True) == pytest.approx(np.hypot(7, 4))
    assert segment3.line_distance(DOT, SECOND) == segment3.line_distance(SECOND, DOT) == pytest.approx(4.0)
    assert segment3.line_distance(DOT, DOT + 1) == pytest.approx(3**0.5)
    assert segment3.angle(DOT, FIRST) == segment3.overlap(FIRST, DOT) == 0.0
    nearly = moved(FIRST, [0, 0, 0], [0, 1e-13, 0])
    assert segment3.line_distance(moved(FIRST, 0, 0, 1), nearly) == pytest.approx(1.0)


def test_refused():
    with pytest.raises(ShapeError, match="first must have shape"):
        segment3.overlap(np.zeros((3, 6)), SECOND)
    with pytest.raises(InputError, match="first_depths must be positive"):
        segment3.scale_invariant_endpoint_distance(FIRST, SECOND, np.array([1.0, 0.0]))
