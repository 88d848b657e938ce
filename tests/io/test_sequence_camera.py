# SPDX-License-Identifier: BSD-3-Clause
"""The camera of a sequence: what it takes, how it is said, what it refuses, and images without its distortion."""

import cv2
import numpy as np
import pytest
from _sequences import POINTS, SIZE, blob_center, blob_image, image

from groma import cameras
from groma.errors import InputError
from groma.io import write_archive, write_colmap
from groma.io.sequences import SequenceCamera, calibration_of, open_sequence
from groma.scene import Cameras, Scene


def test_a_camera_takes_lists_and_keeps_an_array_of_its_own():
    params = np.array([50.0, 51.0, 32.0, 24.0])
    camera = SequenceCamera("PINHOLE", params, 64, 48)
    params[0] = 0.0
    assert camera.params[0] == 50.0
    np.testing.assert_array_equal(SequenceCamera("PINHOLE", [50, 51, 32, 24], 64, 48).params, camera.params)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("PINHOLE", [50, 51, 32], 64, 48), r"PINHOLE takes 4 finite numbers \(fx, fy, cx, cy\); got \[50.0"),
        (("PINHOLE", [50, 51, 32, 24, 0], 64, 48), "takes 4 finite numbers"),
        (("OPENCV", [50, 51, 32, 24], 64, 48), "takes 8 finite numbers"),
        (("PINHOLE", [50, np.nan, 32, 24], 64, 48), "takes 4 finite numbers"),
        (("PINHOLE", None, 64, 48), "takes 4 finite numbers"),
        (("PINHOLE", "wide", 64, 48), "could not convert"),
        (("PINHOLE", [50, -51, 32, 24], 64, 48), "focal lengths must be positive"),
        (("CIRCLE", [50, 51, 32, 24], 64, 48), "must be one of"),
        (("PINHOLE", [50, 51, 32, 24], 64, 0), "width and height must be positive"),
        (("PINHOLE", [50, 51, 32, 24], 64, 48, 0.0), "baseline must be positive"),
    ],
)
def test_a_camera_of_a_sequence_is_checked(arguments, words):
    with pytest.raises(InputError, match=words):
        SequenceCamera(*arguments)


@pytest.mark.parametrize(
    ("camera", "params"),
    [
        ("50 51 32 24", [50, 51, 32.5, 24.5]),
        ([50, 51, 32, 24], [50, 51, 32.5, 24.5]),
        ([[50, 0, 32], [0, 51, 24], [0, 0, 1]], [50, 51, 32.5, 24.5]),
        ("50,51,32,24", [50, 51, 32.5, 24.5]),
        ("1 PINHOLE 64 48 50 51 32 24", [50, 51, 32, 24]),
        ("SIMPLE_PINHOLE 64 48 50 32 24", [50, 50, 32, 24]),
        (SequenceCamera("PINHOLE", np.array([50.0, 51, 32, 24]), 64, 48), [50, 51, 32, 24]),
        ("50 51 32 24 -0.2 0.05 0.001 0.002", [50, 51, 32.5, 24.5]),
    ],
)
def test_ways_to_say_a_camera(tum, tmp_path, camera, params):
    np.testing.assert_array_equal(open_sequence(tum, camera=camera).camera.params, params)
    if isinstance(camera, str):
        (tmp_path / "other.txt").write_text(f"# a comment\n{camera}\n")
        np.testing.assert_array_equal(open_sequence(tum, camera=tmp_path / "other.txt").camera.params, params)


KALIBR = """cam0:
  T_cam_imu:
  - [1.0, 0.0, 0.0, 0.0]
  camera_model: pinhole
  distortion_coeffs: [-0.2, 0.05, 0.001, 0.002]
  distortion_model: radtan
  intrinsics: [50, 51, 32, 24]
  resolution: [64, 48]
"""
ROS = """image_width: 64
image_height: 48
camera_matrix:
  rows: 3
  cols: 3
  data: [50, 0, 32,
         0, 51, 24, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.2, 0.05, 0.001, 0.002, 0.0]
projection_matrix:
  data: [40, 0, 30, 0, 0, 40, 20, 0, 0, 0, 1, 0]
"""
OPENCV = ROS.replace("matrix:\n", "matrix: !!opencv-matrix\n").replace("distortion_model: plumb_bob\n", "")


@pytest.mark.parametrize("text", [KALIBR, ROS, "%YAML:1.0\n---\n" + OPENCV])
def test_files_of_kalibr_ros_and_opencv_hold_the_same_camera(tmp_path, text):
    (tmp_path / "camera.yaml").write_text(text)
    found, same = calibration_of(tmp_path / "camera.yaml"), calibration_of("50 51 32 24 -0.2 0.05 0.001 0.002")
    assert (found.model, found.size) == (same.model, (64, 48)) == ("OPENCV", (64, 48))
    np.testing.assert_array_equal(found.params, same.params)


def test_other_lenses_in_yaml(tmp_path):
    path = tmp_path / "camera.yml"
    path.write_text(KALIBR.replace("radtan", "equidistant"))
    assert calibration_of(path).model == "OPENCV_FISHEYE"
    assert calibration_of(path).params.tolist() == [50, 51, 32.5, 24.5, -0.2, 0.05, 0.001, 0.002]
    eight = ROS.replace("plumb_bob", "rational_polynomial").replace("0.002, 0.0]", "0.002, 3, 4, 5, 6]")
    path.write_text(eight)
    assert calibration_of(path).model == "FULL_OPENCV" and calibration_of(path).params[8:].tolist() == [3, 4, 5, 6]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (KALIBR + KALIBR.replace("cam0", "cam1"), "several cameras"),
        (KALIBR.replace("pinhole", "omni"), "camera_model must be pinhole; got omni"),
        (KALIBR.replace("radtan", "fov"), "distortion_model must be"),
        (KALIBR.replace(", 0.001, 0.002]", "]"), "6 numbers"),
        (KALIBR.replace("radtan", "equidistant").replace(", 0.001, 0.002]", "]"), "takes 8 finite numbers"),
        (KALIBR.replace("[64, 48]", "[64]"), "camera.yaml"),
        (ROS.replace("image_width: 64", ""), "image_width: expected a whole number"),
        (ROS.replace("0, 51, 24, 0, 0, 1]", "]"), "camera.yaml"),
        ("cam0:\n", "no entry intrinsics"),
    ],
)
def test_yaml_that_is_refused(tmp_path, text, words):
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        calibration_of(tmp_path / "camera.yaml")
    assert str(tmp_path / "camera.yaml") in str(caught.value)


ORB_SLAM = """%YAML:1.0
Camera.type: "PinHole"
Camera1.fx: 50.0
Camera1.fy: 51.0
Camera1.cx: 32.0
Camera1.cy: 24.0
Camera1.k1: -0.2
Camera1.k2: 0.05
Camera1.p1: 0.001
Camera1.p2: 0.002
Camera.width: 64
Camera.height: 48
RGBD.DepthMapFactor: 5208.0
"""


@pytest.mark.parametrize("text", [ORB_SLAM, ORB_SLAM.replace("Camera1", "Camera").replace("RGBD.", "")])
def test_settings_of_orb_slam_hold_the_camera_and_the_unit_of_depths(tum, tmp_path, text):
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    found, same = calibration_of(path), calibration_of("50 51 32 24 -0.2 0.05 0.001 0.002")
    assert found.model == same.model == "OPENCV" and found.depth_scale == 5208.0
    np.testing.assert_array_equal(found.params, same.params)
    assert open_sequence(tum, camera=path).preparation.depth_scale == 5208.0
    assert open_sequence(tum, camera=path, depth_scale=1000.0).preparation.depth_scale == 1000.0
    path.write_text(text.replace("5208.0", "-1"))
    with pytest.raises(InputError, match="depth_scale must be positive"):
        open_sequence(tum, camera=path)


def test_of_a_pair_that_orb_slam_rectifies_the_left_camera_is_that_of_the_images(tmp_path):
    matrix = "!!opencv-matrix\n   rows: 3\n   cols: 3\n   data: [40, 0, 30, 0, 41, 20, 0, 0, 1]\n"
    lens = "LEFT.D: !!opencv-matrix\n   rows: 1\n   cols: 4\n   data: [-0.1, 0.02, 0, 0]\n"
    (tmp_path / "settings.yaml").write_text(f"{ORB_SLAM}LEFT.K: {matrix}{lens}")
    found = calibration_of(tmp_path / "settings.yaml")
    assert found.size == (64, 48) and found.params.tolist() == [40, 41, 30.5, 20.5, -0.1, 0.02, 0, 0]


def test_a_fisheye_of_orb_slam(tmp_path):
    path = tmp_path / "settings.yaml"
    text = ORB_SLAM.replace("PinHole", "KannalaBrandt8").replace("p1", "k3").replace("p2", "k4")
    path.write_text(text.replace("5208.0", "0"))  # as in settings of cameras without depth
    found = calibration_of(path)
    assert (found.model, found.size, found.depth_scale) == ("OPENCV_FISHEYE", (64, 48), None)
    assert found.params.tolist() == [50, 51, 32.5, 24.5, -0.2, 0.05, 0.001, 0.002]


def test_the_camera_of_a_map(tmp_path):
    """A camera that nobody knows is estimated by mapping some of the frames; the message without one says so."""
    camera = Cameras.of([3], ["SIMPLE_RADIAL"], [[50.0, 32.0, 24.0, -0.1]], [(64, 48)])
    pose = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    scene = Scene.from_images(camera, ["a.png"], np.zeros(1, int), pose)
    write_colmap(scene, tmp_path / "map")
    write_archive(scene, tmp_path / "scene.npz")
    for source in (str(tmp_path / "map"), tmp_path / "scene.npz"):
        found = calibration_of(source)
        assert (found.model, found.size) == ("SIMPLE_RADIAL", (64, 48))
        assert found.params.tolist() == [50, 32, 24, -0.1]
    two = Cameras.of([3, 4], ["SIMPLE_RADIAL"] * 2, [[50.0, 32.0, 24.0, -0.1]] * 2, [(64, 48)] * 2)
    write_archive(Scene.from_images(two, ["a.png", "b.png"], np.arange(2), pose[[0, 0]]), tmp_path / "two.npz")
    with pytest.raises(InputError, match="has 2 cameras; expected one"):
        calibration_of(tmp_path / "two.npz")
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(InputError, match="groma map estimates it from some of the images"):
        open_sequence(tmp_path)


@pytest.mark.parametrize(
    ("text", "scale"),
    [
        ('{"width": 64, "height": 48, "intrinsic_matrix": [50, 0, 0, 0, 51, 0, 32, 24, 1]}', None),
        ('{"camera": {"w": 64, "h": 48, "fx": 50, "fy": 51, "cx": 32, "cy": 24, "scale": 6553.5}}', 6553.5),
    ],
)
def test_cameras_of_open3d_and_replica(tum, text, scale):
    (tum / "camera.json").write_text(text)
    found = calibration_of(tum / "camera.json")
    assert (found.model, found.size, found.depth_scale) == ("PINHOLE", (64, 48), scale)
    assert found.params.tolist() == [50, 51, 32.5, 24.5]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "expected an object"),
        ("{}", "a finite number"),
        ('{"intrinsic_matrix": [1, 2]}', "expected 9 finite numbers"),
    ],
)
def test_other_json_is_refused(tmp_path, text, words):
    (tmp_path / "camera.json").write_text(text)
    with pytest.raises(InputError, match=words):
        calibration_of(tmp_path / "camera.json")


def test_matrix_file(tum):
    for text in ("50 0 32\n0 51 24\n0 0 1\n", "50 0 32 0\n0 51 24 0\n0 0 1 0\n0 0 0 1\n"):
        (tum / "camera.txt").write_text(text)
        np.testing.assert_array_equal(open_sequence(tum).camera.params, [50, 51, 32.5, 24.5])


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ("50 51 32", "camera holds 3 numbers; expected 'fx fy cx cy'"),
        ([50, 51, 32], "3 numbers"),
        ("1 PINHOLE 64 48 50 51 32", "takes 4"),
        ("1 CIRCLE 64 48 50 51 32", "CIRCLE"),
        ("1 PINHOLE 640 480 500 500 320 240", "for images of"),
        ("-50 51 32 24", "positive"),
        ("missing.txt", "Cannot read"),
        ("PINHOLE 64 48 a 51 32 24", "cannot be read as a calibration"),
        ("PINHOLE wide 48 50 51 32 24", "cannot be read as a calibration"),
        ([50, [51], 32, 24], "cannot be read as a calibration"),
    ],
)
def test_cameras_that_are_refused(tum, camera, words):
    with pytest.raises(InputError, match=words):
        open_sequence(tum, camera=camera)


def test_undistortion_puts_points_where_a_pinhole_sees_them(tmp_path):
    size, numbers = (320, 240), np.array([250.0, 255, 158, 121, -0.25, 0.08, 0.002, -0.001])
    distorted = cameras.model("OPENCV").project(numbers + np.array([0, 0, 0.5, 0.5, 0, 0, 0, 0]), POINTS)
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images/0001.png"), blob_image(distorted, size))
    sequence = open_sequence(tmp_path, camera=numbers)
    expected = cameras.model("PINHOLE").project(sequence.camera.params, POINTS)
    assert np.abs(expected - distorted).max() > 1.2
    gray = next(iter(sequence)).gray
    for point in expected:
        np.testing.assert_allclose(blob_center(gray, point), point, atol=0.15)  # blobs are bent and rounded to 8 bits


def test_depth_is_undistorted_with_the_image(tum):
    ramp = np.tile(np.arange(1, 65, dtype=np.uint16) * 100, (48, 1))
    cv2.imwrite(str(tum / "depth/0.png"), ramp)
    cv2.imwrite(str(tum / "rgb/0.png"), (ramp // 100).astype(np.uint8))
    frame = next(iter(open_sequence(tum, camera="50 50 31.5 23.5 -0.2 0 0 0", depth_scale=100)))
    inside = frame.depth > 0
    assert inside.mean() > 0.9
    assert np.abs(frame.depth[inside] - frame.gray[inside]).max() <= 1.0
    assert (frame.depth != ramp / 100).any()


def test_masks_come_with_the_frames(tmp_path):
    """A mask for each image that has one, or one for all; undistorted as the images are."""
    for number in (1, 2):
        image(tmp_path / "images" / f"{number}.png", number)
    right = np.zeros(SIZE[::-1], np.uint8)
    right[:, SIZE[0] // 2 :] = 255
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "2.png"), right)
    given = {"masks": tmp_path / "masks", "camera": "50 50 32 24"}
    first, second = open_sequence(tmp_path / "images", **given)
    assert first.used is None
    np.testing.assert_array_equal(second.used, right > 0)
    given = {"masks": tmp_path / "masks" / "2.png", "camera": "50 50 32 24 -0.3 0.1 0 0"}
    for frame in open_sequence(tmp_path / "images", **given):
        np.testing.assert_array_equal(frame.used[:, [20, 31, 34, 44]], [[False, False, True, True]] * SIZE[1])
    with pytest.raises(InputError, match="Cannot read"):
        open_sequence(tmp_path / "images", masks=tmp_path / "none", camera="50 50 32 24")
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, SIZE)
    writer.write(np.zeros((*SIZE[::-1], 3), np.uint8))
    writer.release()
    with pytest.raises(InputError, match="Masks are for sequences of image files"):
        open_sequence(tmp_path / "v.avi", camera="50 50 32 24", masks=tmp_path / "masks")
