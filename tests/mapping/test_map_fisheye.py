# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of a fisheye of ninety degrees to its corners, rendered: its calibration, and lines on the walls."""

import _facade
import numpy as np
import pytest

from groma.evaluation.poses import evaluate_poses
from groma.io.colmap.sfm import PointModelOptions, reconstruct_points
from groma.mapping.map import map_images
from groma.mapping.options import MapOptions


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A folder of them, and their model."""
    folder = tmp_path_factory.mktemp("fisheye") / "images"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_facade, "FOCAL", 220.0)
        return folder, _facade.facade(folder, 5, model="SIMPLE_RADIAL_FISHEYE", extra=(-0.02,))


def test_a_fisheye_is_mapped(photographs, tmp_path):
    folder, scene = photographs
    result = map_images(folder, tmp_path / "work", scene, MapOptions(threads=1))
    ends = result.scene.lines.segments
    assert len(ends) > 60
    normals = [np.cross(wall[1], wall[2]) / np.linalg.norm(np.cross(wall[1], wall[2])) for wall in _facade.WALLS]
    away = [np.abs((ends - wall[0]) @ normal).max(axis=1) for wall, normal in zip(_facade.WALLS, normals, strict=True)]
    # A pixel is 1/220 of the distance, which is five: 0.02; over short baselines several times that across the wall.
    assert np.median(np.min(away, axis=0)) < 0.02
    assert np.quantile(np.min(away, axis=0), 0.9) < 0.08
    assert set(result.scene.cameras.models) == {"SIMPLE_RADIAL_FISHEYE"}


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL_FISHEYE", "OPENCV_FISHEYE"])
def test_photographs_of_a_fisheye_that_nobody_calibrated_are_placed(photographs, tmp_path, model):
    """The walls are 5 units away, where half a pixel of one image is 0.01; the first guess is a focal length of 191."""
    folder, scene = photographs
    options = PointModelOptions(camera_model=model, threads=1)
    found = reconstruct_points(folder, tmp_path / "work", scene.images.names, options)
    assert found.num_images == 5 and found.cameras.params[0, 0] == pytest.approx(220.0, rel=0.01)
    assert evaluate_poses(found, scene).center_rmse < 0.01
