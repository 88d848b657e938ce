# SPDX-License-Identifier: BSD-3-Clause
"""Covers projected lines against projected points, both constructions of the projection matrix (finite and affine
cameras), line intrinsics, back-projection, duality in the image, vanishing points and horizons."""

import numpy as np
import pytest

from groma.geometry import incidence, line3, projection, transform
from groma.geometry.projection import LineVisibility
from groma.geometry.so3 import hat

COUNT = 100
K = np.array([[500.0, 0.0, 320.0], [0.0, 480.0, 240.0], [0.0, 0.0, 1.0]])


@pytest.fixture
def rng():
    return np.random.default_rng(10)


def general_cameras(rng):
    """Random 3x4 matrices; the last third affine, with a singular left part."""
    camera = rng.normal(size=(COUNT, 3, 4))
    camera[2 * COUNT // 3 :, 2, :3] = 0.0
    return camera


def image(camera, point):
    return np.einsum("nij,nj->ni", camera, point)


def test_projected_line_is_the_line_of_projected_points(rng):
    camera = general_cameras(rng)
    a, b = rng.normal(size=(2, COUNT, 4))
    line = line3.from_homogeneous_points(a, b)
    expected = np.cross(image(camera, a), image(camera, b))
    np.testing.assert_allclose(projection.project_lines(camera, line), expected, atol=1e-11)
    rows = projection.line_projection_matrix_from_rows(camera)
    np.testing.assert_allclose(rows, projection.line_projection_matrix(camera), atol=1e-12)
    skew = projection.project_primal_matrix(camera, line3.primal_matrix(line))
    np.testing.assert_allclose(skew, hat(expected), atol=1e-11)
    np.testing.assert_allclose(projection.line_of_skew(skew), expected, atol=1e-11)


def test_printed_forms_that_fail(rng):
    camera = rng.normal(size=(COUNT, 3, 4))
    rows = projection.line_projection_matrix_from_rows(camera)
    moment_first = np.concatenate([rows[..., 3:], rows[..., :3]], axis=-1)  # (58) read in the order (m, d)
    right = projection.line_projection_matrix(camera)
    assert (np.abs(moment_first - right).max(axis=(1, 2)) > 1e-3).all()
    printed = np.array([[480.0, 0, 0], [-480.0 * 320, 500, 0], [0, -500.0 * 240, 500 * 480]])  # (67)
    assert np.abs(printed - projection.line_intrinsics(K)).max() > 1e4


def test_line_intrinsics_and_camera_frame(rng):
    expected = [[480.0, 0, 0], [0, 500.0, 0], [-480.0 * 320, -500.0 * 240, 500.0 * 480]]
    np.testing.assert_allclose(projection.line_intrinsics(K), expected)
    np.testing.assert_allclose(projection.line_intrinsics(K), np.linalg.det(K) * np.linalg.inv(K).T, rtol=1e-12)
    q = rng.normal(size=(COUNT, 4))
    pose = np.hstack([q / np.linalg.norm(q, axis=1, keepdims=True), rng.normal(size=(COUNT, 3))])
    line = rng.normal(size=(COUNT, 6))
    in_cam = transform.rigid_lines(pose, line)
    from_moment = np.einsum("ij,nj->ni", projection.line_intrinsics(K), in_cam[:, :3])
    projected = projection.project_lines(projection.camera_matrix(K, pose), line)
    np.testing.assert_allclose(projected, from_moment, rtol=1e-9, atol=1e-6)


def test_normalised_lines_measure_pixels():
    line = projection.normalize_image_lines(np.array([[3.0, 4.0, -5.0], [0, 0, 2.0], [0, 0, 0]]))
    np.testing.assert_allclose(line, [[0.6, 0.8, -1.0], [0, 0, 0], [0, 0, 0]])
    assert line[0] @ [5.0, 0.0, 1.0] == pytest.approx(2.0)


def test_back_projected_plane_holds_line_and_centre(rng):
    camera = rng.normal(size=(COUNT, 3, 4))
    a, b = rng.normal(size=(2, COUNT, 4))
    line = line3.from_homogeneous_points(a, b)
    plane = projection.back_project_lines(camera, projection.project_lines(camera, line))
    center = np.linalg.svd(camera)[2][:, -1]
    for point in (a, b, center):
        np.testing.assert_allclose(np.sum(plane * point, axis=1), 0.0, atol=1e-10)
    np.testing.assert_allclose(incidence.meet_line_plane(line, plane), 0.0, atol=1e-9)


def test_duality_in_the_image(rng):
    a, b, c = rng.normal(size=(3, COUNT, 3))
    line, other = projection.join_image_points(a, b), projection.join_image_points(a, c)
    np.testing.assert_allclose(np.sum(line * a, 1), 0, atol=1e-13)
    met = projection.meet_image_lines(line, other)
    np.testing.assert_allclose(np.cross(met, a), 0, atol=1e-11)
    np.testing.assert_allclose(projection.skew_of_join(a, b), hat(line), atol=1e-13)  # (61) corrected
    np.testing.assert_allclose(projection.skew_of_join(line, other), hat(met), atol=1e-12)  # (62) corrected
    printed = a[:, :, None] * b[:, None, :] - b[:, :, None] * a[:, None, :]
    np.testing.assert_allclose(printed, -hat(line), atol=1e-13)


def test_vanishing_points_and_horizons(rng):
    camera = general_cameras(rng)
    point, direction, normal = rng.normal(size=(3, COUNT, 3))
    infinity = np.hstack([direction, np.zeros((COUNT, 1))])
    vanishing = projection.vanishing_points(camera, direction)
    np.testing.assert_allclose(vanishing, image(camera, infinity), atol=1e-13)
    line = projection.project_lines(camera, line3.from_point_and_direction(point, direction))
    np.testing.assert_allclose(np.sum(line * vanishing, axis=1), 0.0, atol=1e-11)
    horizon = projection.horizons(camera, normal)
    in_plane = np.cross(normal, rng.normal(size=(5, COUNT, 3)))
    vanishing = projection.vanishing_points(camera, in_plane)
    np.testing.assert_allclose(np.sum(horizon * vanishing, axis=-1), 0.0, atol=1e-10)
    level = projection.camera_matrix(K, (np.eye(3), np.zeros(3)))  # y down: the ground's horizon is v = cy
    ground = projection.normalize_image_lines(projection.horizons(level, np.array([0.0, -1.0, 0.0])))
    np.testing.assert_allclose(np.abs(ground), [0, 1, 240])


def test_visibility():
    through = line3.from_points(np.zeros(3), np.array([0.1, 0.2, 1.0]))
    flat = line3.from_points(np.array([1.0, 2.0, 0.0]), np.array([1.0, -3.0, 0.0]))
    seen = line3.from_points(np.array([1.0, 2.0, 4.0]), np.array([1.0, -3.0, 5.0]))
    lines = np.stack([seen, through, flat, np.zeros(6), np.full(6, np.nan)])
    expected = [
        LineVisibility.SEEN,
        LineVisibility.THROUGH_CENTER,
        LineVisibility.IN_PRINCIPAL_PLANE,
        LineVisibility.INVALID,
        LineVisibility.INVALID,
    ]
    np.testing.assert_array_equal(projection.visibility(lines), expected)
