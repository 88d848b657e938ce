# SPDX-License-Identifier: BSD-3-Clause
"""Points, lines and bearings seen by a camera: values from geometry, scale of the line, degeneracies, errors.

The Jacobians of the examples are compared with differences in test_all_factors.py; here only for more camera models.
"""

import dataclasses

import numpy as np
import pytest

from groma.cameras import models
from groma.errors import InputError, ShapeError
from groma.factors.checks.check import check_factor
from groma.factors.contract import Example, Ref
from groma.factors.observations.line_bearing import LineBearing
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.point_reprojection import PointReprojection
from groma.geometry.manifold import Euclidean

pytestmark = pytest.mark.kernels

PINHOLE = np.array([[500.0, 480.0, 320.0, 240.0]])
IDENTITY = np.array([[1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]])


def evaluate(factor, *ambients):
    """Residual (N, m), all blocks side by side, number of degenerate factors."""
    sizes = [{12: 6}.get(a.shape[1], a.shape[1]) if k == 0 else a.shape[1] for k, a in enumerate(ambients)]
    columns = tuple(int(c) for c in np.cumsum([0, *sizes[:-1]]))
    record = np.full((len(factor), factor.residual_size, sum(sizes) + 1), np.nan)
    degenerate = factor.linearize(factor.prepare(ambients), 0, len(factor), columns, record)
    out = np.full((len(factor), factor.residual_size), np.nan)
    assert factor.residuals(factor.prepare(ambients), 0, len(factor), out) == degenerate
    np.testing.assert_allclose(out, record[:, :, -1], rtol=1e-13, atol=1e-13)
    return out, record[:, :, :-1], degenerate


def refs(*names, index=(0,)):
    return {name: Ref(name, np.array(index)) for name in names}


def point_factor(pixel=(0.0, 0.0), model="PINHOLE", **options):
    return PointReprojection(
        **refs("pose", "point", "intrinsics"), camera_model=model, pixels=np.array([pixel]), **options
    )


def line_factor(segment):
    return LineReprojection(
        **refs("pose", "line", "intrinsics"), camera_model="PINHOLE", segments=np.array([segment], dtype=float)
    )


def bearing_factor(first, second):
    return LineBearing(**refs("pose", "line"), start_bearings=np.array([first]), end_bearings=np.array([second]))


def plucker(first, second):
    return np.hstack([np.cross(first, second), np.subtract(second, first)])[None]


def random_rotation(rng):
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


# -------------------------------------------------------------------------------------------------------------- points


def test_point_residual_is_projection_minus_pixel():
    X = np.array([[0.5, -0.25, 2.0]])
    residual, _, degenerate = evaluate(point_factor((440.0, 170.0)), IDENTITY, X, PINHOLE)
    np.testing.assert_allclose(residual, [[500 * 0.25 + 320 - 440, -480 * 0.125 + 240 - 170]], atol=1e-12)
    assert degenerate == 0


@pytest.mark.parametrize("depth", [-2.0, -1e-9, 0.0])
def test_point_not_in_front_is_left_out_and_counted(depth):
    residual, blocks, degenerate = evaluate(point_factor((1.0, 2.0)), IDENTITY, np.array([[0.5, 0.1, depth]]), PINHOLE)
    assert degenerate == 1 and not residual.any() and not blocks.any()


def test_point_behind_takes_part_on_request():
    factor = point_factor((400.0, 200.0), require_in_front=False)
    residual, blocks, degenerate = evaluate(factor, IDENTITY, np.array([[0.5, 0.25, -2.0]]), PINHOLE)
    np.testing.assert_allclose(residual, [[-125 + 320 - 400, -60 + 240 - 200]], atol=1e-12)
    assert degenerate == 0 and blocks.any()
    _, _, degenerate = evaluate(factor, IDENTITY, np.array([[0.5, 0.25, 0.0]]), PINHOLE)
    assert degenerate == 1


def test_fisheye_sees_behind_itself():
    fisheye = np.array([[300.0, 300.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0]])
    X = np.array([[1.0, 0.0, -1.0]])  # 135 degrees off the axis
    residual, _, degenerate = evaluate(point_factor((0.0, 240.0), "OPENCV_FISHEYE"), IDENTITY, X, fisheye)
    assert degenerate == 0
    np.testing.assert_allclose(residual, [[300.0 * 0.75 * np.pi + 320.0, 0.0]], atol=1e-10)


@pytest.mark.filterwarnings("ignore:.*encountered in scalar:RuntimeWarning")  # NumPy's, without the compiler
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e308])
def test_points_that_are_no_numbers_give_zeros(bad):
    residual, blocks, degenerate = evaluate(point_factor(), IDENTITY, np.array([[bad, 1.0, 2.0]]), PINHOLE)
    assert degenerate == 1 and not residual.any() and not blocks.any()


@pytest.mark.parametrize("name", ["SIMPLE_PINHOLE", "OPENCV_FISHEYE"])
def test_point_jacobians_under_other_models(name):
    rng = np.random.default_rng(3)
    example = PointReprojection.example(rng)
    params = {
        "SIMPLE_PINHOLE": [[500.0, 320.0, 240.0], [400.0, 300.0, 200.0]],
        "OPENCV_FISHEYE": [[500.0, 510.0, 320.0, 240.0, 0.01, -0.02, 0.003, 0.001]] * 2,
    }[name]
    manifold = Euclidean(len(params[0]), "intrinsics")
    check_factor(
        Example(
            dataclasses.replace(example.factor, camera_model=name),
            {**example.variables, "intrinsics": (manifold, np.array(params))},
        )
    )


def test_intrinsics_follow_their_index():
    """Rows of intrinsics are cached inside the loop; switching back and forth must not mix them up."""
    index = np.array([0, 1, 1, 0, 1, 0])
    factor = PointReprojection(
        **refs("pose", "point", index=index * 0),
        intrinsics=Ref("intrinsics", index),
        camera_model="PINHOLE",
        pixels=np.zeros((6, 2)),
    )
    K = np.array([[500.0, 500.0, 0.0, 0.0], [100.0, 100.0, 7.0, 9.0]])
    residual, _, _ = evaluate(factor, IDENTITY, np.array([[1.0, 1.0, 2.0]]), K)
    np.testing.assert_allclose(residual, K[index][:, :2] * 0.5 + K[index][:, 2:])


# --------------------------------------------------------------------------------------------------------------- lines


def test_line_residual_is_signed_pixel_distance():
    rng = np.random.default_rng(0)
    for _ in range(20):
        R, t = random_rotation(rng), rng.normal(size=3)
        # Ends in the camera, from which the world is derived; the segment is measured beside their images.
        ends = rng.normal((0.0, 0.0, 5.0), 1.0, (2, 3))
        world = (ends - t) @ R
        images = PINHOLE[0, :2] * ends[:, :2] / ends[:, 2:] + PINHOLE[0, 2:]
        along = images[1] - images[0]
        normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        segment = np.hstack([images[0] + 3.0 * normal - 0.2 * along, images[1] - 1.5 * normal])
        pose = np.hstack([R, t[:, None]]).reshape(1, 12)
        residual, _, _ = evaluate(line_factor(segment), pose, plucker(*world), PINHOLE)
        np.testing.assert_allclose(np.abs(residual), [[3.0, 1.5]], rtol=1e-9)
        assert residual[0, 0] * residual[0, 1] < 0.0
        residual, _, _ = evaluate(line_factor(images.ravel()), pose, plucker(*world), PINHOLE)
        np.testing.assert_allclose(residual, 0.0, atol=1e-9)


def test_bearing_residual_is_the_sine_of_the_angle_to_the_plane():
    # The line y = 1, z = 4 along x spans with the centre a plane inclined by atan(1/4).
    line = plucker([0.0, 1.0, 4.0], [1.0, 1.0, 4.0])
    angle = np.arctan2(1.0, 4.0)
    for tilt in (0.0, 0.01, -0.3):
        bearing = [0.0, np.sin(angle + tilt), np.cos(angle + tilt)]
        on_line = [2.0, 1.0, 4.0]
        residual, _, _ = evaluate(bearing_factor(bearing, on_line), IDENTITY, line)
        np.testing.assert_allclose(np.abs(residual), [[np.sin(abs(tilt)), 0.0]], atol=1e-15)


@pytest.mark.parametrize("factor", ["pixels", "bearings"])
@pytest.mark.parametrize("scale", [1e-6, 12.5, 1e5, -1.0, -300.0])
def test_lines_have_no_scale(factor, scale):
    rng = np.random.default_rng(1)
    R = random_rotation(rng)
    pose = np.hstack([R, [[0.3], [-0.2], [6.0]]]).reshape(1, 12)
    line = plucker(rng.normal(size=3), rng.normal(size=3))
    if factor == "pixels":
        group, more = line_factor([100.0, 150.0, 300.0, 200.0]), (PINHOLE,)
    else:
        group, more = bearing_factor([0.1, 0.2, 1.0], [-0.3, 0.1, 1.0]), ()
    residual, blocks, _ = evaluate(group, pose, line, *more)
    scaled_residual, scaled_blocks, _ = evaluate(group, pose, scale * line, *more)
    sign = np.sign(scale)
    np.testing.assert_allclose(scaled_residual, sign * residual, rtol=1e-10)
    blocks = blocks * sign
    blocks[:, :, 6:12] /= scale
    np.testing.assert_allclose(scaled_blocks, blocks, rtol=1e-8, atol=1e-10 * np.abs(blocks).max())
    # Euler: a function of degree zero does not change along its argument.
    np.testing.assert_allclose(blocks[0, :, 6:12] @ line[0], 0.0, atol=1e-9 * np.abs(blocks).max())


@pytest.mark.parametrize("shift", [0.0, 1e-12])
def test_line_through_the_camera_centre_is_left_out_and_counted(shift):
    pose = np.array([[1.0, 0, 0, 0.4, 0, 1, 0, -0.7, 0, 0, 1, 2.0]])
    center = -pose[0, [3, 7, 11]]
    line = plucker(center + np.array([shift, 0.0, 0.0]), center + np.array([0.3, 0.1, 1.0]))
    for group, more in (
        (line_factor([1.0, 2.0, 3.0, 4.0]), (PINHOLE,)),
        (bearing_factor([0, 0, 1.0], [0, 1.0, 1.0]), ()),
    ):
        residual, blocks, degenerate = evaluate(group, pose, line, *more)
        assert degenerate == 1 and not residual.any() and not blocks.any()
    off = plucker(center + np.array([1e-4, 0.0, 0.0]), center + np.array([0.3, 0.1, 1.0]))
    residual, _, degenerate = evaluate(line_factor([1.0, 2.0, 3.0, 4.0]), pose, off, PINHOLE)
    assert degenerate == 0 and residual.any()


def test_line_in_the_plane_of_the_camera_centre_has_no_image():
    line = plucker([0.0, 1.0, 0.0], [1.0, 1.0, 0.0])
    residual, blocks, degenerate = evaluate(line_factor([1.0, 2.0, 3.0, 4.0]), IDENTITY, line, PINHOLE)
    assert degenerate == 1 and not residual.any() and not blocks.any()
    residual, _, degenerate = evaluate(bearing_factor([0.0, 0, 1], [0.0, 1, 1]), IDENTITY, line)
    assert degenerate == 0 and np.isfinite(residual).all()


def test_line_through_the_world_origin_is_an_ordinary_line():
    pose = np.array([[1.0, 0, 0, 0, 0, 1, 0, 0.5, 0, 0, 1, 4.0]])
    line = plucker([0.0, 0.0, 0.0], [1.0, 0.0, 0.2])
    residual, blocks, degenerate = evaluate(line_factor([100.0, 300.0, 400.0, 300.0]), pose, line, PINHOLE)
    assert degenerate == 0 and np.isfinite(blocks).all()
    assert np.linalg.matrix_rank(blocks[0, :, 6:12]) == 2 and residual.all()


# -------------------------------------------------------------------------------------------------------------- errors


def test_errors_say_what_to_do():
    with pytest.raises(InputError, match="PINHOLE"):
        point_factor(model="PINHOLES")
    with pytest.raises(ShapeError, match="pixels"):
        PointReprojection(**refs("pose", "point", "intrinsics"), camera_model="PINHOLE", pixels=np.zeros((2, 2)))
    with pytest.raises(ShapeError, match=r"point must have one index per factor, 1 like its pose; got 2"):
        PointReprojection(
            **refs("pose", "intrinsics"), **refs("point", index=(0, 1)), camera_model="PINHOLE", pixels=np.zeros((1, 2))
        )
    with pytest.raises(InputError, match="row 0 is"):
        point_factor((np.nan, 0.0))
    with pytest.raises(ShapeError, match="4 parameters; the group of intrinsics has 3"):
        evaluate(point_factor(), IDENTITY, np.ones((1, 3)), np.ones((1, 3)))
    with pytest.raises(InputError, match="bearing factor"):
        LineReprojection(**refs("pose", "line", "intrinsics"), camera_model="OPENCV", segments=np.zeros((1, 4)))
    with pytest.raises(InputError, match="must not be zero; row 0"):
        bearing_factor([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])


def test_every_model_without_distortion_serves_lines():
    for camera in models():
        if camera.has_pinhole_parameters:
            LineReprojection(**refs("pose", "line", "intrinsics"), camera_model=camera, segments=np.zeros((1, 4)))
