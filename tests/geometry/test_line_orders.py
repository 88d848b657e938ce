# SPDX-License-Identifier: BSD-3-Clause
"""Covers orders and signs of Plücker coordinates against minors of points and planes, and other libraries' lines."""

import numpy as np
import pytest

from groma.errors import InputError
from groma.geometry import line3, line_orders, quaternion

COUNT = 100
CYCLIC, LEXICOGRAPHIC = "01 02 03 23 31 12".split(), "01 02 03 12 13 23".split()


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def minors(a, b, pairs):
    return np.stack([a[:, int(i)] * b[:, int(j)] - a[:, int(j)] * b[:, int(i)] for i, j in pairs], axis=1)


@pytest.mark.parametrize("order", line_orders.ORDERS)
def test_orders_round_trip(rng, order):
    line = rng.normal(size=(COUNT, 6))
    np.testing.assert_array_equal(line_orders.from_order(line_orders.to_order(line, order), order), line)


def test_index_orders_are_minors_of_points(rng):
    a, b = rng.normal(size=(2, COUNT, 4))
    line = line3.from_homogeneous_points(a, b)
    aw, bw = line_orders.to_w_first(a), line_orders.to_w_first(b)
    for name, one, two, pairs in (
        ("w_first_cyclic", aw, bw, CYCLIC),
        ("w_first_lexicographic", aw, bw, LEXICOGRAPHIC),
        ("w_last_cyclic", a, b, CYCLIC),
        ("w_last_lexicographic", a, b, LEXICOGRAPHIC),
        ("direction_moment", a, b, "30 31 32 12 20 01".split()),  # eq. (28)
    ):
        np.testing.assert_allclose(line_orders.to_order(line, name), minors(one, two, pairs), atol=1e-14)


def test_dual_index_orders_are_minors_of_planes(rng):
    p, q = rng.normal(size=(2, COUNT, 4))
    line = line3.from_planes(p, q)
    first = minors(line_orders.to_w_first(p), line_orders.to_w_first(q), CYCLIC)
    np.testing.assert_allclose(line_orders.to_order(line, "w_first_dual_cyclic"), first, atol=1e-14)
    np.testing.assert_allclose(line_orders.to_order(line, "w_last_dual_cyclic"), minors(p, q, CYCLIC), atol=1e-14)


def test_opposite_moment_is_what_17_and_39_print(rng):
    p, d = rng.normal(size=(2, COUNT, 3))
    line = line3.from_point_and_direction(p, d)
    printed = line_orders.to_order(line, "opposite_moment_direction")
    np.testing.assert_allclose(printed[:, :3], np.cross(d, p))
    np.testing.assert_allclose(line_orders.to_order(line, "direction_opposite_moment")[:, 3:], np.cross(p + d, p))


def test_w_first_matrices_are_the_printed_ones(rng):
    a, b = rng.normal(size=(2, COUNT, 4))
    line = line3.from_homogeneous_points(a, b)
    l01, l02, l03, l12, l13, l23 = line_orders.to_order(line, "w_first_lexicographic").T
    zero = np.zeros(COUNT)
    eq23 = [[zero, -l01, -l02, -l03], [l01, zero, -l12, -l13], [l02, l12, zero, -l23], [l03, l13, l23, zero]]
    eq35 = [[zero, l23, -l13, l12], [-l23, zero, l03, -l02], [l13, -l03, zero, l01], [-l12, l02, -l01, zero]]
    primal = line_orders.matrix_to_w_first(line3.primal_matrix(line))
    np.testing.assert_allclose(primal, np.moveaxis(np.array(eq23), 2, 0), atol=1e-14)
    dual = line_orders.matrix_to_w_first(line3.dual_matrix(line))
    np.testing.assert_allclose(dual, -np.moveaxis(np.array(eq35), 2, 0), atol=1e-14)
    np.testing.assert_array_equal(line_orders.matrix_from_w_first(primal), line3.primal_matrix(line))
    np.testing.assert_array_equal(line_orders.from_w_first(line_orders.to_w_first(a)), a)


def special_lines(rng):
    """Random lines, and lines through the origin and along the axes."""
    line = line3.from_points(rng.normal(size=(COUNT, 3)), rng.normal(size=(COUNT, 3)))
    through = np.hstack([np.zeros((3, 3)), np.eye(3)])
    return np.concatenate([line, through, -through, through + 1e-300])


def test_limap_round_trips(rng):
    line = special_lines(rng)
    direction, moment = line_orders.to_limap(line)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0)
    assert line3.same_line(line_orders.from_limap(direction, moment), line, 1e-13, oriented=True).all()
    # InfiniteLine3d::point_projection(0) = d x m is the foot point
    np.testing.assert_allclose(np.cross(direction, moment), line3.foot_point(line), atol=1e-11)
    uvec, wvec = line_orders.to_limap_minimal(line)
    rotation = quaternion.to_matrix(uvec)
    np.testing.assert_allclose(rotation[:, :, 0], direction, atol=1e-13)
    np.testing.assert_allclose((wvec[:, 1] / wvec[:, 0])[:, None] * rotation[:, :, 1], moment, atol=1e-11)
    np.testing.assert_allclose(np.linalg.norm(wvec, axis=1), 1.0)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    assert line3.same_line(line_orders.from_limap_minimal(3 * uvec, wvec), line, 1e-12, oriented=True).all()


def test_spatialmath_g2o_gtsam(rng):
    p, d = rng.normal(size=(2, COUNT, 3))
    line = line3.from_point_and_direction(p, d)
    vector = line_orders.to_spatialmath(line)
    np.testing.assert_allclose(vector, np.hstack([np.cross(d, p), d]))  # Line3.PointDir
    np.testing.assert_allclose(
        np.cross(vector[:, :3], vector[:, 3:]) / np.sum(d * d, axis=1, keepdims=True),  # Line3.pp
        line3.foot_point(line),
        atol=1e-11,
    )
    np.testing.assert_array_equal(line_orders.from_spatialmath(vector), line)
    unit = d / np.linalg.norm(d, axis=1, keepdims=True)
    foot = p - unit * np.sum(unit * p, axis=1, keepdims=True)
    np.testing.assert_allclose(  # Line3D::fromCartesian
        line_orders.to_g2o(line), np.hstack([np.cross(foot, foot + unit), unit]), atol=1e-12
    )
    assert line3.same_line(line_orders.from_g2o(line_orders.to_g2o(line)), line, 1e-12, oriented=True).all()
    lines = special_lines(rng)
    rotation, a, b = line_orders.to_gtsam(lines)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    assert line3.same_line(line_orders.from_gtsam(rotation, a, b), lines, 1e-12, oriented=True).all()
    point = np.einsum("nij,nj->ni", rotation, np.stack([a, b, np.full(len(a), 0.7)], axis=1))  # Line3::point(0.7)
    np.testing.assert_allclose(line3.distance_to_point(lines, point), 0.0, atol=1e-11)
    projected = np.einsum("nij,nj->ni", rotation, np.stack([-b, a, 0 * a], axis=1))  # Line3::project
    np.testing.assert_allclose(projected, -line3.normalize(lines)[:, :3], atol=1e-11)


def test_lines_at_infinity_are_nan_elsewhere():
    line = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    for converted in (*line_orders.to_limap(line), *line_orders.to_limap_minimal(line), line_orders.to_g2o(line)):
        assert np.isnan(converted).all()
    assert all(np.isnan(part).all() for part in line_orders.to_gtsam(line))


def test_unknown_order_lists_the_known_ones():
    with pytest.raises(InputError, match="w_first_cyclic"):
        line_orders.to_order(np.zeros(6), "wrong")
