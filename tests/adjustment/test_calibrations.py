# SPDX-License-Identifier: BSD-3-Clause
"""Calibrations that cannot be those of the images: refused, or told, by the identifier of the camera."""

import numpy as np
import pytest

import groma
from groma.errors import InputError, ProblemError
from groma.io import read_scene, write_scene
from groma.scene import Scene
from groma.scene.synthetic import holistic

SHORT = groma.AdjustOptions(max_iterations=1, check_lens=False)


@pytest.fixture(scope="module")
def scene():
    return holistic(6, seed=2).start


def sized(scene: Scene, width: int, height: int) -> Scene:
    return scene.replace(cameras=scene.cameras.replace(width=[width], height=[height]))


def said(scene: Scene) -> list[str]:
    return [text for text in groma.adjust(scene, SHORT).report.warnings if text.startswith("Camera")]


def test_nothing_is_said_of_cameras_that_fit(scene):
    assert said(scene) == []


def test_a_camera_without_a_size_is_told(scene, tmp_path):
    write_scene(sized(scene, 0, 0), tmp_path / "model")
    (line,) = said(read_scene(tmp_path / "model"))
    assert line.startswith(f"Camera {scene.cameras.ids[0]} has no image size")


def test_a_size_that_is_half_known_is_refused(scene):
    with pytest.raises(InputError, match="0 x 768 pixels; width and height must both be positive"):
        sized(scene, 0, 768)


def test_observations_outside_the_image_are_told(scene):
    """Pixels spread evenly: an image of half the size leaves out three quarters, one of 0.8 times the size a third."""
    width, height = int(scene.cameras.width[0]), int(scene.cameras.height[0])
    points, lines = scene.point_observations, scene.line_observations
    image = np.random.default_rng(0).random((len(points), 2)) * [width, height]
    ends = np.random.default_rng(1).random((len(lines), 4)) * [width, height, width, height]
    spread = scene.replace(
        point_observations=points.replace(pixel=image), line_observations=lines.replace(segment=ends)
    )
    (line,) = said(sized(spread, width // 2, height // 2))
    assert f"outside the image of {width // 2} x {height // 2} pixels" in line
    assert said(sized(spread, 8 * width // 10, 8 * height // 10)) == []


@pytest.mark.parametrize("focal", [0.0, -800.0])
def test_a_focal_length_that_is_none_is_refused_by_the_name_of_the_camera(scene, focal):
    params = scene.cameras.params.copy()
    params[0, 0] = focal
    spoiled = scene.with_params(params)
    with pytest.raises(ProblemError, match=rf"^Camera {scene.cameras.ids[0]} \(PINHOLE\) needs positive focal lengths"):
        groma.adjust(spoiled)
