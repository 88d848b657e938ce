# SPDX-License-Identifier: BSD-3-Clause
"""Covers lines against silhouettes of an object: distances known by construction, masks from files, the command."""

import json

import cv2
import numpy as np
import pytest

from groma.cli.main import run
from groma.errors import InputError
from groma.evaluation.silhouettes import evaluate_silhouettes, read_silhouettes
from groma.io import write_scene
from groma.scene import Cameras, LineIntervals, Lines, Scene


@pytest.fixture
def scene():
    """Two views along z of lines at depth 10, where a unit is 10 pixels; the second from 3 units farther right."""
    ends = [[[-2.0, 0, 10], [2, 0, 10]], [[-2, 0, 10], [5.5, 0, 10]], [[-2, 1, 10], [2, 1, -10]]]
    cameras = Cameras(ids=[1], models=("PINHOLE",), params=[[100.0, 100, 50, 50]], width=[100], height=[100])
    poses = [[0.0, 0, 0, 1, 0, 0, 0], [0, 0, 0, 1, -3, 0, 0]]
    return Scene.from_images(cameras, ["a.png", "b.png"], [0, 0], poses, lines=Lines.through(ends))


def mask(right):
    """The object reaches from the left border to column ``right``."""
    picture = np.zeros((100, 100), bool)
    picture[:, :right] = True
    return picture


def test_distances_from_the_silhouette(scene):
    found = evaluate_silhouettes(scene, {"a.png": mask(90)})
    # The second line ends at pixel 105, outside of the frame; within it the last place is in column 99.
    assert found.distance[0] == 0.0 and found.distance[1] == pytest.approx(10.0)
    assert found.num_views == 1
    both = evaluate_silhouettes(scene, {"a.png": mask(90), "b.png": mask(70)})
    np.testing.assert_allclose(both.distance[:2], [0.0, 10.0])  # in b it ends at 75, 5 outside
    assert evaluate_silhouettes(scene, {"b.png": mask(70)}).distance[1] == pytest.approx(5.0)
    assert both.to_dict()["outside_px"]["3"] >= 1
    with pytest.raises(InputError, match="No image of the scene has a silhouette"):
        evaluate_silhouettes(scene, {"c.png": mask(10)})


def test_a_mask_without_the_object_tells_nothing(scene):
    both = evaluate_silhouettes(scene, {"a.png": mask(90), "b.png": mask(0)})
    assert both.num_views == 1 and both.distance[1] == pytest.approx(10.0)
    with pytest.raises(InputError, match="No image of the scene has a silhouette"):
        evaluate_silhouettes(scene, {"b.png": mask(0)})


def test_gaps_and_what_lies_behind_the_camera_do_not_count(scene):
    gap = scene.replace(line_intervals=LineIntervals([1, 1], [0.0, 0.5], [0.2, 0.8]))
    assert evaluate_silhouettes(gap, {"a.png": mask(90)}).distance[1] == 0.0
    assert np.isfinite(evaluate_silhouettes(scene, {"a.png": mask(90)}).distance[2])


def test_masks_of_another_size(scene):
    large = cv2.resize(mask(90).astype(np.uint8), (200, 200), interpolation=cv2.INTER_NEAREST) > 0
    assert evaluate_silhouettes(scene, {"a.png": large}).distance[1] == pytest.approx(10.0, abs=0.5)


def test_the_command(scene, tmp_path, capsys):
    folder = tmp_path / "masks"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), mask(90).astype(np.uint8) * 255)
    write_scene(scene, tmp_path / "lines.npz")
    asked = ["evaluate", "lines", str(tmp_path / "lines.npz"), "--silhouettes", str(folder)]
    assert run([*asked, "--json", str(tmp_path / "scores.json")]) == 0
    numbers = json.loads((tmp_path / "scores.json").read_text())["silhouettes"]
    assert numbers["num_views"] == 1 and numbers["outside_px"] == {"1": 1, "3": 1, "10": 0}
    assert "leave it by more than" in capsys.readouterr().out
    assert run(asked[:3]) == 1
    assert "nothing to compare with" in capsys.readouterr().err
    (folder / "b.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"b\.png is not an image"):
        read_silhouettes(folder, scene.images.names)
    with pytest.raises(InputError, match="is not a folder"):
        read_silhouettes(folder / "a.png", scene.images.names)
