# SPDX-License-Identifier: BSD-3-Clause
"""Folders of sequences in three layouts: TUM, KITTI, EuRoC."""

import cv2
import numpy as np
import pytest
from _sequences import POINTS, blob_image, image, pose, straight

from groma import cameras
from groma.geometry import se3
from groma.io import Trajectory, write_trajectory


@pytest.fixture
def tum(tmp_path):
    """Six colour images and five depth images at times of their own."""
    times, depth_times = [10.0, 10.1, 10.2, 10.3, 10.4, 10.5], [10.008, 10.107, 10.195, 10.305, 10.45]
    for row in range(6):
        image(tmp_path / f"rgb/{row}.png", 10 * row)
    for row in range(5):
        image(tmp_path / f"depth/{row}.png", 5000 * (row + 1), dtype=np.uint16)
    (tmp_path / "rgb.txt").write_text("# time file\n" + "".join(f"{t} rgb/{i}.png\n" for i, t in enumerate(times)))
    (tmp_path / "depth.txt").write_text("".join(f"{t} depth/{i}.png\n" for i, t in enumerate(depth_times)))
    (tmp_path / "camera.txt").write_text("50 51 32 24\n")
    write_trajectory(straight(times), tmp_path / "groundtruth.txt")
    return tmp_path


@pytest.fixture
def kitti(tmp_path):
    for row in range(3):
        image(tmp_path / f"image_0/{row:06d}.png", 10 * row)
        image(tmp_path / f"image_1/{row:06d}.png", 10 * row + 1)
    (tmp_path / "calib.txt").write_text("P0: 70 0 30 0 0 70 20 0 0 0 1 0\nP1: 70 0 30 -35 0 70 20 0 0 0 1 0\nTr: 1 2\n")
    (tmp_path / "times.txt").write_text("0.0\n0.1\n0.2\n")
    write_trajectory(straight([0, 1, 2]), tmp_path / "poses.txt", "kitti")
    return tmp_path


YAML = """%YAML:1.0
sensor_type: camera  # a comment: with a colon
T_BS:
  cols: 4
  rows: 4
  data: [{data}]
rate_hz: 20
resolution: [320, 240]
camera_model: pinhole
intrinsics: [{intrinsics}] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [{distortion}]
"""


@pytest.fixture
def euroc(tmp_path):
    """Two cameras that squint and are distorted, and see blobs at known points of the left camera."""
    body_from_left = pose([0.3, -0.2, 1.5], [0.1, 0.2, 0.3])
    left_from_right = pose([0.02, -0.03, 0.01], [0.11, 0.002, -0.003])
    sensors = [
        (body_from_left, np.array([250.0, 252, 158, 121]), np.array([-0.28, 0.07, 0.0002, 0.0001])),
        (body_from_left @ left_from_right, np.array([248.0, 249, 163, 118]), np.array([-0.27, 0.06, -0.0003, 0.0002])),
    ]
    stamps = [1403636579763555584 + 50000000 * row for row in range(3)]
    for number, (body_from_cam, intrinsics, distortion) in enumerate(sensors):
        folder = tmp_path / f"mav0/cam{number}"
        (folder / "data").mkdir(parents=True)
        text = {"intrinsics": intrinsics, "distortion": distortion, "data": body_from_cam.ravel()}
        (folder / "sensor.yaml").write_text(
            YAML.format(**{key: ",\n   ".join(map(repr, value.tolist())) for key, value in text.items()})
        )
        (folder / "data.csv").write_text("#timestamp [ns],filename\n" + "".join(f"{t},{t}.png\r\n" for t in stamps))
        cam_from_left = np.linalg.inv(body_from_cam) @ body_from_left
        points = POINTS @ cam_from_left[:3, :3].T + cam_from_left[:3, 3]
        params = np.append(intrinsics + 0.5 * np.array([0, 0, 1, 1]), distortion)
        gray = blob_image(cameras.model("OPENCV").project(params, points), (320, 240))
        for stamp in stamps:
            cv2.imwrite(str(folder / f"data/{stamp}.png"), gray)
    world_from_body = pose([1.0, 0.4, -0.3], [4.0, 5.0, 6.0])
    truth = Trajectory(np.array(stamps) * 1e-9, np.tile(se3.from_matrix(world_from_body), (3, 1)))
    (tmp_path / "mav0/state_groundtruth_estimate0").mkdir()
    write_trajectory(truth, tmp_path / "mav0/state_groundtruth_estimate0/data.csv", "euroc")
    return tmp_path, world_from_body @ body_from_left
