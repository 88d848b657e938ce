# SPDX-License-Identifier: BSD-3-Clause
"""Covers lines: construction against points and planes, Plücker matrices and their identities, validity, distances.

Printed forms of the source notes that are wrong are shown to fail. Tolerances: rounding of float64 at numbers of about
one, 1e-12 or better, unless said.
"""

import numpy as np
import pytest

from groma.errors import InputError, ShapeError
from groma.geometry import line3
from groma.geometry.so3 import hat

COUNT = 200


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def homogeneous(points):
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)


def random_lines(rng, count=COUNT):
    return line3.from_points(rng.normal(size=(count, 3)), rng.normal(size=(count, 3)))


def planes_through(rng, *points):
    """Planes that hold the given homogeneous points, from the null space: no groma formula takes part."""
    matrix = np.stack(points, axis=-2)
    basis = np.linalg.svd(matrix)[2][..., matrix.shape[-2] :, :]
    weights = rng.normal(size=(*basis.shape[:-2], 1, basis.shape[-2]))
    return (weights @ basis)[..., 0, :]


def test_points_give_moment_and_direction_in_three_ways(rng):
    a, b = rng.normal(size=(2, COUNT, 3))
    line = line3.from_points(a, b)
    np.testing.assert_allclose(line, line3.from_homogeneous_points(homogeneous(a), homogeneous(b)), atol=1e-12)
    np.testing.assert_allclose(line, line3.from_point_and_direction(b, b - a), atol=1e-12)
    np.testing.assert_allclose(line3.moment(line), np.cross(a, b), atol=1e-12)
    np.testing.assert_allclose(line3.direction(line), b - a)
    # eq. (17) as printed has the opposite moment
    assert not np.isclose(line3.moment(line), np.cross(b - a, a), atol=0.1).all(axis=1).any()


def test_minors_of_the_point_matrix_are_the_coordinates(rng):
    a, b = rng.normal(size=(2, COUNT, 4))
    line = line3.from_homogeneous_points(a, b)

    def minor(i, j):  # eq. (9), the index W is 3
        return a[:, i] * b[:, j] - a[:, j] * b[:, i]

    expected = np.stack([minor(1, 2), minor(2, 0), minor(0, 1), minor(3, 0), minor(3, 1), minor(3, 2)], axis=1)
    np.testing.assert_allclose(line, expected, atol=1e-14)


def test_planes_give_the_line_of_their_common_points(rng):
    a, b = rng.normal(size=(2, COUNT, 4))
    first, second = planes_through(rng, a, b), planes_through(rng, a, b)
    line = line3.from_planes(first, second)
    assert line3.same_line(line, line3.from_homogeneous_points(a, b), tolerance=1e-9).all()
    unit = [plane / np.linalg.norm(plane[:, :3], axis=1, keepdims=True) for plane in (first, second)]
    angle = np.arccos(np.clip(np.sum(unit[0][:, :3] * unit[1][:, :3], axis=1), -1, 1))
    sine = np.linalg.norm(line3.direction(line3.from_planes(*unit)), axis=1)
    np.testing.assert_allclose(sine, np.sin(angle), atol=1e-7)


def test_primal_matrix_is_the_point_form_and_dual_the_plane_form(rng):
    a, b = rng.normal(size=(2, COUNT, 4))
    line = line3.from_homogeneous_points(a, b)
    outer = b[:, :, None] * a[:, None, :] - a[:, :, None] * b[:, None, :]
    np.testing.assert_allclose(line3.primal_matrix(line), outer, atol=1e-14)
    p, q = rng.normal(size=(2, COUNT, 4))
    outer = q[:, :, None] * p[:, None, :] - p[:, :, None] * q[:, None, :]
    np.testing.assert_allclose(line3.dual_matrix(line3.from_planes(p, q)), outer, atol=1e-14)


def test_matrices_round_trip_and_have_rank_two(rng):
    line = random_lines(rng)
    primal, dual = line3.primal_matrix(line), line3.dual_matrix(line)
    np.testing.assert_array_equal(line3.from_primal_matrix(primal), line)
    np.testing.assert_array_equal(line3.from_dual_matrix(dual), line)
    for matrix in (primal, dual):
        values = np.linalg.svd(matrix, compute_uv=False)
        assert (values[:, 2] < 1e-12).all() and (values[:, 1] > 1e-3).all()


def test_determinant_and_product_of_any_six_vector(rng):
    vector = rng.normal(size=(COUNT, 6))
    product = np.sum(vector[:, :3] * vector[:, 3:], axis=1)
    primal, dual = line3.primal_matrix(vector), line3.dual_matrix(vector)
    np.testing.assert_allclose(np.linalg.det(primal), product**2, atol=1e-12)  # eq. (15)
    np.testing.assert_allclose(dual @ primal, -product[:, None, None] * np.eye(4), atol=1e-13)  # eq. (37)


def test_dual_matrix_as_printed_in_39_fails(rng):
    line = random_lines(rng)
    printed = line3.dual_matrix(line)
    printed[:, :3, :3] = -hat(line[:, 3:])
    assert (np.abs(printed @ line3.primal_matrix(line)).max(axis=(1, 2)) > 1e-3).all()


def test_line_through_another_of_its_points_scales_as_27_does_not_say(rng):
    a, b = rng.normal(size=(2, COUNT, 4))
    mu = rng.uniform(0.3, 3.0, (COUNT, 1))
    moved = line3.from_homogeneous_points(a, a + mu * b)
    np.testing.assert_allclose(moved, mu * line3.from_homogeneous_points(a, b), atol=1e-12)


def test_points_of_20_scale_the_vector_by_21(rng):
    a, b = rng.normal(size=(2, COUNT, 3))
    lam, mu = rng.normal(size=(2, COUNT, 1))
    moved = line3.from_points(lam * a + (1 - lam) * b, mu * a + (1 - mu) * b)
    np.testing.assert_allclose(moved, (lam - mu) * line3.from_points(a, b), atol=1e-12)
    same = line3.same_line(moved, line3.from_points(a, b), 1e-9, oriented=True)
    np.testing.assert_array_equal(same, (lam > mu)[:, 0])


def test_klein_residual_and_is_line(rng):
    line = random_lines(rng)
    assert line3.is_line(line).all() and np.abs(line3.klein_residual(line)).max() < 1e-14
    vector = np.array([[1.0, 0, 0, 1, 0, 0], [0.0] * 6, [np.nan, 0, 0, 1, 0, 0], [np.inf, 0, 0, 0, 1, 0]])
    np.testing.assert_allclose(line3.klein_residual(vector[:2]), [1.0, 0.0])
    assert not line3.is_line(vector).any()
    assert line3.is_line(np.array([1.0, 2.0, 3.0, 0, 0, 0]))  # a line at infinity is a line


def test_closest_line_is_stationary_and_equals_the_singular_value_recipe(rng):
    vector = rng.normal(size=(COUNT, 6))
    closest = line3.closest_line(vector)
    assert np.abs(line3.klein_residual(closest)).max() < 1e-14
    # Bartoli and Sturm: [m d] = U Z; the rotation D with the smallest off-diagonal part of D' Z, which is T v
    for row, answer in zip(vector, closest, strict=True):
        U, s, Vt = np.linalg.svd(np.column_stack([row[:3], row[3:]]), full_matrices=False)
        Z = np.diag(s) @ Vt
        T = np.array([[Z[0, 1], Z[1, 1]], [Z[1, 0], -Z[0, 0]]])
        v = np.linalg.svd(T)[2][-1]
        D = np.array([[v[0], -v[1]], [v[1], v[0]]])
        V = U @ D @ np.diag(np.diag(D.T @ Z))
        np.testing.assert_allclose(answer, np.concatenate([V[:, 0], V[:, 1]]), atol=1e-10)
    nearby = line3.closest_line(closest + 0.3 * rng.normal(size=(50, COUNT, 6)))
    assert (np.linalg.norm(nearby - vector, axis=-1) >= np.linalg.norm(closest - vector, axis=-1) - 1e-12).all()


def test_closest_line_keeps_lines_and_answers_ties(rng):
    line = random_lines(rng)
    np.testing.assert_allclose(line3.closest_line(line), line, atol=1e-13)
    d = rng.normal(size=(20, 3))
    for vector in (np.hstack([d, d]), np.hstack([d, -d])):
        closest = line3.closest_line(vector)
        assert line3.is_line(closest).all() and line3.is_finite(closest).all()
        # every tie is at distance |a|/sqrt 2, a = sqrt 2 d
        np.testing.assert_allclose(np.linalg.norm(closest - vector, axis=1), np.linalg.norm(d, axis=1))
    np.testing.assert_array_equal(line3.closest_line(np.zeros(6)), np.zeros(6))


def test_normalisation_and_equality(rng):
    line = random_lines(rng)
    scaled = line * rng.uniform(1e-8, 1e8, (COUNT, 1)) * rng.choice([-1, 1], (COUNT, 1))
    assert line3.same_line(scaled, line, 1e-14).all()
    normal = line3.normalize(scaled)
    np.testing.assert_allclose(np.linalg.norm(normal[:, 3:], axis=1), 1.0)
    np.testing.assert_allclose(np.linalg.norm(normal[:, :3], axis=1), line3.distance_to_origin(line))
    np.testing.assert_allclose(np.linalg.norm(line3.unit_vector(scaled), axis=1), 1.0)
    assert not line3.same_line(line, -line, oriented=True).any()
    assert not line3.same_line(line, np.roll(line, 1, axis=0)).any()
    assert not line3.same_line(np.zeros(6), np.zeros(6))


def test_distances_and_points(rng):
    a, b = rng.normal(size=(2, COUNT, 3))
    line = line3.from_points(a, b) * rng.uniform(0.1, 10, (COUNT, 1))
    d = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    foot = a - np.sum(a * d, axis=1, keepdims=True) * d
    np.testing.assert_allclose(line3.foot_point(line), foot, atol=1e-11)
    np.testing.assert_allclose(line3.distance_to_origin(line), np.linalg.norm(foot, axis=1), atol=1e-11)
    point = rng.normal(size=(COUNT, 3))
    nearest = a + np.sum((point - a) * d, axis=1, keepdims=True) * d
    np.testing.assert_allclose(line3.closest_point(line, point), nearest, atol=1e-11)
    np.testing.assert_allclose(
        line3.distance_to_point(line, point), np.linalg.norm(point - nearest, axis=1), atol=1e-11
    )
    np.testing.assert_allclose(line3.point_at(line, line3.parameter_of(line, point)), nearest, atol=1e-11)
    np.testing.assert_allclose(line3.parameter_of(line, line3.point_at(line, 2.5)), 2.5)
    # with the sign of eq. (17) the foot lies on the other side
    assert (np.linalg.norm(np.cross(line[:, :3], line[:, 3:]) + foot, axis=1) > 1e-6).all()


def test_batches_broadcast_and_arguments_are_unchanged(rng):
    line, point = rng.normal(size=(4, 1, 6)), rng.normal(size=(5, 3))
    before = line.copy()
    assert line3.distance_to_point(line, point).shape == (4, 5)
    assert line3.from_points(point[:, None], point[None]).shape == (5, 5, 6)
    assert line3.foot_point(line[0, 0]).shape == (3,)
    assert line3.normalize(np.zeros((0, 6))).shape == (0, 6)
    assert line3.closest_line(np.zeros((0, 6))).shape == (0, 6)
    np.testing.assert_array_equal(line, before)


def test_errors_name_the_argument():
    with pytest.raises(ShapeError, match=r"line must have shape \(\.\.\., 6\); got \(6, 3\).*line\.T"):
        line3.normalize(np.zeros((6, 3)))
    with pytest.raises(ShapeError, match="first"):
        line3.from_planes(np.zeros(3), np.zeros(4))
    with pytest.raises(ShapeError, match=r"\(\.\.\., 4, 4\)"):
        line3.from_primal_matrix(np.zeros((4, 3)))
    with pytest.raises(InputError, match="tolerance"):
        line3.same_line(np.ones(6), np.ones(6), -1.0)
