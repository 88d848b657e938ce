# SPDX-License-Identifier: BSD-3-Clause
"""Points and lines all around cameras that see behind themselves, adjusted: a fisheye of 200 degrees, and panoramas."""

import numpy as np
import pytest

import groma
from groma import cameras
from groma.evaluation.alignment import align_poses
from groma.geometry import quaternion
from groma.io.sequences.frame import SequenceCamera
from groma.scene import Cameras, LineObservations, Lines, PointObservations, Points, Scene
from groma.viz.drawable import drawable
from groma.viz.report.overlays import projected_places

NOISE = 0.3
CASES = {
    "EQUIRECTANGULAR": [2000.0, 1000.0],
    "RADIAL_FISHEYE": [320.0, 500.0, 500.0, -0.02, 0.001],
    "EUCM": [300.0, 300.0, 500.0, 500.0, 0.6, 1.1],
    "SIMPLE_DIVISION": [300.0, 500.0, 500.0, -0.3],
}
#: Half of the opening of the fisheyes: they see ten degrees behind their image plane.
HALF_ANGLE = np.deg2rad(100.0)


def room(name, seed=0, num_images=6, num_points=80, num_lines=30):
    """A room of points and lines with cameras in it that look about: the truth, and a start that is off."""
    rng = np.random.default_rng(seed)
    model, params = cameras.model(name), np.array(CASES[name])
    turns = quaternion.exp(rng.normal(0, 0.7, (num_images, 3)))
    poses = np.hstack([turns, -quaternion.rotate(turns, rng.uniform(-1.0, 1.0, (num_images, 3)))])
    wall = rng.uniform(-1.0, 1.0, (num_points + 2 * num_lines, 3))
    wall[np.arange(len(wall)), np.abs(wall).argmax(axis=1)] = rng.choice([-1.0, 1.0], len(wall))
    xyz, segments = 4.0 * wall[:num_points], 4.0 * wall[num_points:].reshape(-1, 2, 3)
    segments[:, 1] = segments[:, 0] + 1.5 * (segments[:, 1] - segments[:, 0]) / 4.0

    def seen(places):
        in_cam = quaternion.rotate(poses[:, None, :4], places[None]) + poses[:, None, 4:]
        angle = np.arctan2(np.hypot(in_cam[..., 0], in_cam[..., 1]), in_cam[..., 2])
        pixels = model.project(params, in_cam.reshape(-1, 3)).reshape(*in_cam.shape[:2], 2)
        return pixels, (angle < HALF_ANGLE) | (not model.is_planar), in_cam[..., 2]

    xyz = xyz[seen(xyz)[1].sum(axis=0) >= 3]
    segments = segments[(seen(segments[:, 0])[1] & seen(segments[:, 1])[1]).sum(axis=0) >= 3]
    pixels, visible, depth = seen(xyz)
    image, point = np.nonzero(visible)
    ends = [seen(segments[:, k]) for k in (0, 1)]
    line_image, line = np.nonzero(ends[0][1] & ends[1][1])
    first, second = (ends[k][0][line_image, line] for k in (0, 1))
    # An end beyond the border of a panorama, rather than on the other side of it.
    second = first + model.pixel_difference(params, second, first)
    size = np.array([2000 if name == "EQUIRECTANGULAR" else 1000])
    truth = Scene.from_images(
        Cameras(np.ones(1, int), (name,), params[None], size, np.full(1, 1000)),
        [f"{k}.png" for k in range(num_images)],
        np.zeros(num_images, int),
        poses,
        points=Points.at(xyz),
        point_observations=PointObservations.numbered(
            image, point, pixels[image, point] + rng.normal(0, NOISE, (len(image), 2))
        ),
        lines=Lines.through(segments),
        line_observations=LineObservations(
            line_image, line, np.hstack([first, second]) + rng.normal(0, NOISE, (len(line), 4))
        ),
    )
    moved = poses.copy()
    moved[:, :4] = quaternion.multiply(quaternion.exp(rng.normal(0, 0.01, (num_images, 3))), poses[:, :4])
    moved[:, 4:] += rng.normal(0, 0.03, (num_images, 3))
    start = truth.replace(
        points=truth.points.replace(xyz=xyz + rng.normal(0, 0.05, xyz.shape)),
        lines=Lines.through(segments + rng.normal(0, 0.05, segments.shape)),
    ).with_poses(moved)
    return truth, start, depth[image, point]


def center_error(scene, truth):
    similarity = align_poses(scene.cam_from_world, truth.cam_from_world)
    return np.abs(similarity.points(scene.cam_centers_in_world) - truth.cam_centers_in_world).max()


@pytest.mark.parametrize("residual", ["endpoints", "bearing"])
@pytest.mark.parametrize("name", CASES)
def test_everything_around_is_adjusted_down_to_its_noise(name, residual):
    truth, start, depth = room(name)
    assert (depth < 0).mean() > (0.3 if name == "EQUIRECTANGULAR" else 0.02)
    result = groma.adjust(start, groma.AdjustOptions(loss="none", line_residual=residual))
    report = result.report
    assert report.solve.converged
    assert report.solve.num_degenerate == {}
    assert report.num_observations == len(depth) + len(truth.line_observations)
    # Of the points two numbers for each observation remain, less three for a point and six for a camera.
    share = np.sqrt(1.0 - (3.0 * truth.num_points + 6.0 * 6 - 7.0) / (2.0 * len(depth)))
    assert report.rmse_px["points"]["after"] == pytest.approx(NOISE * np.sqrt(2) * share, rel=0.1)
    assert report.rmse_px["points"]["before"] > 5.0
    # Both ends across, less four for a line.
    share = np.sqrt(1.0 - 4.0 * truth.num_lines / (2.0 * len(truth.line_observations)))
    assert report.rmse_px["lines"]["after"] == pytest.approx(NOISE * np.sqrt(2) * share, rel=0.15)
    # A pixel is three milliradians at most, four units away, and each camera has a hundred measurements.
    assert center_error(result.scene, truth) < 5e-3


def test_calibration_is_estimated_where_it_is_not_known():
    """Of a fisheye the focal length comes back, from points; the size of a panorama is no unknown."""
    truth, start, _ = room("RADIAL_FISHEYE", num_points=200)
    right = truth.cameras.params
    options = groma.AdjustOptions(loss="none", refine_intrinsics=True, lines=False)
    found = groma.adjust(start.with_params(right * [1.01, 1, 1, 1, 1]), options).scene.cameras.params
    assert abs(found[0, 0] / right[0, 0] - 1) < 2e-3
    np.testing.assert_allclose(found[0, 1:3], right[0, 1:3], atol=0.5)  # the middle, which counts as a guess
    truth, start, _ = room("EQUIRECTANGULAR", num_images=4)
    result = groma.adjust(start, options)
    np.testing.assert_array_equal(result.scene.cameras.params, truth.cameras.params)
    assert result.report.rmse_px["points"]["after"] < 2 * NOISE


@pytest.mark.parametrize("name", ["EQUIRECTANGULAR", "RADIAL_FISHEYE"])
def test_lines_alone_hold_the_cameras(name):
    truth, start, _ = room(name, num_lines=60)
    result = groma.adjust(start, groma.AdjustOptions(loss="none", line_residual="bearing", points=False))
    assert center_error(start, truth) > 0.03
    assert center_error(result.scene, truth) < 0.015


def test_points_at_the_border_of_a_panorama():
    """One measured at the right border and predicted at the left one is a pixel off, not two thousand."""
    truth, _, _ = room("EQUIRECTANGULAR")
    behind = np.array([[1e-4, 0.3, -2.0], [-1e-4, -0.2, -3.0]])
    scene = Scene.from_images(
        truth.cameras,
        ["a.png"],
        np.zeros(1, int),
        np.array([[0.0, 0, 0, 1, 0, 0, 0]]),
        points=Points.at(behind),
        point_observations=PointObservations.numbered(
            np.zeros(2, int), np.arange(2), np.array([[0.4, 547.4], [1999.5, 478.8]])
        ),
    )
    result = groma.adjust(scene, groma.AdjustOptions(loss="none", refine_poses=False, max_iterations=1))
    assert 0.1 < result.report.rmse_px["points"]["before"] < 1.0
    residual = drawable(scene).residuals
    assert 0.1 < np.abs(residual).max() < 1.0


def test_lines_are_drawn_all_around_a_panorama():
    """As curves in one piece, also behind the camera and across the border, through the measured ends."""
    truth, _, _ = room("EQUIRECTANGULAR")
    places = projected_places(truth, 2, np.arange(truth.num_lines))
    curves = [row[kept] for row, kept in zip(*places, strict=True)]
    seen = truth.line_observations
    of_image = np.flatnonzero(seen.image_idx == 2)
    assert len(curves) == truth.num_lines == len(of_image)
    for row in of_image:
        curve, segment = curves[seen.line_idx[row]], seen.segment[row].reshape(2, 2)
        assert np.abs(np.diff(curve[:, 0])).max() < 1000
        np.testing.assert_allclose(curve[[0, -1]], segment, rtol=0, atol=6 * NOISE)
    assert any((curve[:, 0] < 500).any() or (curve[:, 0] > 1500).any() for curve in curves)


def test_a_panorama_without_size_is_refused():
    _, start, _ = room("EQUIRECTANGULAR")
    with pytest.raises(groma.ProblemError, match=r"EQUIRECTANGULAR.*positive width and height.*\[0.0, 1000.0\]"):
        groma.adjust(start.with_params(np.array([[0.0, 1000.0]])))


def test_a_panorama_is_not_followed():
    with pytest.raises(groma.InputError, match=r"EQUIRECTANGULAR images are panoramas"):
        SequenceCamera("EQUIRECTANGULAR", np.array([2000.0, 1000.0]), 2000, 1000)
