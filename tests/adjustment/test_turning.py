# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of unknown calibration that only turned: told where they did, and only there."""

import re

import numpy as np
import pytest

import groma
from groma.adjustment.misfit.turning import motion_that_may_be_turning
from groma.cameras import model as camera_model
from groma.geometry import quaternion, se3
from groma.scene import CameraPositions, Cameras, PointObservations, Points, PrincipalPointPriors, Scene

SIZE, NOISE = (1000, 800), 0.3
#: Within which one in a hundred observations of this noise are not.
FIT = {"points": {"limit_px": 0.9}}
LENS = np.array([500.0, 500.0, 400.0, -0.12])


def photographs(base: float, seed: int) -> Scene:
    """Twelve images of a room by a wide lens, turned by up to 20 degrees, from places of a cube of side ``base``."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-6.0, -6.0, 3.0], [6.0, 6.0, 15.0], (400, 3))
    turn = quaternion.exp(rng.uniform(-0.35, 0.35, (12, 3)) * [1.0, 1.0, 0.3])
    poses = np.hstack([turn, -quaternion.rotate(turn, base * rng.uniform(-0.5, 0.5, (12, 3)))])
    image, point, pixel = [], [], []
    for row, pose in enumerate(poses):
        inside = se3.transform_points(np.repeat(pose[None], len(xyz), axis=0), xyz)
        seen = camera_model("SIMPLE_RADIAL").project(LENS, inside)
        rows = np.flatnonzero((inside[:, 2] > 0.5) & (seen > 0.0).all(1) & (seen < SIZE).all(1))
        image.append(np.full(len(rows), row)), point.append(rows), pixel.append(seen[rows])
    image, point, pixel = (np.concatenate(part) for part in (image, point, pixel))
    pixel += rng.normal(0.0, NOISE, pixel.shape)
    scene = Scene.from_images(
        Cameras([1], ("SIMPLE_RADIAL",), LENS[None], [SIZE[0]], [SIZE[1]]), [f"{row}.png" for row in range(12)],
        np.zeros(12, int), poses, points=Points.at(xyz),
        point_observations=PointObservations.numbered(image, point, pixel),
    )  # fmt: skip
    return scene.keep(points=np.bincount(point, minlength=len(xyz)) > 1)


@pytest.mark.parametrize("seed", range(3))
def test_a_camera_that_only_turned_is_told_with_its_focal_length(seed):
    """The focal length of one image is known to some pixels: the noise of a point by the root of their number."""
    said = motion_that_may_be_turning(photographs(0.0, seed), True, FIT)
    assert said is not None
    assert abs(float(re.search(r"focal length of (\d+) instead of 500", said)[1]) - LENS[0]) < 5.0


@pytest.mark.parametrize("seed", range(3))
def test_a_camera_that_moved_is_not(seed):
    """By half a unit at distances of 3 to 15: a parallax of tens of pixels."""
    assert motion_that_may_be_turning(photographs(0.5, seed), True, FIT) is None


def test_too_little_is_not_judged():
    scene = photographs(0.0, 0)
    for less in (scene.subset([0]), scene.keep(points=np.arange(scene.num_points) < 10)):
        assert motion_that_may_be_turning(less, True, FIT) is None
    sizes = scene.cameras.replace(width=np.zeros(1, int), height=np.zeros(1, int))
    assert motion_that_may_be_turning(scene.replace(cameras=sizes), True, FIT) is None
    assert motion_that_may_be_turning(scene, True, {}) is None


def test_it_is_said_where_neither_calibration_nor_motion_is_known():
    turned = photographs(0.001, 0)
    prior = PrincipalPointPriors([0], np.array([[500.0, 400.0]]), np.array([5.0]))
    positions = CameraPositions(np.arange(12), turned.cam_centers_in_world, np.tile(np.eye(3) * 1e-8, (12, 1, 1)))
    for scene, refine, said in (
        (turned, True, True),
        (turned.replace(principal_point_priors=prior), None, True),
        (turned, None, False),
        (turned, False, False),
        (turned.replace(camera_positions=positions), True, False),
    ):
        report = groma.adjust(scene, groma.AdjustOptions(refine_intrinsics=refine)).report
        assert any("may only have turned" in text for text in report.warnings) == said
