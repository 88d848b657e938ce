# SPDX-License-Identifier: BSD-3-Clause
"""What is drawn of a scene: residuals of points and lines under several camera models, camera axes, planes."""

import numpy as np
import pytest
from _scene import PINHOLE, exact_scene

from groma.geometry import se3
from groma.scene import Scene
from groma.viz.drawable import drawable, rms_by_group


def test_exact_observations_have_no_residual():
    shown = drawable(exact_scene())
    assert shown.residuals.shape == (24 + 16, 2)
    # Newton's method of the unprojection stops at about 1e-10 of a bearing.
    np.testing.assert_allclose(shown.residuals, 0, atol=1e-6)


def test_a_moved_measurement_is_its_residual():
    scene = exact_scene()
    seen = scene.point_observations
    moved = drawable(scene.replace(point_observations=seen.replace(pixel=seen.pixel + np.array([3.0, -4.0]))))
    np.testing.assert_allclose(moved.residuals[:24], np.tile([-3.0, 4.0], (24, 1)), atol=1e-9)
    np.testing.assert_allclose(moved.median_by_image, 5.0, atol=1e-6)
    np.testing.assert_allclose(moved.point_errors, 5.0, atol=1e-9)


def test_a_wrong_match_is_no_wrong_image():
    scene = exact_scene()
    seen = scene.point_observations
    away = np.zeros(len(seen))
    away[0] = 300.0
    shown = drawable(scene.replace(point_observations=seen.replace(pixel=seen.pixel + away[:, None])))
    np.testing.assert_allclose(shown.median_by_image, 0.0, atol=1e-6)
    assert shown.lengths.max() > 300.0


def test_an_image_without_observations_has_no_residual():
    scene = exact_scene()
    seen = scene.point_observations
    shown = drawable(scene.replace(point_observations=seen.take(np.flatnonzero(seen.image_idx == 0))).points_only())
    np.testing.assert_allclose(shown.median_by_image, 0.0, atol=1e-6)


def test_line_residual_is_the_distance_in_the_image():
    """Under a pinhole camera: perpendicular to the projected line, with the length of the distance from it."""
    scene = exact_scene()
    rng = np.random.default_rng(1)
    seen = scene.line_observations
    shown = drawable(
        scene.replace(line_observations=seen.replace(segment=seen.segment + rng.normal(size=seen.segment.shape)))
    )
    exact_ends = seen.segment[:4].reshape(4, 2, 2)
    along = exact_ends[:, 1] - exact_ends[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    rows = slice(24, 24 + 8)
    residual = shown.residuals[rows].reshape(4, 2, 2)
    expected = np.einsum("lei,li->le", exact_ends - shown.residual_place[rows].reshape(4, 2, 2), across)
    # The direction of the line's image is a difference over 1e-4 radian; a pinhole image of a line is straight.
    np.testing.assert_allclose(np.einsum("lei,li->le", residual, across), expected, atol=1e-6)
    np.testing.assert_allclose(np.einsum("lei,li->le", residual, along), 0, atol=1e-6)


def test_points_behind_a_camera_are_not_counted():
    scene = exact_scene()
    xyz = scene.points.xyz.copy()
    xyz[0] = [0, 0, -50.0]
    shown = drawable(scene.with_points(xyz))
    assert np.isnan(shown.residuals[[0, 12]]).all()
    assert np.isnan(shown.point_errors[0])
    assert np.isfinite(shown.median_by_image).all()


def test_squares_of_huge_residuals_do_not_overflow():
    """As of a damaged model with a point at 1e308; a page must hold finite numbers."""
    lengths = np.array([3e200, 4e200, 1.7e308, 3.0, 4.0, 0.0, np.nan])
    found = rms_by_group(lengths, np.array([0, 0, 1, 2, 2, 3, 2]), 5)
    np.testing.assert_allclose(found, [np.sqrt(12.5) * 1e200, 1.7e308, np.sqrt(12.5), 0.0, 0.0], rtol=1e-15)


def test_camera_axes_and_centres():
    scene = exact_scene()
    shown = drawable(scene)
    np.testing.assert_allclose(shown.centers, scene.cam_centers_in_world, atol=1e-12)
    world_from_cam = np.linalg.inv(se3.to_matrix(scene.cam_from_world))
    for axis in range(3):
        np.testing.assert_allclose(shown.world_from_cam_axes[:, axis], world_from_cam[:, :3, axis], atol=1e-12)


def test_planes_are_drawn_around_what_lies_on_them():
    scene = exact_scene()
    patch = drawable(scene).patches[0]
    np.testing.assert_allclose(patch[:, 2], 0.25, atol=1e-12)
    assert np.abs(patch[:, :2]).max() <= 1.0
    assert drawable(scene).patch_members.tolist() == [6]


def test_planes_without_members_are_drawn_in_the_middle():
    scene = exact_scene()
    patch = drawable(scene.points_only().replace(planes=scene.planes)).patches[0]
    np.testing.assert_allclose(patch[:, 2], 0.25, atol=1e-12)


@pytest.mark.parametrize("name", ["points", "segments", "patches", "residuals", "cam_from_world"])
def test_an_empty_scene_is_drawable(name):
    assert len(getattr(drawable(Scene()), name)) == 0


def test_the_argument_is_not_changed():
    scene = exact_scene()
    before = scene.points.xyz.copy(), scene.line_observations.segment.copy(), scene.cameras.params.copy()
    drawable(scene)
    after = scene.points.xyz, scene.line_observations.segment, scene.cameras.params
    for one, two in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, two)
    assert scene.cameras.params[0, :4].tolist() == PINHOLE
