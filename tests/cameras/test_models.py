# SPDX-License-Identifier: BSD-3-Clause
"""Covers the camera models: values against COLMAP's, derivatives, inverse, limits of validity, shapes and errors.

Reference values come from pycolmap at run time. Tolerance 1e-9 px: both sides evaluate the same closed form in float64
at coordinates of about 1000 px, where one rounding is 1e-13 px.
"""

import numpy as np
import pycolmap
import pytest
from _cases import CASES, PERSPECTIVE, PLANAR, params_of, points_in_cone

from groma import cameras
from groma.cameras.check import check_camera
from groma.errors import InputError, ShapeError

pytestmark = pytest.mark.kernels


def colmap_camera(name):
    """COLMAP's camera of the same model; BAL is RADIAL with the principal point at zero."""
    params = CASES[name][0]
    if name == "BAL":
        name, params = "RADIAL", [params[0], 0.0, 0.0, *params[1:]]
    return pycolmap.Camera(model=name, width=640, height=480, params=params)


def test_has_every_model_of_colmap():
    """All 18 of pycolmap, under its names and with its parameters in its order."""
    theirs = {name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"}
    assert {model.colmap_name for model in cameras.models()} - {None} == theirs
    assert len(theirs) == 18


def test_every_model_has_a_case():
    assert {model.name for model in cameras.models()} == set(CASES)


@pytest.mark.parametrize("name", CASES)
def test_keeps_its_promises(name):
    check_camera(cameras.model(name), params_of(name), np.random.default_rng(1), half_angle=CASES[name][1])


@pytest.mark.parametrize("name", CASES)
def test_describes_its_parameters_as_colmap_does(name):
    model = cameras.model(name)
    indices = (*model.focal_indices, *model.principal_point_indices, *model.extra_indices, *model.known_indices)
    assert model.known_indices == ((0, 1) if name == "EQUIRECTANGULAR" else ())
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


@pytest.mark.parametrize("name", [name for name in CASES if name not in PERSPECTIVE])
def test_directions_behind_the_image_plane_come_back(name):
    """Where the model reaches there, the inverse finds them; straight back nothing has an image."""
    model, params = cameras.model(name), params_of(name)
    points = points_in_cone(np.random.default_rng(9), 3.0, 200)
    points = points[points[:, 2] < 0]
    pixels = model.project(params, points)
    seen = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    back = model.unproject(params, pixels[seen])
    found = np.isfinite(back).all(axis=1)  # the distortion may have folded before
    np.testing.assert_allclose(model.project(params, back[found]), pixels[seen][found], rtol=1e-12, atol=1e-9)
    if name in ("SIMPLE_FISHEYE", "FISHEYE", "EQUIRECTANGULAR", "SIMPLE_DIVISION", "EUCM"):
        np.testing.assert_allclose(back, points[seen] / np.linalg.norm(points[seen], axis=1)[:, None], atol=1e-10)
        assert len(seen) > (10 if name == "EUCM" else 0.9 * len(points))
    elif name == "DIVISION":  # pincushion: nothing behind
        assert len(seen) == 0
    if name != "EQUIRECTANGULAR":
        for result in model.project_jacobian(params, np.array([[0.0, 0.0, -1.0], [1e-12, 0.0, -1.0]])):
            assert np.isnan(result).all()


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
    if model.is_planar:
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


@pytest.mark.parametrize("name", PLANAR)
def test_undistorted_pixels_are_those_of_the_camera_matrix(name):
    model, params = cameras.model(name), params_of(name)
    points = points_in_cone(np.random.default_rng(7), min(CASES[name][1], 1.2))
    expected = points @ model.camera_matrix(params).T
    undistorted = model.undistort_pixels(params, model.project(params, points))
    np.testing.assert_allclose(undistorted, expected[:, :2] / expected[:, 2:], rtol=1e-10, atol=1e-9)


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


def test_pinhole_parameters():
    np.testing.assert_array_equal(cameras.SIMPLE_PINHOLE.pinhole_parameters([5, 3, 2]), [[5, 5, 3, 2]])
    np.testing.assert_array_equal(cameras.PINHOLE.pinhole_parameters([[5, 6, 3, 2]] * 2), [[5, 6, 3, 2]] * 2)
    for name in ("RADIAL", "OPENCV_FISHEYE"):
        assert not cameras.model(name).has_pinhole_parameters
        with pytest.raises(InputError, match=f"without distortion, such as PINHOLE; got {name}.*bearing"):
            cameras.model(name).pinhole_parameters(params_of(name))


@pytest.mark.parametrize("name", PLANAR)
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
