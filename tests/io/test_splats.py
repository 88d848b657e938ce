# SPDX-License-Identifier: BSD-3-Clause
"""The cameras.json of Gaussian splats, written here: rotations from camera to world by rows, camera centres."""

import json

import numpy as np
import pytest
from _views import HEIGHT, WIDTH, check_poses, views

from groma.errors import FileFormatError
from groma.io import read_scene, read_splats
from groma.io.pose_files import read_poses

LENS = {"width": WIDTH, "height": HEIGHT, "fx": 500.0, "fy": 505.0}


def document(true) -> list[dict]:
    """Return the entries of a file: names without their endings."""
    pairs = enumerate(zip(true.rotation, true.center, strict=True))
    return [
        {"id": row, "img_name": f"{row}", **LENS, "position": center.tolist(), "rotation": rotation.T.tolist()}
        for row, (rotation, center) in pairs
    ]


def write(folder, entries):
    (folder / "cameras.json").write_text(json.dumps(entries, indent=1))
    return folder / "cameras.json"


def test_cameras_and_poses(tmp_path):
    true = views()
    scene = read_scene(write(tmp_path, document(true)))
    check_poses(scene, true)
    assert scene.num_cameras == 1 and scene.cameras.models == ("PINHOLE",)
    np.testing.assert_array_equal(scene.cameras.params_of(0), [500.0, 505.0, WIDTH / 2, HEIGHT / 2])


def test_photographs_are_found_without_endings(tmp_path):
    path = write(tmp_path, document(views())[1:])
    found = read_poses(path, [f"{row}.jpg" for row in range(4)])
    assert found.names == ("1.jpg", "2.jpg", "3.jpg")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rotation": [[2.0, 0, 0], [0, 1, 0], [0, 0, 1]]}, "stretches"),
        ({"position": [0.0, 1.0]}, "position: expected 3 finite numbers"),
        ({"img_name": "0"}, "different 'img_name'"),
        ({"fx": 0.0}, "positive focal lengths"),
        ({"width": 0}, "camera 2: expected 'width', a size in pixels"),
    ],
)
def test_damage_is_named(tmp_path, change, words):
    entries = document(views())
    entries[1] |= change
    with pytest.raises(FileFormatError, match=words):
        read_splats(write(tmp_path, entries))
