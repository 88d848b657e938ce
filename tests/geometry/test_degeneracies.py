# SPDX-License-Identifier: BSD-3-Clause
"""Covers the degenerate positions of lines and planes, one test per position: no NaN without a status, no warning, and
the right answer where there is one. The singular places of charts are tested with the charts."""

import numpy as np
import pytest

from groma.estimators import line_triangulation, trimming
from groma.estimators.line_triangulation import TriangulationStatus
from groma.estimators.trimming import TrimStatus
from groma.geometry import incidence, line3, plane3, projection, transform
from groma.geometry.incidence import LineRelation
from groma.geometry.projection import LineVisibility

K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
AT_ORIGIN = K @ np.hstack([np.eye(3), np.zeros((3, 1))])


@pytest.fixture
def rng():
    return np.random.default_rng(12)


def line_of(point, direction):
    return line3.from_point_and_direction(np.asarray(point, dtype=float), np.asarray(direction, dtype=float))


def finite(*arrays):
    return all(np.isfinite(array).all() for array in arrays)


def test_line_through_the_origin_has_all_its_numbers():
    line = line_of([0, 0, 0], [1, 2, 3])
    np.testing.assert_array_equal(line[:3], 0.0)
    assert line3.is_line(line) and line3.distance_to_origin(line) == 0.0
    np.testing.assert_array_equal(line3.foot_point(line), 0.0)
    assert line3.same_line(line3.closest_line(line), line, 1e-14)
    assert incidence.meet_lines(line, line_of([1, 2, 3], [0, 1, 0])).status == LineRelation.CROSSING


def test_line_at_infinity_has_no_points_but_meets_planes():
    line = line3.from_planes(np.array([0.0, 0, 1, -1]), np.array([0.0, 0, 2, 5]))
    assert line3.is_line(line) and not line3.is_finite(line)
    assert np.isnan(line3.foot_point(line)).all() and line3.distance_to_origin(line) == np.inf
    assert line3.distance_to_point(line, np.ones(3)) == np.inf
    met = incidence.meet_line_plane(line, np.array([1.0, 0, 0, 0]))
    assert met[3] == 0.0 and abs(met[2]) == 0.0 and met[1] != 0.0
    pair = incidence.closest_points(line, line_of([1, 0, 0], [0, 1, 0]))
    assert pair.status == LineRelation.INVALID and pair.distance == np.inf
    assert finite(pair.first, pair.second, pair.common_perpendicular)


def test_line_through_the_camera_centre_is_seen_as_a_point():
    line = line_of([0, 0, 0], [0.1, 0.2, 1])
    assert projection.visibility(line) == LineVisibility.THROUGH_CENTER
    image = projection.project_lines(AT_ORIGIN, line)
    np.testing.assert_array_equal(projection.normalize_image_lines(image), 0.0)
    trimmed = trimming.trim_in_image(AT_ORIGIN, line, np.array([370.0, 340.0]))
    assert trimmed.status == TrimStatus.NO_IMAGE and np.isnan(trimmed.point).all()


def test_line_in_the_principal_plane_is_seen_at_infinity():
    line = line_of([1, 2, 0], [1, -1, 0])
    assert projection.visibility(line) == LineVisibility.IN_PRINCIPAL_PLANE
    image = projection.project_lines(AT_ORIGIN, line)
    assert image[2] != 0.0
    np.testing.assert_allclose(projection.normalize_image_lines(image), 0.0, atol=1e-12)
    trimmed = trimming.trim_in_image(AT_ORIGIN, line, np.array([100.0, 100.0]))
    assert trimmed.status == TrimStatus.NO_IMAGE


@pytest.mark.parametrize("tilt", [0.0, 1e-9, 0.01, 0.2])
def test_line_in_the_epipolar_plane_is_reported(tilt):
    """Baseline along x, line 5 in front, turned out of the epipolar plane of its point by `tilt`."""
    first = AT_ORIGIN
    second = K @ np.hstack([np.eye(3), [[-1.0], [0], [0]]])
    a, b = np.array([-1.0, 0, 5]), np.array([2.0, 3 * np.tan(tilt), 5])
    segments = np.array(
        [np.concatenate([(P @ [*x, 1])[:2] / (P @ [*x, 1])[2] for x in (a, b)]) for P in (first, second)]
    )
    result = line_triangulation.triangulate_lines(
        np.stack([first, second]), np.array([0, 1]), segments, np.array([0, 2]), min_sine=0.02
    )
    assert finite(result.line, result.sine, result.residual)
    if tilt < 0.1:
        assert result.status[0] == TriangulationStatus.DEGENERATE_BASELINE
    else:
        assert result.status[0] == TriangulationStatus.OK
        assert line3.same_line(result.line[0], line3.from_points(a, b), 1e-9)


def test_error_of_two_planes_grows_like_one_over_the_sine(rng):
    """Noise of 1e-3 rad on the normals gives about sigma / sin: 0.31, 0.97 and 3.2 degrees at 10, 3 and 1 degree."""
    for angle_deg, expected_deg in ((10.0, 0.31), (3.0, 0.97), (1.0, 3.2)):
        half = np.deg2rad(angle_deg) / 2
        normals = np.array([[np.cos(half), np.sin(half), 0], [np.cos(half), -np.sin(half), 0]])
        noisy = normals + 1e-3 * rng.normal(size=(4000, 2, 3))
        planes = np.concatenate([noisy, -np.ones((4000, 2, 1))], axis=2)
        result = line_triangulation.triangulate_two_planes(planes[:, 0], planes[:, 1], min_sine=0.0)
        np.testing.assert_allclose(np.median(result.sine), np.sin(2 * half), rtol=0.05)
        error = np.rad2deg(np.arccos(np.clip(np.abs(result.line[:, 5]), 0, 1)))
        # the line's error is normal in the one direction in which the planes intersect badly: mean 0.8 sigma
        assert 0.5 * expected_deg < error.mean() < 2.0 * expected_deg


def test_meet_of_lines_whose_plane_holds_the_origin():
    first, second = line_of([1, 0, 0], [1, 1, 0]), line_of([1, 0, 0], [-1, 2, 0])
    np.testing.assert_array_equal(np.cross(first[:3], second[:3]), 0.0)  # X of the closed form is 0 ...
    assert np.dot(first[:3], second[3:]) == 0.0  # ... and so is W
    met = incidence.meet_lines(first, second)
    assert met.status == LineRelation.CROSSING
    np.testing.assert_allclose(met.point, [1, 0, 0, 1], atol=1e-14)
    through_origin = incidence.meet_lines(line_of([0, 0, 0], [1, 0, 0]), line_of([0, 0, 0], [0, 1, 1]))
    np.testing.assert_allclose(through_origin.point, [0, 0, 0, 1], atol=1e-14)


def test_meet_of_skew_and_nearly_parallel_lines():
    skew = incidence.meet_lines(line_of([0, 0, 0], [1, 0, 0]), line_of([0, 0, 0.2], [0, 1, 0]))
    assert skew.status == LineRelation.SKEW and skew.distance == pytest.approx(0.2)
    np.testing.assert_allclose(skew.point, [0, 0, 0.1, 1], atol=1e-15)
    tolerated = incidence.meet_lines(line_of([0, 0, 0], [1, 0, 0]), line_of([0, 0, 0.2], [0, 1, 0]), 0.3)
    assert tolerated.status == LineRelation.CROSSING
    refused = incidence.meet_lines(line_of([0, 1, 0], [1, 0, 0]), line_of([0, 1, 0], [1, 0.01, 0]))
    assert refused.status == LineRelation.PARALLEL and refused.point[3] == 0.0
    np.testing.assert_allclose(refused.point[:3], [1, 0.005, 0], atol=1e-4)


@pytest.mark.parametrize("factor", [1.0, -0.3])
def test_parallel_and_identical_lines(factor, rng):
    d = rng.normal(size=3)
    p, q = rng.normal(size=(2, 3))
    first, parallel = line_of(p, d), line_of(q, factor * d)
    pair = incidence.closest_points(first, parallel)
    assert pair.status == LineRelation.PARALLEL
    assert pair.distance == pytest.approx(float(line3.distance_to_point(first, q)), abs=1e-12)
    assert line3.distance_to_point(parallel, pair.second) < 1e-12
    for line in (first, parallel):
        crossed = incidence.closest_points(pair.common_perpendicular, line)
        assert crossed.distance < 1e-12 and crossed.sine == pytest.approx(1.0)
    joined = incidence.join_lines(first, parallel)
    assert joined.status == LineRelation.PARALLEL
    for point in (p, p + d, q, q - d):
        assert abs(plane3.signed_distance(joined.plane, point)) < 1e-12
    met = incidence.meet_lines(first, parallel)
    assert met.status == LineRelation.PARALLEL and met.point[3] == 0.0
    np.testing.assert_allclose(np.abs(met.point[:3] @ d), np.linalg.norm(d))

    same = factor * first
    pair, joined, met = (f(first, same) for f in (incidence.closest_points, incidence.join_lines, incidence.meet_lines))
    assert pair.status == joined.status == met.status == LineRelation.IDENTICAL
    assert pair.distance < 1e-12 and line3.distance_to_point(first, pair.first) < 1e-12
    for array in (pair.common_perpendicular, joined.plane, met.point):
        np.testing.assert_array_equal(array, 0.0)


def test_join_of_skew_lines_lies_half_way():
    joined = incidence.join_lines(line_of([0, 0, 0], [1, 0, 0]), line_of([0, 0, 0.2], [0, 1, 0]))
    assert joined.status == LineRelation.SKEW and joined.distance == pytest.approx(0.1)
    assert plane3.same_plane(joined.plane, [0, 0, 1, -0.1], 1e-14)


def test_lines_with_numbers_that_are_not_finite():
    good = np.tile(line_of([0, 0, 1], [1, 0, 0]), (3, 1))
    bad = np.array([[np.nan] * 6, [0.0] * 6, [np.inf, 0, 0, 0, 1, 0]])
    for function in (incidence.closest_points, incidence.join_lines, incidence.meet_lines):
        result = function(good, bad)
        assert (result.status == LineRelation.INVALID).all()
    assert finite(incidence.closest_points(good, bad).first, incidence.join_lines(good, bad).plane)
    assert finite(incidence.meet_lines(bad, good).point)


def test_trimming_refuses_lines_along_the_ray(rng):
    ray = np.array([0.1, -0.2, 1.0])
    for sine, expected in ((0.0, TrimStatus.PARALLEL_TO_RAY), (0.01, TrimStatus.PARALLEL_TO_RAY), (0.1, TrimStatus.OK)):
        across = np.cross(ray, rng.normal(size=3))
        across *= np.linalg.norm(ray) / np.linalg.norm(across)
        line = line_of(5 * ray + 0.3 * across, ray + sine * across)
        by_ray = trimming.trim_to_ray(line, np.zeros(3), ray)
        assert by_ray.status == expected
        assert by_ray.sine == pytest.approx(np.sin(np.arctan(sine)), abs=1e-9)
        assert np.isnan(by_ray.point).all() == (expected != TrimStatus.OK)
    along = line_of([0.3, 0, 4], ray)
    pixel = (K @ ray)[:2] / ray[2]
    in_image = trimming.trim_in_image(AT_ORIGIN, along, pixel)
    assert in_image.status == TrimStatus.PARALLEL_TO_RAY and np.isnan(in_image.point).all()


def test_opposite_vectors_are_the_same_line(rng):
    line = line_of(rng.normal(size=3), rng.normal(size=3))
    assert line3.same_line(line, -2 * line) and not line3.same_line(line, -2 * line, oriented=True)
    camera = rng.normal(size=(3, 4))
    np.testing.assert_allclose(projection.project_lines(camera, -line), -projection.project_lines(camera, line))
    other = line_of(rng.normal(size=3), rng.normal(size=3))
    first, second = incidence.closest_points(line, other), incidence.closest_points(-line, other)
    np.testing.assert_allclose(first.first, second.first, atol=1e-12)
    np.testing.assert_allclose(first.common_perpendicular, second.common_perpendicular, atol=1e-12)


def test_points_behind_the_camera_are_marked():
    behind = line_of([0.5, 0, -4], [0, 1, 0])
    image = projection.normalize_image_lines(projection.project_lines(AT_ORIGIN, behind))
    pixel = np.array([-image[2] / image[0], 100.0])  # on the image line: the formula is silently valid
    assert abs(image @ [*pixel, 1.0]) < 1e-9
    trimmed = trimming.trim_in_image(AT_ORIGIN, behind, pixel)
    assert trimmed.status == TrimStatus.BEHIND_CAMERA and trimmed.depth == pytest.approx(-4.0)
    assert line3.distance_to_point(behind, trimmed.point) < 1e-9
    by_ray = trimming.trim_to_ray(behind, np.zeros(3), np.linalg.solve(K, [*pixel, 1.0]))
    assert by_ray.status == TrimStatus.BEHIND_CAMERA


def test_normalised_coordinates_keep_the_digits_of_single_precision(rng):
    """With pixels, float32 loses the distance in the entries of K_L; with K = I it keeps it to about 1e-3 px."""
    line = line3.from_points(*(rng.normal(size=(2, 200, 3)) + np.array([0, 0, 8.0])))
    ray = np.concatenate([rng.uniform(-0.5, 0.5, (200, 2)), np.ones((200, 1))], axis=1)

    def distance(intrinsics, dtype):
        matrix, pixel = projection.line_intrinsics(intrinsics).astype(dtype), (ray @ intrinsics.T).astype(dtype)
        image = line[:, :3].astype(dtype) @ matrix.T
        return np.sum(image * pixel, axis=1) / np.hypot(image[:, 0], image[:, 1])

    truth = distance(K, np.float64)
    np.testing.assert_allclose(500.0 * distance(np.eye(3), np.float64), truth, rtol=1e-9, atol=1e-9)
    in_pixels = np.abs(distance(K, np.float32) - truth).max()
    in_rays = np.abs(500.0 * distance(np.eye(3), np.float32).astype(np.float64) - truth).max()
    assert in_rays < in_pixels and in_rays < 2e-3


def test_drift_off_the_klein_quadric_is_seen_and_repaired(rng):
    line = line_of(rng.normal(size=(100, 3)), rng.normal(size=(100, 3)))
    drifted = line + 1e-3 * rng.normal(size=(100, 6))
    assert not line3.is_line(drifted).any()
    product = line3.dual_matrix(drifted) @ line3.primal_matrix(drifted)
    assert np.abs(product).max() > 1e-4
    repaired = line3.closest_line(drifted)
    assert line3.is_line(repaired, 1e-14).all()
    np.testing.assert_allclose(line3.dual_matrix(repaired) @ line3.primal_matrix(repaired), 0.0, atol=1e-14)
    assert (np.linalg.norm(repaired - line, axis=1) <= 1.5 * np.linalg.norm(drifted - line, axis=1)).all()


def test_planes_through_the_origin_and_far_away_keep_all_forms():
    planes = np.array([[1.0, 2, 3, 0], [1, 2, 3, 1e9], [1e-9, 0, 0, 1]])
    assert finite(plane3.canonical(planes), plane3.to_quaternion(planes), plane3.to_closest_point(planes))
    assert plane3.same_plane(plane3.from_quaternion(plane3.to_quaternion(planes)), planes, 1e-14).all()
    moved = transform.rigid_planes((np.eye(3), np.array([1.0, 0, 0])), planes[0])
    assert plane3.signed_distance(moved, np.array([1.0, 0, 0])) == pytest.approx(0.0)
