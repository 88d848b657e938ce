# SPDX-License-Identifier: BSD-3-Clause
"""Covers the camera models: values against COLMAP's, derivatives, inverse, limits of validity, shapes and errors.

Reference values come from pycolmap at run time. Tolerance 1e-9 px: both sides evaluate the same closed form in float64
at coordinates of about 1000 px, where one rounding is 1e-13 px.
"""

import numpy as np
import pycolmap
import pytest

from groma import cameras
from groma.cameras.check import check_camera
from groma.errors import InputError, ShapeError

pytestmark = pytest.mark.kernels

#: Parameters per model, with an angle from the axis (radians) up to which their distortion is monotone.
CASES = {
    "SIMPLE_PINHOLE": ([500.0, 320.0, 240.0], 1.2),
    "PINHOLE": ([500.0, 510.0, 320.0, 240.0], 1.2),
    "SIMPLE_RADIAL": ([500.0, 320.0, 240.0, -0.15], 0.7),
    "RADIAL": ([500.0, 320.0, 240.0, -0.3, 0.12], 1.0),
    "BAL": ([500.0, -0.3, 0.12], 1.0),
    "OPENCV": ([500.0, 510.0, 320.0, 240.0, -0.28, 0.09, 0.001, -0.002], 0.75),
    "FULL_OPENCV": (
        [500.0, 510.0, 320.0, 240.0, 0.3, -0.1, 0.001, -0.002, 0.02, 0.5, 0.1, 0.01],
        0.8,
    ),
    "OPENCV_FISHEYE": ([300.0, 310.0, 320.0, 240.0, 0.05, -0.01, 0.002, -0.0003], 2.2),
}
PERSPECTIVE = [name for name in CASES if name != "OPENCV_FISHEYE"]


def params_of(name):
    return np.array(CASES[name][0])


def points_in_cone(rng, half_angle, count=40):
    theta = half_angle * np.sqrt(rng.uniform(size=count))
    around, depth = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.5, 5.0, count)
    unit = np.stack([np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)], axis=1)
    return depth[:, None] * unit


def colmap_camera(name):
    """COLMAP's camera of the same model; BAL is RADIAL with the principal point at zero."""
    params = CASES[name][0]
    if name == "BAL":
        name, params = "RADIAL", [params[0], 0.0, 0.0, *params[1:]]
    return pycolmap.Camera(model=name, width=640, height=480, params=params)


def test_every_model_has_a_case():
    assert {model.name for model in cameras.models()} == set(CASES)


@pytest.mark.parametrize("name", CASES)
def test_keeps_its_promises(name):
    check_camera(cameras.model(name), params_of(name), np.random.default_rng(1), half_angle=CASES[name][1])


@pytest.mark.parametrize("name", CASES)
def test_describes_its_parameters_as_colmap_does(name):
    model = cameras.model(name)
    indices = (*model.focal_indices, *model.principal_point_indices, *model.extra_indices)
    assert sorted(indices) == list(range(model.num_parameters)) == list(range(len(CASES[name][0])))
    assert len(model.tag) == model.number + 1
    if model.colmap_name is not None:
        camera = colmap_camera(name)
        assert camera.model.name == model.colmap_name
        assert camera.params_info.replace(" ", "") == ",".join(model.parameter_names)
        assert list(camera.focal_length_idxs()) == list(model.focal_indices)
        assert list(camera.principal_point_idxs()) == list(model.principal_point_indices)
        assert list(camera.extra_params_idxs()) == list(model.extra_indices)


@pytest.mark.parametrize("name", CASES)
def test_pixels_equal_colmaps(name):
    points = points_in_cone(np.random.default_rng(2), min(CASES[name][1], 1.4))
    expected = colmap_camera(name).img_from_cam(points)
    np.testing.assert_allclose(cameras.model(name).project(params_of(name), points), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_bearings_equal_colmaps(name):
    model, params = cameras.model(name), params_of(name)
    pixels = model.project(params, points_in_cone(np.random.default_rng(3), min(CASES[name][1], 1.4)))
    bearings = model.unproject(params, pixels)
    np.testing.assert_allclose(np.linalg.norm(bearings, axis=1), 1.0, rtol=0, atol=1e-15)
    expected = colmap_camera(name).cam_from_img(pixels)
    # Compared where the noise is: as pixels. COLMAP's undistortion stops at 1e-10 in normalized coordinates.
    rays = np.column_stack([expected, np.ones(len(expected))])
    reached = model.project(params, rays)
    np.testing.assert_allclose(model.project(params, bearings), pixels, rtol=0, atol=1e-9)
    np.testing.assert_allclose(reached, pixels, rtol=0, atol=1e-6)
    np.testing.assert_allclose(bearings, rays / np.linalg.norm(rays, axis=1, keepdims=True), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", PERSPECTIVE)
def test_perspective_formula_holds_behind_the_camera(name):
    model, params = cameras.model(name), params_of(name)
    points = points_in_cone(np.random.default_rng(4), CASES[name][1])
    assert (points[:, 2] > 0).all()
    np.testing.assert_allclose(model.project(params, -points), model.project(params, points), rtol=0, atol=1e-9)
    expected = colmap_camera(name).img_from_cam(-points, check_cheirality=False)
    np.testing.assert_allclose(model.project(params, -points), expected, rtol=0, atol=1e-9)
    _, by_front, _ = model.project_jacobian(params, points)
    _, by_behind, _ = model.project_jacobian(params, -points)
    np.testing.assert_allclose(by_behind, -by_front, rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("name", PERSPECTIVE)
def test_the_plane_through_the_centre_has_no_image(name):
    model, params = cameras.model(name), params_of(name)
    points = np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 1e-13], [1.0, 2.0, -1e-13], [1e-3, 0.0, 1e-16]])
    for result in (model.project(params, points), *model.project_jacobian(params, points)):
        assert np.isnan(result).all()
    assert np.isfinite(model.project(params, np.array([[0.1, 0.2, 1.0], [1.0, 2.0, 1e-11]]))).all()


@pytest.mark.parametrize("name", CASES)
def test_kernels_write_zeros_where_there_is_no_image(name):
    from groma.cameras.dispatch import project, project_jacobian, unproject

    model, params = cameras.model(name), params_of(name)
    pixel, by_point, by_params = np.ones(2), np.ones((2, 3)), np.ones((2, model.num_parameters))
    bearing = np.ones(3)
    # Called from Python, the dispatch is plain Python around the kernels.
    assert not project(model.tag, params, np.zeros(3), pixel)
    assert not pixel.any()
    assert not project_jacobian(model.tag, params, np.zeros(3), pixel, by_point, by_params)
    assert not by_point.any()
    assert not by_params.any()
    assert not unproject(model.tag, params, np.array([np.nan, 0.0]), bearing)
    assert not bearing.any()


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
    ],
)
def test_strong_distortion_is_undone(name, extra, half_angle):
    model = cameras.model(name)
    focal = [400.0] * len(model.focal_indices)
    params = np.array([*focal, 320.0, 240.0, *extra])
    points = points_in_cone(np.random.default_rng(5), half_angle, 60)
    bearings = model.unproject(params, model.project(params, points))
    np.testing.assert_allclose(bearings, points / np.linalg.norm(points, axis=1, keepdims=True), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_one_camera_or_one_per_point(name):
    model, params = cameras.model(name), params_of(name)
    rng = np.random.default_rng(6)
    points = points_in_cone(rng, 0.5, 5)
    rows = params * (1 + 0.01 * rng.uniform(size=(5, len(params))))
    kept = rows.copy(), points.copy()
    pixels, by_point, by_params = model.project_jacobian(rows, points)
    for i in range(5):
        single = model.project_jacobian(rows[i], points[i : i + 1])
        for value, expected in zip((pixels[i], by_point[i], by_params[i]), single, strict=True):
            np.testing.assert_array_equal(value, expected[0])
        np.testing.assert_array_equal(model.unproject(rows, pixels)[i], model.unproject(rows[i], pixels[i : i + 1])[0])
    np.testing.assert_array_equal(rows, kept[0])
    np.testing.assert_array_equal(points, kept[1])
    np.testing.assert_allclose(model.focal_length(rows), rows[:, list(model.focal_indices)].mean(axis=1))
    assert model.project(params, np.empty((0, 3))).shape == (0, 2)
    # Other memory layouts and number types are converted.
    reverse = model.project(rows[::-1], np.asfortranarray(points)[::-1])[::-1]
    np.testing.assert_allclose(reverse, pixels, rtol=0, atol=1e-10)  # other kernel, other rounding
    assert model.project([int(value) for value in params], [[1, 2, 30]]).shape == (1, 2)


def test_focal_length_and_camera_matrix():
    K = cameras.PINHOLE.camera_matrix([500, 510, 320, 240])
    np.testing.assert_array_equal(K, [[500, 0, 320], [0, 510, 240], [0, 0, 1]])
    assert cameras.PINHOLE.focal_length([500, 510, 320, 240]) == 505
    np.testing.assert_array_equal(cameras.BAL.camera_matrix([[7.0, 1.0, 2.0]]), [np.diag([7.0, 7.0, 1.0])])


@pytest.mark.parametrize("name", CASES)
def test_undistorted_pixels_are_those_of_the_camera_matrix(name):
    model, params = cameras.model(name), params_of(name)
    points = points_in_cone(np.random.default_rng(7), min(CASES[name][1], 1.2))
    expected = points @ model.camera_matrix(params).T
    undistorted = model.undistort_pixels(params, model.project(params, points))
    np.testing.assert_allclose(undistorted, expected[:, :2] / expected[:, 2:], rtol=1e-10, atol=1e-9)


def test_undistortion_leaves_out_what_lies_behind():
    model, params = cameras.model("OPENCV_FISHEYE"), params_of("OPENCV_FISHEYE")
    pixels = model.project(params, np.array([[1.0, 0.0, -0.2], [1.0, 0.0, 0.2]]))
    undistorted = model.undistort_pixels(params, pixels)
    assert np.isnan(undistorted[0]).all()
    assert np.isfinite(undistorted[1]).all()


@pytest.mark.parametrize("name", CASES)
def test_bearing_noise(name):
    """G is the derivative of the bearing by the pixel, and the covariance is G S G^T with the bearing in its kernel."""
    model, params = cameras.model(name), params_of(name)
    pixels = model.project(params, points_in_cone(np.random.default_rng(8), CASES[name][1] * 0.9, 10))
    bearings, G = model.bearing_jacobian(params, pixels)
    step = 1e-3  # pixels: truncation (1e-3 / 500)^2, rounding 1e-16 / 1e-3, both below 1e-11 per pixel
    for j in range(2):
        moved = step * np.eye(2)[j]
        numeric = (model.unproject(params, pixels + moved) - model.unproject(params, pixels - moved)) / (2 * step)
        np.testing.assert_allclose(G[:, :, j], numeric, rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.einsum("ni,nij->nj", bearings, G), 0.0, rtol=0, atol=1e-16)
    same, covariance = model.bearing_covariance(params, pixels, 0.5)
    np.testing.assert_array_equal(same, bearings)
    np.testing.assert_allclose(covariance, 0.25 * np.einsum("nij,nkj->nik", G, G), rtol=1e-12, atol=1e-22)
    full = np.array([[0.04, 0.01], [0.01, 0.09]])
    _, covariance = model.bearing_covariance(params, pixels, np.tile(full, (10, 1, 1)))
    np.testing.assert_allclose(covariance, G @ full @ np.swapaxes(G, 1, 2), rtol=1e-12, atol=1e-22)
    _, covariance = model.bearing_covariance(params, pixels, np.arange(10.0))
    np.testing.assert_allclose(covariance[3], 9.0 * G[3] @ G[3].T, rtol=1e-12, atol=1e-22)


def test_bearing_noise_of_a_pinhole_in_closed_form():
    """On the axis a pixel is 1/f radians in every direction."""
    _, covariance = cameras.SIMPLE_PINHOLE.bearing_covariance([500, 320, 240], np.array([[320.0, 240.0]]), 2.0)
    np.testing.assert_allclose(covariance[0], np.diag([1.0, 1.0, 0.0]) * (2 / 500) ** 2, rtol=1e-14, atol=1e-22)


def test_pinhole_parameters():
    np.testing.assert_array_equal(cameras.SIMPLE_PINHOLE.pinhole_parameters([5, 3, 2]), [[5, 5, 3, 2]])
    np.testing.assert_array_equal(cameras.PINHOLE.pinhole_parameters([[5, 6, 3, 2]] * 2), [[5, 6, 3, 2]] * 2)
    for name in ("RADIAL", "OPENCV_FISHEYE"):
        assert not cameras.model(name).has_pinhole_parameters
        with pytest.raises(InputError, match=rf"without distortion \(SIMPLE_PINHOLE, PINHOLE\); got {name}.*bearing"):
            cameras.model(name).pinhole_parameters(params_of(name))


def test_denominator_of_zero_has_no_image():
    """FULL_OPENCV with 1 + k4 s = 0 at s = 1."""
    params = np.zeros(12)
    params[:2], params[9] = 500.0, -1.0
    for result in cameras.FULL_OPENCV.project_jacobian(params, np.array([[1.0, 0.0, 1.0]])):
        assert np.isnan(result).all()
    assert np.isnan(cameras.FULL_OPENCV.project(params, np.array([[1.0, 0.0, 1.0]]))).all()


@pytest.mark.parametrize("name", CASES)
def test_focal_length_of_zero_has_no_bearing(name):
    model = cameras.model(name)
    params = params_of(name)
    params[list(model.focal_indices)] = 0.0
    assert np.isnan(model.unproject(params, np.array([[1.0, 2.0]]))).all()


def test_messages():
    model = cameras.PINHOLE
    with pytest.raises(InputError, match=r"one of SIMPLE_PINHOLE, PINHOLE, .*got 'FISHY'"):
        cameras.model("FISHY")
    with pytest.raises(ShapeError, match=r"PINHOLE has the 4 parameters fx, fy, cx, cy; got an array of shape \(3,\)"):
        model.project(np.ones(3), np.ones((2, 3)))
    with pytest.raises(ShapeError, match=r"params must have shape \(4,\) or \(N, 4\) with N = 2; got \(3, 4\)"):
        model.project(np.ones((3, 4)), np.ones((2, 3)))
    with pytest.raises(ShapeError, match=r"4 parameters"):
        model.focal_length(5.0)
    with pytest.raises(ShapeError, match=r"points_in_cam must have shape \(N, 3\); got \(3, 5\).*points_in_cam.T"):
        model.project(np.ones(4), np.ones((3, 5)))
    with pytest.raises(ShapeError, match=r"pixels must have shape \(N, 2\)"):
        model.unproject(np.ones(4), np.ones(2))
    with pytest.raises(ShapeError, match=r"sigma must be"):
        model.bearing_covariance(np.ones(4), np.ones((3, 2)), np.ones(2))
