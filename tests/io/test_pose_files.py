# SPDX-License-Identifier: BSD-3-Clause
"""Files of poses of photographs: which pose belongs to which, what is said, and what is refused."""

import json

import cv2
import numpy as np
import pytest

from groma.errors import FileFormatError, InputError
from groma.geometry import quaternion, se3
from groma.io import write_colmap, write_g2o, write_scene, write_trajectory
from groma.io.colmap.calibrations import cameras_of_photographs
from groma.io.colmap.sfm import PointModelOptions
from groma.io.pose_files import read_poses
from groma.io.trajectories import Trajectory
from groma.mapping.posed.given import scene_at_poses
from groma.scene import Cameras, Scene
from groma.scene.pose_graph import GraphPoses, Motions, PoseGraph

COUNT = 6
NAMES = tuple(f"frame_{k}.jpg" for k in (1, 2, 3, 9, 10, 11))


@pytest.fixture
def scene():
    rng = np.random.default_rng(0)
    poses = np.hstack([quaternion.exp(rng.normal(0.0, 0.4, (COUNT, 3))), rng.normal(0.0, 3.0, (COUNT, 3))])
    cameras = Cameras(
        np.array([1]), ("SIMPLE_PINHOLE",), np.array([[50.0, 40.0, 30.0]]), np.array([80]), np.array([60])
    )
    return Scene.from_images(cameras, NAMES, np.zeros(COUNT, int), poses)


def trajectory(scene, times):
    return Trajectory(np.asarray(times, float), se3.inverse(scene.cam_from_world))


def agree(found, names, poses):
    assert found.names == tuple(names)
    turned = quaternion.to_matrix(found.cam_from_world[:, :4]) - quaternion.to_matrix(poses[:, :4])
    assert max(np.abs(turned).max(), np.abs(found.cam_from_world[:, 4:] - poses[:, 4:]).max()) < 1e-9


def test_models_give_poses_and_calibration_by_name(tmp_path, scene):
    write_colmap(scene, tmp_path / "model")
    write_scene(scene, tmp_path / "transforms.json")
    for source in ("model", "transforms.json"):
        found = read_poses(tmp_path / source, [*NAMES, "other.jpg"])
        agree(found, NAMES, scene.cam_from_world)
        assert found.cameras is not None and found.cameras.models[found.camera_idx[0]] == "SIMPLE_PINHOLE"
        assert found.sentences == ()
    inner = read_poses(tmp_path / "model", [f"left/{name}" for name in NAMES])
    assert inner.names[0] == "left/frame_1.jpg"
    words = "6 names of images were found without folder or ending, such as frame_1.jpg for left/frame_1.jpg."
    assert inner.sentences == (f"{tmp_path / 'model'}: {words}",)
    converted = read_poses(tmp_path / "model", [f"{name[:-4]}.PNG" for name in NAMES[1:]])
    assert converted.names[0] == "frame_2.PNG" and "without folder or ending" in converted.sentences[0]
    assert "1 of 6 poses in" in converted.sentences[1] and "'frame_1.jpg'" in converted.sentences[1]
    # A folder around all, as in transforms.json of other programs, and files of one name in two folders.
    names = tuple(f"images/{k % 2}/{k // 2}.jpg" for k in range(COUNT))
    write_colmap(scene.replace(images=scene.images.replace(names=names)), tmp_path / "around")
    there = [name.removeprefix("images/") for name in names[:4]]
    agree(read_poses(tmp_path / "around", there), there, scene.cam_from_world[:4])


def test_names_that_do_not_tell_are_refused(tmp_path, scene):
    write_colmap(scene, tmp_path / "model")
    with pytest.raises(InputError, match=r"None of the 6 names .* 'frame_1.jpg', here 'a.jpg'"):
        read_poses(tmp_path / "model", ["a.jpg"])
    with pytest.raises(InputError, match=r"which pose in .* is whose: .* fits 'frame_1.jpg'"):
        read_poses(tmp_path / "model", ["a/frame_1.jpg", "b/frame_1.jpg"])
    twice = scene.replace(images=scene.images.replace(names=tuple(f"{k}/frame_1.jpg" for k in range(COUNT))))
    write_colmap(twice, tmp_path / "twice")
    with pytest.raises(InputError, match=r"has 6 poses for the photograph 'frame_1.jpg'"):
        read_poses(tmp_path / "twice", ["frame_1.jpg"])


def test_trajectories_by_time_and_by_order(tmp_path, scene):
    times = 1305031102.0 + 0.1 * np.arange(COUNT)
    write_trajectory(trajectory(scene, times), tmp_path / "poses.txt")
    names = [f"{time + 0.004:.4f}.png" for time in times[1:]]
    found = read_poses(tmp_path / "poses.txt", names)
    agree(found, names, scene.cam_from_world[1:])
    assert found.cameras is None and "4 ms away" in found.sentences[0]
    nanoseconds = [f"{round(time * 1e9)}.png" for time in times]
    agree(read_poses(tmp_path / "poses.txt", nanoseconds), nanoseconds, scene.cam_from_world)
    # As many as photographs: in the order of their numbers, 2 before 10.
    found = read_poses(tmp_path / "poses.txt", sorted(NAMES))
    agree(found, NAMES, scene.cam_from_world)
    assert "in the order of their names" in found.sentences[0]
    with pytest.raises(
        InputError, match=r"which of the 6 poses in .* there are 5 photographs, .* not times of the file"
    ):
        read_poses(tmp_path / "poses.txt", NAMES[1:])


def test_lines_of_kitti_and_ids_of_a_graph_are_numbers_in_names(tmp_path, scene):
    write_trajectory(trajectory(scene, np.arange(COUNT)), tmp_path / "kitti.txt", "kitti")
    names = ["000000.png", "000002.png", "000005.png"]
    found = read_poses(tmp_path / "kitti.txt", names)
    agree(found, names, scene.cam_from_world[[0, 2, 5]])
    assert "taken as lines" in found.sentences[0]
    with pytest.raises(InputError, match="not lines, counted from 0 of the file"):
        read_poses(tmp_path / "kitti.txt", ["000001.png", "000006.png"])
    ids = np.array([11, 10, 9, 3, 2, 1])
    poses = GraphPoses(ids, se3.inverse(scene.cam_from_world)[::-1])
    still = np.array([[0, 0, 0, 1, 0, 0, 0.0]])
    motion = Motions(np.array([0]), np.array([1]), still, np.eye(6)[None])
    write_g2o(PoseGraph(poses, motion), tmp_path / "graph.g2o")
    agree(read_poses(tmp_path / "graph.g2o", sorted(NAMES)), NAMES, scene.cam_from_world)
    other = [f"{letter}.jpg" for letter in "abcdef"]
    agree(read_poses(tmp_path / "graph.g2o", other), other, scene.cam_from_world)
    with pytest.raises(InputError, match="not ids of the file"):
        read_poses(tmp_path / "graph.g2o", other[:4])


@pytest.mark.parametrize("rows", ["1 0 0 {} 0 1 0 0 0 0 1 0", "{0} {0} 0 0 0 0 0 1"])
def test_poses_in_whole_numbers_are_no_counts_of_a_model(tmp_path, rows):
    """Three whole numbers begin a file of Bundle Adjustment in the Large, on a line of their own."""
    (tmp_path / "poses.txt").write_text("\n".join(rows.format(row) for row in range(3)))
    found = read_poses(tmp_path / "poses.txt", ["0.png", "1.png", "2.png"])
    np.testing.assert_array_equal(found.cam_from_world[:, 4], [0, -1, -2])


def test_rows_of_llff_in_the_order_of_names_character_by_character(tmp_path, scene):
    """Columns down, right and backwards of each camera, its centre, height, width and focal length, then two depths."""
    right, down, forward = np.moveaxis(quaternion.to_matrix(scene.cam_from_world[:, :4]), 1, 0)
    center = se3.inverse(scene.cam_from_world)[:, 4:]
    size = np.tile([60.0, 80.0, 50.0], (COUNT, 1))
    matrices = np.stack([down, right, -forward, center, size], axis=2)
    rows = np.hstack([matrices.reshape(COUNT, 15), np.tile([1.0, 9.0], (COUNT, 1))])
    path, order = tmp_path / "poses_bounds.npy", sorted(range(COUNT), key=NAMES.__getitem__)
    np.save(path, rows[order])
    found = read_poses(path, NAMES)
    agree(found, [NAMES[row] for row in order], scene.cam_from_world[order])
    assert found.cameras is not None and found.cameras.params_of(0).tolist() == [50.0, 40.0, 30.0]
    assert found.cameras.width.tolist() == [80] and found.camera_idx.tolist() == [0] * COUNT
    assert "in the order of their names" in found.sentences[0]
    with pytest.raises(InputError, match="6 poses without names, and there are 5 photographs"):
        read_poses(path, NAMES[1:])
    for wrong, words in (
        (rows[:, :15], "N x 17 numbers, as poses_bounds.npy of LLFF and NeRF; got 6 x 15"),
        (np.where(rows == 60.0, np.nan, rows), "missing or infinite"),
        (np.where(rows == 60.0, 60.5, rows), "in whole pixels"),
        (np.where(rows == 50.0, 0.0, rows), "positive focal lengths"),
    ):
        np.save(path, wrong)
        with pytest.raises(FileFormatError, match=words):
            read_poses(path, NAMES)


def test_axes_that_mirror_and_other_files_are_refused(tmp_path, scene):
    write_scene(scene, tmp_path / "transforms.json")
    document = json.loads((tmp_path / "transforms.json").read_text())
    for frame in document["frames"]:
        frame["transform_matrix"][2] = [-value for value in frame["transform_matrix"][2]]
    (tmp_path / "mirrored.json").write_text(json.dumps(document))
    with pytest.raises(FileFormatError, match="expected right-handed axes; the matrix of image 1 mirrors"):
        read_poses(tmp_path / "mirrored.json", NAMES)
    (tmp_path / "words.txt").write_text("these are no poses\n")
    with pytest.raises(FileFormatError, match=r"expected 8 numbers \(TUM\), 12 \(KITTI\)"):
        read_poses(tmp_path / "words.txt", NAMES)
    with pytest.raises(InputError, match="Check the path"):
        read_poses(tmp_path / "nowhere.json", NAMES)


def test_the_calibration_is_of_the_file_or_given_or_a_guess(tmp_path, scene):
    images = tmp_path / "images"
    images.mkdir()
    for name in NAMES:
        cv2.imwrite(str(images / name), np.zeros((60, 80), np.uint8))
    write_scene(scene, tmp_path / "transforms.json")
    write_trajectory(trajectory(scene, np.arange(COUNT) * 0.5), tmp_path / "poses.txt")
    of_file = scene_at_poses(images, tmp_path / "transforms.json", PointModelOptions())
    assert of_file.calibrated and of_file.scene.cameras.params[0, 0] == 50.0 and not of_file.sentences
    guessed = scene_at_poses(images, tmp_path / "poses.txt", PointModelOptions())
    assert not guessed.calibrated and "estimated, beginning at 96 pixels" in guessed.sentences[-1]
    assert guessed.scene.cameras.models == ("SIMPLE_RADIAL",)
    given = scene_at_poses(images, tmp_path / "poses.txt", PointModelOptions("PINHOLE", (70.0, 71.0, 40.0, 30.0)))
    assert given.calibrated and given.scene.cameras.params_of(0).tolist() == [70.0, 71.0, 40.0, 30.0]
    cv2.imwrite(str(images / NAMES[0]), np.zeros((50, 80), np.uint8))
    assert len(cameras_of_photographs(images, NAMES, "SIMPLE_RADIAL")[0]) == 2
    with pytest.raises(InputError, match="have the sizes 80x50, 80x60"):
        cameras_of_photographs(images, NAMES, "PINHOLE", (70.0, 71.0, 40.0, 30.0))


def test_json_of_another_kind_is_named(tmp_path):
    (tmp_path / "poses.json").write_text('{"0": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}')
    with pytest.raises(FileFormatError, match="JSON file of a kind that is not read for poses"):
        read_poses(tmp_path / "poses.json", ["0.jpg"])
