# SPDX-License-Identifier: BSD-3-Clause
"""transforms.json of nerfstudio and instant-ngp: what is read is what their cameras see; written and read again."""

import json

import cv2
import numpy as np
import pytest
from _views import HEIGHT, WIDTH, check_poses, photographs, views

from groma import cameras
from groma.errors import FileFormatError, InputError, OutputError
from groma.geometry import se3
from groma.io import read_colmap, read_scene, read_transforms, write_scene, write_transforms
from groma.scene import Scene
from groma.testing import check_format

LENS = {"fl_x": 500.0, "fl_y": 505.0, "cx": 322.0, "cy": 238.0, "w": WIDTH, "h": HEIGHT}
BENT = {"k1": -0.1, "k2": 0.02, "p1": 0.003, "p2": -0.002}


def frames(true) -> list[dict]:
    """Return frames by OpenGL's axes: x right, y up, looking along -z; these and the centre are columns."""
    found = []
    for row, (rotation, center) in enumerate(zip(true.rotation, true.center, strict=True)):
        right, down, forward = rotation
        matrix = np.eye(4)
        matrix[:3] = np.column_stack([right, -down, -forward, center])
        found.append({"file_path": f"./images/{row}.png", "transform_matrix": matrix.tolist()})
    return found


def write(folder, document: dict):
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder / "transforms.json"


@pytest.fixture
def true():
    return views()


def seen(scene: Scene, image: int, point: np.ndarray) -> np.ndarray:
    in_cam = se3.transform_points(scene.cam_from_world[image], point)
    row = int(scene.images.camera_idx[image])
    return cameras.model(scene.cameras.models[row]).project(scene.cameras.params_of(row), in_cam[None])[0]


def test_poses_and_pixels(true, tmp_path):
    """OpenCV's lens, applied here to what a camera along -z with y up sees."""
    scene = read_scene(write(tmp_path, {"camera_model": "OPENCV", **LENS, **BENT, "frames": frames(true)}))
    check_poses(scene, true)
    assert scene.images.names == tuple(f"images/{row}.png" for row in range(4))
    matrix = np.array(frames(true)[1]["transform_matrix"])
    behind = np.linalg.inv(matrix) @ [*true.points[2], 1.0]
    x, y = behind[0] / -behind[2], behind[1] / behind[2]
    squared = x * x + y * y
    grown = 1 + BENT["k1"] * squared + BENT["k2"] * squared**2
    u = 500.0 * (x * grown + 2 * BENT["p1"] * x * y + BENT["p2"] * (squared + 2 * x * x)) + 322.0
    v = 505.0 * (y * grown + 2 * BENT["p2"] * x * y + BENT["p1"] * (squared + 2 * y * y)) + 238.0
    np.testing.assert_allclose(seen(scene, 1, true.points[2]), [u, v], atol=1e-9)


@pytest.mark.parametrize(
    ("said", "model", "params"),
    [
        (LENS, "PINHOLE", [500, 505, 322, 238]),
        ({"fl_x": 500.0, "w": WIDTH, "h": HEIGHT}, "SIMPLE_PINHOLE", [500, 320, 240]),
        ({**LENS, "camera_model": "PINHOLE", "fl_y": 500.0}, "PINHOLE", [500, 500, 322, 238]),
        ({**LENS, "camera_model": "SIMPLE_PINHOLE", "fl_y": 500.0}, "SIMPLE_PINHOLE", [500, 322, 238]),
        ({**LENS, "camera_model": "SIMPLE_RADIAL", "fl_y": 500.0, "k1": 0.1}, "SIMPLE_RADIAL", [500, 322, 238, 0.1]),
        ({**LENS, "camera_model": "OPENCV"}, "OPENCV", [500, 505, 322, 238, 0, 0, 0, 0]),
        ({**LENS, "k1": 0.1}, "OPENCV", [500, 505, 322, 238, 0.1, 0, 0, 0]),
        ({**LENS, "k3": 0.1}, "FULL_OPENCV", [500, 505, 322, 238, 0, 0, 0, 0, 0.1, 0, 0, 0]),
        ({**LENS, "camera_model": "PINHOLE", "k1": 0.1}, "OPENCV", [500, 505, 322, 238, 0.1, 0, 0, 0]),
        ({**LENS, "is_fisheye": True, "k4": 0.1}, "OPENCV_FISHEYE", [500, 505, 322, 238, 0, 0, 0, 0.1]),
        ({**LENS, "camera_model": "OPENCV_FISHEYE", "k1": 1}, "OPENCV_FISHEYE", [500, 505, 322, 238, 1, 0, 0, 0]),
        ({"w": 640, "h": 320, "camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR", [640, 320]),
        (
            {"camera_angle_x": 2 * np.arctan(1.0), "camera_angle_y": 2 * np.arctan(0.5), "w": WIDTH, "h": HEIGHT},
            "PINHOLE",
            [320, 480, 320, 240],
        ),
    ],
)
def test_cameras(true, tmp_path, said, model, params):
    scene = read_scene(write(tmp_path, {**said, "frames": frames(true)}))
    assert scene.cameras.models == (model,)
    np.testing.assert_allclose(scene.cameras.params_of(0), params, atol=1e-9)


def test_intrinsics_of_a_frame_count_before_those_of_the_file(true, tmp_path):
    listed = frames(true)
    listed[1] |= {"fl_x": 700.0}
    listed[3] |= {"fl_x": 700.0}
    scene = read_scene(write(tmp_path, {**LENS, "frames": listed}))
    assert scene.images.camera_idx.tolist() == [0, 1, 0, 1]
    assert scene.cameras.params[:, 0].tolist() == [500.0, 700.0]


def test_a_frame_with_a_camera_of_its_own_has_the_size_of_its_photograph(true, tmp_path):
    listed = frames(true)
    listed[0] |= {"fl_x": 700.0}
    photographs(tmp_path, ["images/0.png"], (320, 200))
    photographs(tmp_path, ["images/3.png"])
    listed.reverse()
    scene = read_scene(write(tmp_path, {"fl_x": 500.0, "frames": listed}))
    assert scene.cameras.width.tolist() == [WIDTH, 320] and scene.cameras.height.tolist() == [HEIGHT, 200]
    assert scene.images.camera_idx.tolist() == [0, 0, 0, 1]


def test_sizes_come_from_the_photographs_where_the_file_has_none(true, tmp_path):
    """As in NeRF's Blender scenes, whose names have no ending either."""
    listed = frames(true)
    for frame in listed:
        frame["file_path"] = frame["file_path"].removesuffix(".png")
    path = write(tmp_path, {"camera_angle_x": 2 * np.arctan(0.5), "frames": listed})
    with pytest.raises(FileFormatError, match="neither these nor the photograph"):
        read_scene(path)
    photographs(tmp_path, ["images/1.png"])
    scene = read_scene(path)
    assert scene.images.names[2] == "images/2.png" and len(scene.cameras) == 1
    assert scene.cameras.params_of(0).tolist() == pytest.approx([WIDTH, WIDTH / 2, HEIGHT / 2])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("frames"), "expected 'frames', which is missing"),
        (lambda d: d["frames"][1].pop("file_path"), "frame 2: expected 'file_path', which is missing"),
        (
            lambda d: d["frames"][1].pop("transform_matrix"),
            "transform_matrix: expected 4 x 4 finite numbers; got nothing",
        ),
        (lambda d: d["frames"][1]["transform_matrix"].pop(), "transform_matrix: expected 4 x 4 finite numbers"),
        (lambda d: d["frames"][1]["transform_matrix"][3].__setitem__(0, 2.0), "last row is 0 0 0 1"),
        (lambda d: d["frames"][1]["transform_matrix"][0].__setitem__(0, 2.0), "expected rotation matrices"),
        (lambda d: d.update(camera_model="THIN"), "'THIN' is not read; known are"),
        (lambda d: d.pop("fl_x"), "neither|found neither"),
        (lambda d: d.update(fl_x=-1.0), "positive focal lengths"),
        (lambda d: d.update(w="640"), "expected 'w', a finite number; got '640'"),
        (lambda d: d.update(camera_angle_x=7.0, fl_x=d.pop("fl_x") and 1e400), "finite number"),
        (lambda d: d.update(ply_file_path="../points.ply"), "lies outside"),
    ],
)
def test_damage_is_named(true, tmp_path, change, words):
    document = {**LENS, "frames": frames(true)}
    change(document)
    with pytest.raises(FileFormatError, match=words):
        read_scene(write(tmp_path, document))


@pytest.mark.parametrize(
    ("change", "remedy"),
    [(np.transpose, "Transpose them"), (lambda matrix: matrix / 844.4, "Divide each by its last number")],
)
def test_matrices_of_other_forms_are_named_with_what_to_do(true, tmp_path, change, remedy):
    listed = frames(true)
    for frame in listed:
        frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
    with pytest.raises(FileFormatError, match=f"last row is 0 0 0 1. {remedy}"):
        read_scene(write(tmp_path, {**LENS, "frames": listed}))


def test_left_handed_axes_are_named(true, tmp_path):
    listed = frames(true)
    for frame in listed:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([-1.0, 1, 1, 1])).tolist()
    with pytest.raises(FileFormatError, match="right-handed axes"):
        read_scene(write(tmp_path, {**LENS, "frames": listed}))


# ------------------------------------------------------------------------------------------------- Written and read


@pytest.mark.parametrize(
    "said",
    [LENS, {**LENS, **BENT}, {**LENS, **BENT, "k3": 0.01}, {**LENS, "camera_model": "OPENCV_FISHEYE", "k2": 0.1}],
)
def test_there_and_back_is_exact(true, tmp_path, said):
    before = {"camera_model": "OPENCV", **said, "aabb_scale": 16, "applied_transform": np.eye(4)[:3].tolist()}
    found = read_transforms(write(tmp_path, {**before, "frames": frames(true)}))
    assert found.others == {name: before[name] for name in ("aabb_scale", "applied_transform")}
    write_transforms(found.scene, tmp_path / "again.json", others=found.others)
    after = json.loads((tmp_path / "again.json").read_text())
    for name, value in before.items():
        assert after[name] == pytest.approx(value, abs=1e-9) if name != "applied_transform" else after[name] == value
    matrices = [[frame["transform_matrix"] for frame in one] for one in (frames(true), after["frames"])]
    np.testing.assert_allclose(*matrices, atol=1e-9)
    assert [frame["file_path"] for frame in after["frames"]] == [f"images/{row}.png" for row in range(4)]
    scene = read_scene(tmp_path / "again.json")
    np.testing.assert_allclose(scene.cam_from_world, found.scene.cam_from_world, atol=1e-9)
    assert scene.cameras.models == found.scene.cameras.models


def test_a_format_of_the_house(true, tmp_path):
    """Cameras of two kinds and points with colours come back; nothing is replaced without force."""
    listed = frames(true)
    listed[2] |= {"camera_model": "OPENCV_FISHEYE", "k1": 0.1}
    (tmp_path / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\n"
        + "".join(f"property float {axis}\n" for axis in "xyz")
        + "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
        + "end_header\n1 2 3 255 0 7\n4 5 6 1 2 3\n"
    )
    scene = read_scene(write(tmp_path, {**LENS, "ply_file_path": "points.ply", "frames": listed}))
    assert scene.points.xyz.tolist() == [[1, 2, 3], [4, 5, 6]] and scene.points.color.tolist() == [
        [255, 0, 7],
        [1, 2, 3],
    ]
    check_format("transforms", scene, ("cameras", "images", "frames", "points"))
    write_scene(scene, tmp_path / "out.json")
    (tmp_path / "out.json").unlink()
    with pytest.raises(OutputError, match=r"out\.points\.ply exists already"):
        write_scene(scene, tmp_path / "out.json")
    assert not (tmp_path / "out.json").exists()
    (tmp_path / "out.points.ply").rename(tmp_path / "other.points.ply")
    (tmp_path / "out.json").write_text("of somebody")
    with pytest.raises(OutputError, match=r"out\.json exists already"):
        write_scene(scene, tmp_path / "out.json")
    assert not (tmp_path / "out.points.ply").exists()


def test_cameras_that_the_file_does_not_know_are_refused_before_the_work(true, tmp_path):
    scene = read_scene(write(tmp_path, {**LENS, "frames": frames(true)}))
    unsized = scene.replace(cameras=scene.cameras.replace(width=[0], height=[0]))
    with pytest.raises(InputError, match="the size of the images; that of camera 1"):
        write_scene(unsized, tmp_path / "out.json")
    other = scene.cameras.replace(models=("FOV",), params=[[500.0, 500, 320, 240, 0.9]])
    with pytest.raises(InputError, match="camera 1 has the model FOV"):
        write_scene(scene.replace(cameras=other), tmp_path / "out.json")


# -------------------------------------------------------------------------------------------------- NeRF's chair


@pytest.mark.shared
def test_the_chair_of_nerf(shared_data):
    """Poses and focal length as COLMAP has them; points of the surface lie on the silhouettes that Blender rendered."""
    scene, model = read_scene(shared_data / "nerf_chair"), read_colmap(shared_data / "nerf_chair" / "sparse_gt")
    row_of = {name: row for row, name in enumerate(scene.images.names)}
    rows = [row_of[f"images/{name}"] for name in model.images.names]
    np.testing.assert_allclose(
        se3.to_matrix(scene.cam_from_world[rows]), se3.to_matrix(model.cam_from_world), atol=1e-6
    )
    assert scene.cameras.params_of(0) == pytest.approx([1111.1110312, 400, 400])
    long = np.bincount(model.point_observations.point_idx, minlength=model.num_points) >= 5
    for row in rows[::6]:
        name = scene.images.names[row].replace("images", "silhouette")
        shape = cv2.imread(str(shared_data / "nerf_chair" / name), cv2.IMREAD_UNCHANGED) > 0
        shape = cv2.dilate(shape.astype(np.uint8), np.ones((3, 3))) > 0
        pixels = np.array([seen(scene, row, point) for point in model.points.xyz[long][::5]])
        column, line = np.floor(pixels).astype(int).T
        inside = shape[np.clip(line, 0, 799), np.clip(column, 0, 799)]
        assert inside.mean() > 0.99 and shape.mean() < 0.6


@pytest.mark.shared
def test_the_chair_comes_back_exactly(shared_data, tmp_path):
    scene = read_scene(shared_data / "nerf_chair")
    write_scene(scene, tmp_path / "out.json")
    again = read_scene(tmp_path / "out.json")
    np.testing.assert_allclose(again.cam_from_world, scene.cam_from_world, atol=1e-9)
    np.testing.assert_allclose(again.cameras.params, scene.cameras.params, atol=1e-9)
    before = json.loads((shared_data / "nerf_chair" / "transforms.json").read_text())["frames"]
    after = json.loads((tmp_path / "out.json").read_text())["frames"]
    matrices = [[frame["transform_matrix"] for frame in one] for one in (before, after)]
    np.testing.assert_allclose(*matrices, atol=1e-6)  # the matrices of Blender are rotations to seven digits
