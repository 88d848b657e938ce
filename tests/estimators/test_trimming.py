# SPDX-License-Identifier: BSD-3-Clause
"""Covers the trimming of end points: exact recovery, agreement with closest points, the defining property of each
version under noise, status per point, batches."""

import numpy as np
import pytest

from groma.errors import ShapeError
from groma.estimators import trimming
from groma.estimators.trimming import TrimStatus
from groma.geometry import incidence, line3, projection, se3, transform

COUNT = 100
K = np.array([[500.0, 0.0, 320.0], [0.0, 480.0, 240.0], [0.0, 0.0, 1.0]])


def scene(seed):
    """Cameras, end points in front of them, lines in the world, pixels."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(COUNT, 4))
    pose = np.hstack([q / np.linalg.norm(q, axis=1, keepdims=True), rng.normal(size=(COUNT, 3))])
    ends_in_cam = rng.uniform([-2, -2, 3], [2, 2, 8], (COUNT, 2, 3))
    ends = transform.rigid_points(se3.inverse(pose)[:, None], ends_in_cam)
    line = line3.from_points(ends[:, 0], ends[:, 1])
    camera = projection.camera_matrix(K, pose)
    image = np.einsum("nij,nej->nei", camera, np.concatenate([ends, np.ones((COUNT, 2, 1))], axis=2))
    return rng, pose, camera, ends, line, image[..., :2] / image[..., 2:]


def test_exact_segments_give_the_end_points_back():
    _, pose, camera, ends, line, pixels = scene(1)
    trimmed = trimming.trim_segments(camera, line, pixels.reshape(COUNT, 4), min_sine=0.0)
    assert (trimmed.status == TrimStatus.OK).all()
    np.testing.assert_allclose(trimmed.point, ends, atol=1e-8)
    in_cam = transform.rigid_points(pose[:, None], ends)
    np.testing.assert_allclose(trimmed.depth, in_cam[..., 2], atol=1e-8)
    center = se3.inverse(pose)[:, 4:]
    by_ray = trimming.trim_to_ray(line, center, ends[:, 0] - center, min_sine=0.0)
    np.testing.assert_allclose(by_ray.point, ends[:, 0], atol=1e-8)
    np.testing.assert_allclose(by_ray.depth, np.linalg.norm(ends[:, 0] - center, axis=1), atol=1e-8)
    np.testing.assert_allclose(by_ray.sine, trimmed.sine[:, 0], atol=1e-9)


def test_ray_version_is_the_closest_point_of_line_and_ray():
    rng, _, _, _, line, _ = scene(2)
    origin, ray = rng.normal(size=(2, COUNT, 3))
    trimmed = trimming.trim_to_ray(line, origin, ray, min_sine=0.0)
    pair = incidence.closest_points(line, line3.from_point_and_direction(origin, ray))
    np.testing.assert_allclose(trimmed.point, pair.first, atol=1e-9)
    np.testing.assert_allclose(trimmed.sine, pair.sine, atol=1e-12)
    ahead = np.sum((pair.first - origin) * ray, axis=1) > 0
    np.testing.assert_array_equal(trimmed.status == TrimStatus.OK, ahead)


def test_image_version_projects_to_the_foot_of_the_pixel():
    rng, _, camera, _, line, pixels = scene(3)
    noisy = pixels[:, 0] + rng.normal(size=(COUNT, 2))
    trimmed = trimming.trim_in_image(camera, line, noisy)
    good = trimmed.status == TrimStatus.OK
    assert good.mean() > 0.9
    np.testing.assert_allclose(line3.distance_to_point(line, trimmed.point)[good], 0.0, atol=1e-9)
    homogeneous = np.concatenate([trimmed.point, np.ones((COUNT, 1))], axis=1)
    image = np.einsum("nij,nj->ni", camera, homogeneous)
    image_line = projection.normalize_image_lines(projection.project_lines(camera, line))
    offset = np.sum(image_line[:, :2] * noisy, axis=1) + image_line[:, 2]
    foot = noisy - offset[:, None] * image_line[:, :2]
    np.testing.assert_allclose((image[:, :2] / image[:, 2:])[good], foot[good], atol=1e-6)


def test_scale_of_camera_line_and_ray_does_not_matter():
    _, _, camera, _, line, pixels = scene(4)
    expected = trimming.trim_in_image(camera, line, pixels[:, 1])
    scaled = trimming.trim_in_image(-3.0 * camera, -1e-3 * line, pixels[:, 1])
    np.testing.assert_array_equal(scaled.status, expected.status)
    np.testing.assert_allclose(scaled.point, expected.point, atol=1e-9)
    np.testing.assert_allclose(scaled.depth, expected.depth, atol=1e-9)


def test_invalid_lines_have_a_status():
    camera = K @ np.hstack([np.eye(3), np.zeros((3, 1))])
    lines = np.array([[0.0] * 6, [np.nan] * 6, [1.0, 2, 3, 0, 0, 0]])
    for trimmed in (
        trimming.trim_in_image(camera, lines, np.array([10.0, 20.0])),
        trimming.trim_to_ray(lines, np.zeros(3), np.array([0.0, 0, 1])),
    ):
        assert (trimmed.status == TrimStatus.NO_IMAGE).all() and np.isnan(trimmed.point).all()
    assert trimming.trim_to_ray(np.ones(6), np.zeros(3), np.zeros(3)).status == TrimStatus.NO_IMAGE


def test_shapes():
    _, _, camera, _, line, pixels = scene(5)
    assert trimming.trim_in_image(camera[0], line, pixels[0, 0]).point.shape == (COUNT, 3)
    assert trimming.trim_segments(camera[:0], line[:0], np.zeros((0, 4))).point.shape == (0, 2, 3)
    with pytest.raises(ShapeError, match="pixel"):
        trimming.trim_in_image(camera, line, np.zeros((COUNT, 3)))
