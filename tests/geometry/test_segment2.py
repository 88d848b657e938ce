# SPDX-License-Identifier: BSD-3-Clause
"""Covers image segments: lines from segments and back, clipping to an image, distances between two segments."""

import numpy as np
import pytest

from groma.errors import ShapeError
from groma.geometry import segment2


@pytest.fixture
def segments():
    return np.random.default_rng(11).uniform(0, 1000, (200, 4))


def homogeneous(points):
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)


def test_line_is_the_cross_product_of_the_end_points(segments):
    expected = np.cross(homogeneous(segments[:, :2]), homogeneous(segments[:, 2:]))
    expected /= np.linalg.norm(expected[:, :2], axis=1, keepdims=True)
    np.testing.assert_allclose(segment2.to_line(segments), expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(segment2.to_line(segment2.reverse(segments)), -segment2.to_line(segments), atol=1e-9)


def test_basic_numbers():
    segment = np.array([[0.0, 0, 3, 4], [2, 2, 2, 2]])
    np.testing.assert_allclose(segment2.length(segment), [5, 0])
    np.testing.assert_allclose(segment2.midpoint(segment), [[1.5, 2], [2, 2]])
    np.testing.assert_allclose(segment2.direction(segment), [[0.6, 0.8], [0, 0]])
    np.testing.assert_array_equal(segment2.to_line(segment)[1], [0, 0, 0])


def test_projection_onto_a_line(segments):
    line = np.random.default_rng(12).normal(size=(200, 3)) * [1, 1, 300]
    moved = segment2.project_onto_line(segments, line)
    for ends, before in ((moved[:, :2], segments[:, :2]), (moved[:, 2:], segments[:, 2:])):
        np.testing.assert_allclose(np.sum(line * homogeneous(ends), axis=1), 0.0, atol=1e-9)
        cross = (ends - before)[:, 0] * line[:, 1] - (ends - before)[:, 1] * line[:, 0]
        np.testing.assert_allclose(cross, 0.0, atol=1e-9)
    assert np.isnan(segment2.project_onto_line(segments[0], np.array([0.0, 0, 1]))).all()


def test_clipping_to_the_image(segments):
    line = segment2.to_line(segments)
    clipped, inside = segment2.clip_line(line, 1000.0, 1000.0)
    assert inside.all()
    np.testing.assert_allclose(segment2.to_line(clipped), line, atol=1e-6)
    assert (clipped > -1e-9).all() and (clipped < 1000 + 1e-9).all()
    on_border = (np.abs(clipped.reshape(-1, 2, 2)) < 1e-6) | (np.abs(clipped.reshape(-1, 2, 2) - 1000) < 1e-6)
    assert on_border.any(axis=-1).all()
    special = np.array([[1.0, 0, -10], [0, 1.0, 20], [1, 0, 0], [0, 0, 1.0], [0, 0, 0], [1, 1, 500]])
    clipped, inside = segment2.clip_line(special, 100.0, 50.0)
    np.testing.assert_array_equal(inside, [True, False, True, False, False, False])
    np.testing.assert_allclose(np.sort(clipped[0].reshape(2, 2), axis=0), [[10, 0], [10, 50]])
    assert np.isnan(clipped[~inside]).all()


def test_distances_by_hand():
    first, second = np.array([0.0, 1, 4, 1]), np.array([2.0, 0, 10, 0])
    assert segment2.angle(first, second) == 0.0
    assert segment2.angle(first, segment2.reverse(second)) == 0.0
    assert segment2.angle(first, segment2.reverse(second), oriented=True) == pytest.approx(np.pi)
    assert segment2.angle(first, np.array([0.0, 0, 1, 1])) == pytest.approx(np.pi / 4)
    np.testing.assert_allclose(segment2.perpendicular_distance(first, second), [1, 1])
    assert segment2.overlap(first, second) == pytest.approx(2.0)
    assert segment2.overlap(first, segment2.reverse(second)) == pytest.approx(2.0)
    assert segment2.overlap(np.array([-5.0, 3, 1, 3]), second) == 0.0
    assert segment2.midpoint_distance(first, second) == pytest.approx(np.hypot(4, 1))
    expected = 0.5 * (np.hypot(2, 1) + np.hypot(6, 1))
    assert segment2.endpoint_distance(first, second) == pytest.approx(expected)
    assert segment2.endpoint_distance(first, segment2.reverse(second)) == pytest.approx(expected)
    assert segment2.endpoint_distance(first, segment2.reverse(second), oriented=True) > expected


def test_segments_without_length():
    dot, segment = np.array([3.0, 4, 3, 4]), np.array([0.0, 0, 10, 0])
    assert segment2.angle(dot, segment) == 0.0 and segment2.overlap(segment, dot) == 0.0
    np.testing.assert_allclose(segment2.perpendicular_distance(segment[[0, 1, 0, 1]], dot), [5, 5])


def test_all_pairs_and_errors(segments):
    matrix = segment2.perpendicular_distance(segments[:5, None], segments[None, :7])
    assert matrix.shape == (5, 7, 2)
    np.testing.assert_allclose(matrix[2, 3], segment2.perpendicular_distance(segments[2], segments[3]))
    assert segment2.angle(segments[:5, None], segments[None, :7]).shape == (5, 7)
    with pytest.raises(ShapeError, match="segment must have shape"):
        segment2.length(np.zeros((3, 5)))


def test_segments_apart():
    first, second = np.array([[0.0, 1.0, 10.0, 3.0]]), np.array([[-5.0, 0.0, 20.0, 0.0], [50.0, 0.0, 60.0, 0.0]])
    assert segment2.segments_apart(first, second).tolist() == [[3.0, np.inf]]
