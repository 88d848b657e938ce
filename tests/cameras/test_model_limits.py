# SPDX-License-Identifier: BSD-3-Clause
"""Covers single camera models where they end or change form: folds, poles, series at the axis, closed forms."""

import numpy as np
import pytest
from _cases import FISHEYES, params_of, points_in_cone

from groma import cameras
from groma.errors import InputError

pytestmark = pytest.mark.kernels


def test_division_ends_where_its_root_does():
    """Pincushion: directions beyond z = 2 sqrt(k) r, and pixels beyond 1 / sqrt(k), have none; barrel: all pixels."""
    k = 0.25
    params = np.array([500.0, 320.0, 240.0, k])
    tangent = 1 / (2 * k**0.5)
    inside, outside = [0.999999 * tangent, 0.0, 1.0], [1.000001 * tangent, 0.0, 1.0]
    pixels = cameras.SIMPLE_DIVISION.project(params, np.array([inside, outside, [0.0, -0.5, -1.0]]))
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1:]).all()
    edge = 500 / k**0.5
    rays = cameras.SIMPLE_DIVISION.unproject(params, np.array([[320 + 0.999 * edge, 240], [320 + 1.001 * edge, 240]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()
    params[3] = -k
    rays = cameras.SIMPLE_DIVISION.unproject(params, np.array([[320 + edge, 240.0], [320 + 5 * edge, 240.0]]))
    np.testing.assert_allclose(rays[0], [1, 0, 0], rtol=0, atol=1e-15)  # in the image plane
    assert rays[1, 2] < -0.9


def test_division_without_distortion_is_a_pinhole():
    points = points_in_cone(np.random.default_rng(10), 1.2)
    params = np.array([500.0, 510.0, 320.0, 240.0])
    for model, extra in ((cameras.DIVISION, [0.0]), (cameras.EUCM, [0.0, 1.0]), (cameras.FOV, [0.0])):
        pixels = model.project(np.append(params, extra), points)
        np.testing.assert_allclose(pixels, cameras.PINHOLE.project(params, points), rtol=1e-12, atol=1e-9)
        back = model.unproject(np.append(params, extra), pixels)
        np.testing.assert_allclose(back, points / np.linalg.norm(points, axis=1)[:, None], rtol=0, atol=1e-12)


def test_eucm_ends_where_its_image_no_longer_grows():
    """alpha > 1/2: z / d > -(1 - alpha) / alpha, and the pixels end at that radius."""
    alpha = 0.8
    params = np.array([500.0, 500.0, 0.0, 0.0, alpha, 1.0])
    limit = np.arccos(-(1 - alpha) / alpha)
    theta = np.array([0.5 * np.pi, 0.999 * limit, 1.001 * limit, 3.1])
    points = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=1)
    pixels = cameras.EUCM.project(params, points)
    assert np.isfinite(pixels[:2]).all()
    assert np.isnan(pixels[2:]).all()
    np.testing.assert_allclose(cameras.EUCM.unproject(params, pixels[:2]), points[:2], rtol=0, atol=1e-9)
    edge = 500 / np.sqrt(2 * alpha - 1)
    assert np.isnan(cameras.EUCM.unproject(params, np.array([[1.0001 * edge, 0.0], [1e9, 0.0]]))).all()


def test_fov_is_smooth_in_radius_and_omega():
    """Across the two places where series take over, values and derivatives join; COLMAP's own series ends at 1e-2."""
    points = np.array([[t, 0.5 * t, 1.0] for t in (1e-9, 4.9e-5, 5.2e-5, 2e-4, 0.3)])
    for omega in (0.99e-5, 1.01e-5, 0.9):
        params = np.array([500.0, 510.0, 320.0, 240.0, omega])
        pixels, by_point, by_params = cameras.FOV.project_jacobian(params, points)
        r = np.hypot(points[:, 0], points[:, 1])
        expected = np.arctan(2 * r * np.tan(omega / 2)) / omega
        radius = np.hypot((pixels[:, 0] - 320) / 500, (pixels[:, 1] - 240) / 510)
        np.testing.assert_allclose(radius, expected, rtol=1e-9, atol=1e-15)
        slope = 2 * np.tan(omega / 2) / omega / (1 + (2 * r * np.tan(omega / 2)) ** 2)
        outward = np.einsum("nij,nj->ni", by_point[:, :, :2], points[:, :2] / r[:, None]) / [500, 510]
        np.testing.assert_allclose(np.linalg.norm(outward, axis=1), slope, rtol=1e-7)
        by_omega = np.hypot(by_params[:, 0, 4] / 500, by_params[:, 1, 4] / 510)
        expected = abs(r * omega / 6 - 2 / 3 * omega * r**3) if omega < 0.1 else None
        if expected is not None:
            np.testing.assert_allclose(by_omega, expected, rtol=1e-4, atol=1e-10)
    params[4] = 3.2
    assert np.isnan(cameras.FOV.project(params, points)).all()
    params[4] = 0.9  # at 90 degrees the image ends, at a radius of pi / (2 omega)
    edge = 500 * np.pi / 1.8
    rays = cameras.FOV.unproject(params, np.array([[320 + 0.999 * edge, 240.0], [320 + 1.001 * edge, 240.0]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()


def test_thin_prism_unprojection_ends_where_the_image_folds():
    """With k1 = -0.1 alone the fold is that of OPENCV_FISHEYE, at theta^2 = 1 / 0.3."""
    turn = (1 / 0.3) ** 0.5
    for model, count in ((cameras.THIN_PRISM_FISHEYE, 12), (cameras.RAD_TAN_THIN_PRISM_FISHEYE, 16)):
        params = np.zeros(count)
        params[:2], params[4] = 300.0, -0.1
        theta = np.array([0.0, 0.3, 0.999 * turn])
        points = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=1)
        np.testing.assert_allclose(model.unproject(params, model.project(params, points)), points, rtol=0, atol=1e-9)
        edge = 300 * turn * (1 - 0.1 * turn**2)
        assert np.isnan(model.unproject(params, np.array([[edge + 1e-3, 0.0], [edge * 2, 0.0], [1e6, 1e6]]))).all()


def test_a_panorama_is_the_same_at_its_left_and_right_border():
    model, params = cameras.EQUIRECTANGULAR, params_of("EQUIRECTANGULAR")
    around = np.pi * np.array([-0.999, 0.999])
    points = np.stack([np.sin(around), [0.1, 0.1], np.cos(around)], axis=1)
    pixels = model.project(params, points)
    assert abs(pixels[1, 0] - pixels[0, 0]) > 639
    difference = model.pixel_difference(params, pixels[:1], pixels[1:])
    np.testing.assert_allclose(difference, [[0.64, 0.0]], rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        model.unproject(params, pixels + np.array([640, 0])), model.unproject(params, pixels), atol=1e-12
    )
    np.testing.assert_array_equal(
        cameras.PINHOLE.pixel_difference(np.ones(4), np.array([[900.0, 1.0]]), np.array([[1.0, 3.0]])), [[899.0, -2.0]]
    )
    for nowhere in ([0.0, 1.0, 0.0], [1e-12, -1.0, 0.0]):  # straight down and up: a whole row
        assert np.isnan(model.project(params, np.array([nowhere]))).all()
    np.testing.assert_allclose(model.unproject(params, np.array([[5.0, 0.0]])), [[0, -1, 0]], rtol=0, atol=1e-15)
    assert np.isnan(model.unproject(params, np.array([[5.0, -0.1], [5.0, 480.1]]))).all()


def test_a_panorama_has_no_camera_matrix():
    model, params = cameras.EQUIRECTANGULAR, params_of("EQUIRECTANGULAR")
    with pytest.raises(InputError, match=r"EQUIRECTANGULAR has none.*bearings.*perspective views"):
        model.undistort_pixels(params, np.ones((1, 2)))
    # Around its axis it looks like a camera of 640 / 2 pi across and 480 / pi down.
    assert model.focal_length(params) == pytest.approx(0.5 * (320 + 480) / np.pi)
    assert model.focal_length(np.tile(params, (3, 1))).shape == (3,)


@pytest.mark.parametrize("name", FISHEYES)
def test_fisheyes_are_equidistant_at_the_centre(name):
    """Across the switch to the series at the axis the derivative is that of the tangent plane."""
    model, params = cameras.model(name), params_of(name)
    small = np.array([0.0, 1e-13, 9e-11, 1.1e-10, 1e-8])
    points = np.stack([2.0 * small, small, np.full(5, 2.0)], axis=1)
    pixels, by_point, _ = model.project_jacobian(params, points)
    focal = params[[model.focal_indices[0], model.focal_indices[-1]]]
    np.testing.assert_allclose(pixels, [320, 240] + focal * points[:, :2] / 2, rtol=0, atol=1e-9)
    np.testing.assert_allclose(by_point[:, :, :2], [np.diag(focal / 2)] * 5, rtol=0, atol=1e-5)


def test_fisheye_sees_all_around_except_straight_back():
    model, params = cameras.model("OPENCV_FISHEYE"), params_of("OPENCV_FISHEYE")
    assert model.sees_behind
    sideways = model.project(params, np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0]]))
    theta = np.array([np.pi / 2, 3 * np.pi / 4])
    k = params[4:]
    radius = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
    np.testing.assert_allclose(sideways, np.stack([300 * radius + 320, [240, 240]], axis=1), rtol=0, atol=1e-9)
    for result in model.project_jacobian(params, np.array([[0.0, 0.0, -1.0], [1e-12, 0.0, -1.0]])):
        assert np.isnan(result).all()


def test_fisheye_is_smooth_across_the_axis():
    """Around the switch to the series at r/z = 1e-10 and at larger angles, the linear map at the axis is the limit."""
    model, params = cameras.model("OPENCV_FISHEYE"), params_of("OPENCV_FISHEYE")
    small = np.array([0.0, 1e-13, 9e-11, 1.1e-10, 1e-8, 1e-6])
    points = np.stack([2.0 * small, small, np.full(6, 2.0)], axis=1)
    pixels, by_point, _ = model.project_jacobian(params, points)
    np.testing.assert_allclose(pixels, [320, 240] + np.array([300.0, 310.0]) * points[:, :2] / 2, rtol=0, atol=1e-9)
    np.testing.assert_allclose(by_point[:, :, :2], [np.diag([150.0, 155.0])] * 6, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "params", "radius_max"),
    [
        # g = r - 0.2 r^3 turns at r^2 = 1 / 0.6
        ("SIMPLE_RADIAL", [500.0, 0.0, 0.0, -0.2], (1 / 0.6) ** 0.5),
        # grows again beyond a second turn: 1 - 0.9 s + 0.15 s^2 = 0 at s = (0.9 - sqrt(0.21)) / 0.3
        ("RADIAL", [500.0, 0.0, 0.0, -0.3, 0.03], ((0.9 - 0.21**0.5) / 0.3) ** 0.5),
        ("OPENCV", [500.0, 500.0, 0.0, 0.0, -0.3, 0.03, 0.0, 0.0], ((0.9 - 0.21**0.5) / 0.3) ** 0.5),
    ],
)
def test_unprojection_ends_where_the_distortion_folds(name, params, radius_max):
    model, params = cameras.model(name), np.array(params)
    inside = np.array([[0.999 * radius_max, 0.0, 1.0], [0.0, 0.5 * radius_max, 1.0]])
    bearings = model.unproject(params, model.project(params, inside))
    np.testing.assert_allclose(bearings / bearings[:, 2:], inside, rtol=0, atol=1e-9)
    edge = model.project(params, np.array([[radius_max, 0.0, 1.0]]))
    assert np.isnan(model.unproject(params, edge * 1.001)).all()
    assert np.isnan(model.unproject(params, np.array([[1e6, 0.0]]))).all()


def test_fisheye_unprojection_ends_where_the_distortion_folds():
    model, params = cameras.model("OPENCV_FISHEYE"), np.array([300.0, 300.0, 0.0, 0.0, -0.1, 0.0, 0.0, 0.0])
    turn = (1 / 0.3) ** 0.5  # 1 - 3 * 0.1 theta^2 = 0
    theta = np.array([0.0, 0.3, 0.9999 * turn])
    points = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=1)
    np.testing.assert_allclose(model.unproject(params, model.project(params, points)), points, rtol=0, atol=1e-10)
    edge = 300 * turn * (1 - 0.1 * turn**2)
    assert np.isnan(model.unproject(params, np.array([[edge + 1e-6, 0.0], [edge * 2, 0.0]]))).all()


@pytest.mark.parametrize(
    ("name", "extra", "half_angle"),
    [
        ("SIMPLE_RADIAL", [3.0], 1.3),
        ("RADIAL", [-0.4, 0.3], 1.2),
        ("RADIAL", [5.0, 20.0], 1.4),
        ("OPENCV", [0.8, 0.5, 0.01, -0.02], 1.1),
        ("OPENCV", [-0.4, 0.3, 0.005, 0.003], 0.9),
        ("FULL_OPENCV", [9.0, 4.0, 0.0, 0.0, 0.2, 9.4, 7.0, 1.5], 1.1),
        ("OPENCV_FISHEYE", [0.4, 0.2, 0.1, 0.05], 3.0),
        ("SIMPLE_RADIAL_FISHEYE", [0.3], 3.0),
        ("RADIAL_FISHEYE", [-0.1, 0.05], 3.0),
        ("THIN_PRISM_FISHEYE", [0.4, 0.2, 0.01, -0.01, 0.1, 0.05, 0.01, 0.02], 3.0),
        ("RAD_TAN_THIN_PRISM_FISHEYE", [0.3, 0.1, 0, 0, 0, 0, 0.001, -0.001, 0.001, 0, 0.001, 0], 2.0),
        ("FOV", [2.5], 1.5),
        ("SIMPLE_DIVISION", [-5.0], 3.0),
        ("DIVISION", [0.5], 0.6),
        ("EUCM", [0.5, 2.0], 2.9),
    ],
)
def test_strong_distortion_is_undone(name, extra, half_angle):
    model = cameras.model(name)
    focal = [400.0] * len(model.focal_indices)
    params = np.array([*focal, 320.0, 240.0, *extra])
    points = points_in_cone(np.random.default_rng(5), half_angle, 60)
    bearings = model.unproject(params, model.project(params, points))
    np.testing.assert_allclose(bearings, points / np.linalg.norm(points, axis=1, keepdims=True), rtol=0, atol=1e-9)


def test_undistortion_leaves_out_what_lies_behind():
    model, params = cameras.model("OPENCV_FISHEYE"), params_of("OPENCV_FISHEYE")
    pixels = model.project(params, np.array([[1.0, 0.0, -0.2], [1.0, 0.0, 0.2]]))
    undistorted = model.undistort_pixels(params, pixels)
    assert np.isnan(undistorted[0]).all()
    assert np.isfinite(undistorted[1]).all()


def test_bearings_of_a_pinhole_in_closed_form():
    """On the axis a pixel is 1/f radians in every direction."""
    _, G = cameras.SIMPLE_PINHOLE.bearing_jacobian(np.array([500.0, 320.0, 240.0]), np.array([[320.0, 240.0]]))
    np.testing.assert_allclose(G[0] @ G[0].T, np.diag([1.0, 1.0, 0.0]) / 500**2, rtol=1e-14, atol=1e-22)


def test_denominator_of_zero_has_no_image():
    """FULL_OPENCV with 1 + k4 s = 0 at s = 1."""
    params = np.zeros(12)
    params[:2], params[9] = 500.0, -1.0
    for result in cameras.FULL_OPENCV.project_jacobian(params, np.array([[1.0, 0.0, 1.0]])):
        assert np.isnan(result).all()
    assert np.isnan(cameras.FULL_OPENCV.project(params, np.array([[1.0, 0.0, 1.0]]))).all()
