# SPDX-License-Identifier: BSD-3-Clause
"""Covers join and meet against homogeneous points and null spaces, the side operator, and pairs of lines in general,
crossing, parallel and identical position. Wrong printed forms are shown to fail."""

import numpy as np
import pytest

from groma.geometry import incidence, line3, plane3
from groma.geometry.incidence import LineRelation

COUNT = 200


@pytest.fixture
def rng():
    return np.random.default_rng(8)


def random_lines(rng, count=COUNT):
    return line3.from_points(rng.normal(size=(count, 3)), rng.normal(size=(count, 3)))


def crossing_lines(rng, count=COUNT):
    """Two lines through a common point: (first, second, point)."""
    point, one, two = rng.normal(size=(3, count, 3))
    return line3.from_point_and_direction(point, one), line3.from_point_and_direction(point, two), point


def proportional(first, second, tolerance=1e-9):
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    second = second / np.linalg.norm(second, axis=-1, keepdims=True)
    return np.minimum(np.linalg.norm(first - second, axis=-1), np.linalg.norm(first + second, axis=-1)) < tolerance


def null_vector(*rows):
    return np.linalg.svd(np.stack(rows, axis=-2))[2][..., -1, :]


def test_meet_of_line_and_plane_and_join_of_line_and_point(rng):
    a, b, plane, point = rng.normal(size=(4, COUNT, 4))
    line = line3.from_homogeneous_points(a, b)
    met = incidence.meet_line_plane(line, plane)
    np.testing.assert_allclose(met, np.einsum("nij,nj->ni", line3.primal_matrix(line), plane), atol=1e-13)
    value_a, value_b = np.sum(plane * a, axis=1, keepdims=True), np.sum(plane * b, axis=1, keepdims=True)
    np.testing.assert_allclose(met, value_a * b - value_b * a, atol=1e-12)  # the point of span(a, b) on the plane
    joined = incidence.join_line_point(line, point)
    np.testing.assert_allclose(joined, np.einsum("nij,nj->ni", line3.dual_matrix(line), point), atol=1e-13)
    assert proportional(joined, null_vector(a, b, point)).all()
    # eq. (50) and (53) as printed are the negatives
    n, w, d, m = plane[:, :3], plane[:, 3:], line[:, 3:], line[:, :3]
    np.testing.assert_allclose(np.cross(n, m) - w * d, -met[:, :3], atol=1e-13)
    X, W = point[:, :3], point[:, 3:]
    np.testing.assert_allclose(np.cross(X, d) - W * m, -joined[:, :3], atol=1e-13)


def test_dual_matrix_as_printed_gives_another_plane(rng):
    line, point = random_lines(rng), np.hstack([rng.normal(size=(COUNT, 3)), np.ones((COUNT, 1))])
    printed = np.cross(-line[:, 3:], point[:, :3]) + line[:, :3]
    right = incidence.join_line_point(line, point)
    assert not proportional(np.column_stack([printed, right[:, 3]]), right, 1e-3).any()


def test_three_points_and_three_planes(rng):
    a, b, c = rng.normal(size=(3, COUNT, 4))
    assert proportional(incidence.join_three_points(a, b, c), null_vector(a, b, c)).all()
    assert proportional(incidence.meet_three_planes(a, b, c), null_vector(a, b, c)).all()
    np.testing.assert_array_equal(incidence.join_points(a, b), line3.from_homogeneous_points(a, b))
    np.testing.assert_array_equal(incidence.meet_planes(a, b), line3.from_planes(a, b))


def test_homogeneous_answers_where_nothing_meets(rng):
    line = random_lines(rng)
    d, p = line[:, 3:], line3.foot_point(line)
    across = np.cross(d, rng.normal(size=(COUNT, 3)))
    holding = plane3.from_point_and_normal(p, across)
    np.testing.assert_allclose(incidence.meet_line_plane(line, holding), 0.0, atol=1e-12)
    parallel = holding + np.array([0, 0, 0, 1.0])
    met = incidence.meet_line_plane(line, parallel)
    np.testing.assert_allclose(met[:, :3], d, atol=1e-11)
    np.testing.assert_allclose(met[:, 3], 0.0, atol=1e-13)
    on_line = np.hstack([p, np.ones((COUNT, 1))])
    np.testing.assert_allclose(incidence.join_line_point(line, on_line), 0.0, atol=1e-12)
    assert np.isnan(incidence.dehomogenize(np.array([1.0, 2.0, 3.0, 0.0]))).all()
    np.testing.assert_allclose(incidence.dehomogenize(np.array([2.0, 4.0, 6.0, 2.0])), [1, 2, 3])


def test_side_is_the_determinant_and_the_plane_form(rng):
    a, b, c, d = rng.normal(size=(4, COUNT, 4))
    first, second = line3.from_homogeneous_points(a, b), line3.from_homogeneous_points(c, d)
    side = incidence.side(first, second)
    determinant = np.linalg.det(np.stack([a, b, c, d], axis=1))
    np.testing.assert_allclose(side, -determinant, atol=1e-12)  # W last: (40) with the opposite sign
    p, q = rng.normal(size=(2, COUNT, 4))
    expected = np.sum(p * a, 1) * np.sum(q * b, 1) - np.sum(q * a, 1) * np.sum(p * b, 1)  # (43)
    np.testing.assert_allclose(incidence.side(line3.from_planes(p, q), first), expected, atol=1e-12)


def test_side_is_positive_for_anticlockwise_passing():
    first = line3.from_points(np.zeros(3), np.array([0.0, 0, 1]))
    second = line3.from_point_and_direction(np.array([1.0, 0, 0]), np.array([0.0, 1, 0.3]))
    assert incidence.side(first, second) > 0 > incidence.side(first, -second)
    assert incidence.side(second, first) > 0


def test_skew_lines(rng):
    first, second = random_lines(rng), random_lines(rng)
    pair = incidence.closest_points(first, second)
    assert (pair.status == LineRelation.SKEW).all()
    np.testing.assert_allclose(line3.distance_to_point(first, pair.first), 0.0, atol=1e-9)
    np.testing.assert_allclose(line3.distance_to_point(second, pair.second), 0.0, atol=1e-9)
    gap = pair.second - pair.first
    for line in (first, second):
        np.testing.assert_allclose(np.sum(gap * line[:, 3:], axis=1), 0.0, atol=1e-9)
    np.testing.assert_allclose(pair.distance, np.linalg.norm(gap, axis=1), atol=1e-9)
    np.testing.assert_allclose(incidence.distance(second, first), pair.distance, atol=1e-12)
    common = pair.common_perpendicular
    assert line3.is_line(common).all()
    np.testing.assert_allclose(np.linalg.norm(common[:, 3:], axis=1), 1.0)
    np.testing.assert_allclose(np.sum(common[:, 3:] * gap, axis=1), pair.distance, atol=1e-9)
    for line in (first, second):
        crossed = incidence.closest_points(common, line)
        np.testing.assert_allclose(crossed.distance, 0.0, atol=1e-9)
        np.testing.assert_allclose(crossed.sine, 1.0, atol=1e-12)


def test_crossing_lines_and_the_closed_forms(rng):
    first, second, point = crossing_lines(rng)
    met = incidence.meet_lines(first, second, 1e-9)
    good = met.sine > 0.02
    assert good.sum() > 0.9 * COUNT
    assert (met.status[good] == LineRelation.CROSSING).all()
    np.testing.assert_allclose(met.point[good, :3], point[good], atol=1e-10)
    assert (met.point[good, 3] == 1.0).all()
    joined = incidence.join_lines(first, second)
    np.testing.assert_allclose(plane3.signed_distance(joined.plane, point), 0.0, atol=1e-10)
    np.testing.assert_allclose(plane3.signed_distance(joined.plane, point + first[:, 3:]), 0.0, atol=1e-10)
    np.testing.assert_allclose(plane3.signed_distance(joined.plane, point + second[:, 3:]), 0.0, atol=1e-10)
    m, d, m_hat, d_hat = first[:, :3], first[:, 3:], second[:, :3], second[:, 3:]
    w = np.sum(m * d_hat, axis=1, keepdims=True)
    np.testing.assert_allclose((np.cross(m, m_hat) / w)[good], point[good], rtol=1e-5, atol=1e-5)  # (47) corrected
    assert proportional(np.hstack([np.cross(d, d_hat), -w]), joined.plane, 1e-8).all()
    assert not proportional(np.hstack([np.cross(d, d_hat), w]), joined.plane, 1e-6).any()  # (45) printed
    printed = np.cross(m, m_hat) / np.sum(d * d_hat, axis=1, keepdims=True)  # (47) printed
    assert (np.linalg.norm(printed - point, axis=1) > 1e-3).mean() > 0.95


def test_common_perpendicular_of_crossing_lines_is_the_normal_in_their_point(rng):
    first, second, point = crossing_lines(rng)
    pair = incidence.closest_points(first, second)
    crossing = (pair.status == LineRelation.CROSSING) & (pair.sine > 0.02)
    assert crossing.sum() > 0.9 * COUNT
    np.testing.assert_allclose(line3.distance_to_point(pair.common_perpendicular, point)[crossing], 0.0, atol=1e-9)
    for line in (first, second):
        product = np.sum(pair.common_perpendicular[:, 3:] * line[:, 3:], axis=1)
        np.testing.assert_allclose(product, 0.0, atol=1e-12)


def test_broadcasting_and_empty(rng):
    line = random_lines(rng, 4)
    pair = incidence.closest_points(line[:, None], line[None])
    assert pair.first.shape == (4, 4, 3) and pair.common_perpendicular.shape == (4, 4, 6)
    assert (np.diag(pair.status) == LineRelation.IDENTICAL).all()
    assert incidence.meet_lines(line[:0], line[:0]).point.shape == (0, 4)
    assert incidence.join_lines(line[0], line[1]).plane.shape == (4,)
