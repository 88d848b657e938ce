# SPDX-License-Identifier: BSD-3-Clause
"""Rigs of photographs: the file that describes them, its errors, and cameras placed on them by pycolmap."""

import json

import numpy as np
import pytest

from groma.errors import FileFormatError, InputError
from groma.geometry import quaternion
from groma.io.colmap.load import load_pycolmap
from groma.io.colmap.model import from_pycolmap
from groma.io.colmap.rigs import RigCamera, RigDescription, by_frames, camera_of, check_rigs, map_frames, read_rigs

LEFT = {"image_prefix": "left/", "ref_sensor": True}
RIGHT = {
    "image_prefix": "right/",
    "cam_from_rig_rotation": [0.0, 0.0, 1.0, 0.0],
    "cam_from_rig_translation": [0.0, 0.1, -0.2],
    "camera_model_name": "SIMPLE_PINHOLE",
    "camera_params": [500.0, 320.0, 240.0],
}
IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def written(folder, *cameras):
    path = folder / "rig_config.json"
    path.write_text(json.dumps([{"cameras": list(cameras)}]))
    return path


def test_a_file_says_where_cameras_sit_and_what_their_calibration_is(tmp_path):
    (rig,) = read_rigs(written(tmp_path, LEFT, RIGHT))
    assert rig.cameras[0] == RigCamera("left/", True, IDENTITY)
    pose, calibration = (0.0, 1.0, 0.0, 0.0, 0.0, 0.1, -0.2), ("SIMPLE_PINHOLE", (500.0, 320.0, 240.0))
    assert rig.cameras[1] == RigCamera("right/", False, pose, *calibration)
    assert rig.is_posed
    names = ["left/1.png", "left/2.png", "right/1.png", "right/2.png", "right/3.png", "other.png"]
    assert camera_of([rig], "right/2.png") is rig.cameras[1] and camera_of([rig], "other.png") is None
    assert by_frames([rig], names)[:5] == ["left/1.png", "right/1.png", "left/2.png", "right/2.png", "right/3.png"]
    assert check_rigs([rig], names) == "1 rig: 2 frames of several images, 1 frame of one image, 1 image of no rig."


@pytest.mark.parametrize(
    ("cameras", "words"),
    [
        ([RIGHT], "one camera with ref_sensor true; got 0"),
        ([LEFT, {**LEFT, "image_prefix": "b/"}], "got 2"),
        ([LEFT, {**RIGHT, "image_prefix": "left/x"}], "would also be images of"),
        ([LEFT, {**RIGHT, "cam_from_rig_rotation": [0.0, 0.0, 2.0, 0.0]}], "its length is 2"),
        ([LEFT, {**RIGHT, "cam_from_rig_rotation": [0.0, 1.0, 0.0]}], "4 finite numbers"),
        ([LEFT, {key: RIGHT[key] for key in ("image_prefix", "cam_from_rig_rotation")}], "or neither"),
        ([{**RIGHT, "ref_sensor": True}], "reference camera has a pose"),
        ([LEFT, {**RIGHT, "camera_params": [500.0]}], "3 finite numbers"),
        ([LEFT, {**RIGHT, "camera_model_name": "MIRROR"}], "a camera model of COLMAP"),
        ([LEFT, {**RIGHT, "image_prefix": 3}], "a text"),
    ],
)
def test_files_that_do_not_fit_are_refused(tmp_path, cameras, words):
    with pytest.raises(FileFormatError, match=words) as told:
        read_rigs(written(tmp_path, *cameras))
    assert "\n" not in str(told.value) and "rig_config.json" in str(told.value)


def test_images_that_do_not_fit_are_told(tmp_path):
    rigs = read_rigs(written(tmp_path, LEFT, RIGHT))
    with pytest.raises(InputError, match=r"images right/\.\.\., and there are none"):
        check_rigs(rigs, ["left/1.png", "1.png"])
    with pytest.raises(InputError, match="must be equal after the prefix"):
        check_rigs(rigs, ["left/l1.png", "right/r1.png"])


@pytest.mark.parametrize("known", [True, False])
def test_cameras_are_held_by_their_rig(tmp_path, known):
    """Frames of two cameras, synthesised with their matches; the second camera's place given, or found."""
    pycolmap = load_pycolmap()
    pycolmap.set_random_seed(1)
    settings = pycolmap.SyntheticDatasetOptions()
    settings.num_rigs, settings.num_cameras_per_rig, settings.num_frames_per_rig = 1, 2, 6
    settings.sensor_from_rig_translation_stddev = 0.3
    with pycolmap.Database.open(str(tmp_path / "database.db")) as content:
        truth = from_pycolmap(pycolmap.synthesize_dataset(settings, content))
        pycolmap.apply_rig_config([], content)  # images alone
    place = truth.sensors.cam_from_rig[~truth.sensors.is_reference.astype(bool)][0]
    prefixes = sorted({name[: name.index("_frame")] for name in truth.images.names})
    second = RigCamera(prefixes[1], False, tuple(place.tolist()) if known else None)
    rigs = [RigDescription((RigCamera(prefixes[0], True, IDENTITY), second))]
    assert check_rigs(rigs, truth.images.names) == "1 rig: 6 frames of several images."
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.ba_refine_sensor_from_rig = 1, False

    def attempt(database):
        return list(pycolmap.incremental_mapping(database, tmp_path, tmp_path / "models", options=options).values())

    (tmp_path / "models").mkdir()
    (model,) = map_frames(pycolmap, tmp_path / "database.db", rigs, attempt)
    scene = from_pycolmap(model)
    assert scene.num_images == 12 and len(scene.frames) == 6
    found = scene.sensors.cam_from_rig[scene.sensors.is_reference == 0][0]
    if known:
        np.testing.assert_allclose(found, place, atol=1e-12)
    else:  # its size is that of a map without a scale
        turn = quaternion.rotate(quaternion.conjugate(found[:4]), np.eye(3))
        np.testing.assert_allclose(turn, quaternion.rotate(quaternion.conjugate(place[:4]), np.eye(3)), atol=1e-3)
        cosine = found[4:] @ place[4:] / np.linalg.norm(found[4:]) / np.linalg.norm(place[4:])
        assert cosine > 0.999
