# SPDX-License-Identifier: BSD-3-Clause
"""Photographs made smaller or larger than the cameras of a model: which are taken for that, and what moves."""

import numpy as np
import pytest

from groma import cameras
from groma.errors import InputError
from groma.geometry import se3
from groma.mapping.photographs import check_images
from groma.mapping.posed.given import in_pixels_of
from groma.scene import Cameras, Keypoints, PointObservations, Points, Scene

cv2 = pytest.importorskip("cv2")
SIZE = (643, 482)


def _silent(*_) -> None:
    pass


def photographs(folder, sizes: dict[str, tuple[int, int]]) -> None:
    for name, (width, height) in sizes.items():
        cv2.imwrite(str(folder / name), np.zeros((height, width), np.uint8))


def scene_of(model: str, params: list[float]) -> Scene:
    """Two images of 20 points, observed where they are."""
    poses = np.array([[0.0, 0, 0, 1, 0, 0, 4], [0, 0.1, 0, 0.99498744, -0.3, 0.1, 4.2]])
    xyz = np.random.default_rng(3).uniform(-1.0, 1.0, (20, 3))
    image, point = np.repeat([0, 1], 20), np.tile(np.arange(20), 2)
    pixel = cameras.model(model).project(np.array(params), se3.transform_points(poses[image], xyz[point]))
    return Scene.from_images(
        Cameras.of([1], [model], [params], [SIZE]),
        ["a.png", "b.png"],
        np.zeros(2, np.int64),
        poses,
        points=Points.at(xyz),
        point_observations=PointObservations.numbered(image, point, pixel),
    ).replace(keypoints=Keypoints(np.array([1]), np.array([[100.0, 200.0]]), np.array([20])))


def slip(scene: Scene) -> float:
    """Return the largest distance of an observation from its projection, pixels."""
    seen = scene.point_observations
    in_cam = se3.transform_points(scene.cam_from_world[seen.image_idx], scene.points.xyz[seen.point_idx])
    pixel = cameras.model(scene.cameras.models[0]).project(scene.cameras.params_of(0), in_cam)
    return float(np.linalg.norm(pixel - seen.pixel, axis=1).max())


@pytest.mark.parametrize("size", [(161, 121), (160, 120), (322, 241), (1286, 964)])
@pytest.mark.parametrize(
    ("model", "params", "allowed"),
    [
        ("OPENCV", [500.0, 510.0, 320.0, 238.0, 0.05, -0.01, 0.001, -0.002], 1e-9),
        ("SIMPLE_RADIAL", [500.0, 320.0, 238.0, -0.05], 0.6),  # one focal length for two scales, half a pixel of 120
    ],
)
def test_cameras_and_observations_are_scaled_together(tmp_path, size, model, params, allowed):
    scene = scene_of(model, params)
    photographs(tmp_path, dict.fromkeys(scene.images.names, size))
    found, said = in_pixels_of(scene, tmp_path)
    assert slip(found) < allowed and found.cameras.width.tolist() == [size[0]]
    assert "were scaled with them" in said[0]
    expected = np.array([100.0, 200.0]) * size / SIZE
    np.testing.assert_allclose(found.keypoints.pixel, [expected], rtol=1e-12)
    assert set(check_images(tmp_path, [], found, _silent).values()) == {size}


@pytest.mark.parametrize("sizes", [[(161, 118)] * 2, [(642, 482)] * 2, [(161, 121), (322, 241)], [(241, 322)] * 2])
def test_other_proportions_and_several_sizes_are_still_refused(tmp_path, sizes):
    scene = scene_of("PINHOLE", [500.0, 510.0, 320.0, 238.0])
    photographs(tmp_path, dict(zip(scene.images.names, sizes, strict=True)))
    found, said = in_pixels_of(scene, tmp_path)
    assert found is scene and not said
    with pytest.raises(InputError, match="Pass the images the model was made from"):
        check_images(tmp_path, [], found, _silent)


def test_photographs_of_the_same_size_and_missing_ones_change_nothing(tmp_path):
    scene = scene_of("PINHOLE", [500.0, 510.0, 320.0, 238.0])
    assert in_pixels_of(scene, tmp_path)[0] is scene
    photographs(tmp_path, {"a.png": SIZE})
    assert in_pixels_of(scene, tmp_path)[0] is scene
