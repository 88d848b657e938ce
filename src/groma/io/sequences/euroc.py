# SPDX-License-Identifier: BSD-3-Clause
r"""Folders of the EuRoC data set: ``mav0/cam0`` and ``mav0/cam1``, each with ``sensor.yaml``, ``data.csv``, ``data``.

Images are undistorted; those of two cameras are rectified: both turn to a common frame whose x axis points from the
left to the right camera centre and whose z axis is the mean of the optical axes, made perpendicular to it. They get
the mean focal length and a principal point that keeps the centres of the images in the middle.

The reference is ``state_groundtruth_estimate0/data.csv``, moved from the body to the left (rectified) camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from groma import cameras
from groma._typing import FloatArray
from groma.bounded.names import listed_file
from groma.bounded.text import read_lines, whole
from groma.errors import FileFormatError, InputError
from groma.geometry import se3
from groma.io.reading import reading
from groma.io.sequences._calibration import Calibration, calibration_in, rectification
from groma.io.sequences._reader import Entry, FileSequence, Preparation, file_size, simple_sequence
from groma.io.sequences._yaml import yaml_entries, yaml_numbers
from groma.io.sequences.frame import SequenceCamera
from groma.io.sequences.layouts import Wishes
from groma.io.sequences.tum_rgbd import pair_by_time
from groma.io.trajectories import Trajectory, read_trajectory

#: Largest difference in time of the images of a pair, seconds (derived from 20 pairs a second: a tenth of their
#: distance).
TOLERANCE = 0.005


def euroc_root(folder: Path) -> Path | None:
    """Return the folder that holds ``cam0``, or None if a folder does not have this layout."""
    for root in (folder, folder / "mav0"):
        if (root / "cam0" / "data").is_dir():
            return root
    return None


@dataclass(frozen=True, eq=False)
class _Sensor:
    """One camera: its calibration, where it sits, and its images."""

    calibration: Calibration
    body_from_cam: FloatArray  # (4, 4)
    images: list[tuple[float, Path]]


def open_euroc(root: Path, wishes: Wishes) -> FileSequence:
    """Open the folder that holds ``cam0``; see :func:`groma.io.sequences.open_sequence`."""
    calibration, selection, warnings = wishes.calibration, wishes.selection, []
    has_right = (root / "cam1" / "data").is_dir() and selection.kind != "mono"
    kind = selection.kind_of("stereo" if has_right else "mono")
    left = _sensor(root / "cam0", calibration)
    if kind == "mono":
        entries = selection.of([Entry(time, path) for time, path in left.images], warnings)
        reference = _reference(root, left.body_from_cam)
        return simple_sequence(kind, entries, left.calibration, reference, warnings)
    if calibration is not None:
        raise InputError("A camera cannot be passed for a stereo folder: edit sensor.yaml, or pass kind='mono'.")
    right = _sensor(root / "cam1", None)
    pairs = dict(
        pair_by_time(
            np.array([time for time, _ in left.images]), np.array([time for time, _ in right.images]), TOLERANCE
        )
    )
    entries = selection.of(
        [
            Entry(time, path, right=right.images[pairs[row]][1] if row in pairs else None)
            for row, (time, path) in enumerate(left.images)
        ],
        warnings,
    )
    size = file_size(entries, left.calibration)
    if right.calibration.size not in (None, size):
        raise InputError(f"cam0 has images of {size}, cam1 of {right.calibration.size}; expected the same size.")
    left_from_right = np.linalg.inv(left.body_from_cam) @ right.body_from_cam
    turn, baseline = _common_frame(left_from_right)
    turns = turn, left_from_right[:3, :3].T @ turn  # camera_from_rectified
    target = _common_pinhole((left.calibration, right.calibration), turns, size)
    maps = [
        rectification(sensor.calibration, target, size, camera_from_rectified)
        for sensor, camera_from_rectified in zip((left, right), turns, strict=True)
    ]
    body_from_rectified = left.body_from_cam.copy()
    body_from_rectified[:3, :3] = left.body_from_cam[:3, :3] @ turn
    camera = SequenceCamera("PINHOLE", target, *size, baseline)
    preparation = Preparation(maps[0], maps[1])
    return FileSequence(kind, entries, camera, preparation, size, _reference(root, body_from_rectified), warnings)


def _common_frame(left_from_right: FloatArray) -> tuple[FloatArray, float]:
    """Return left_from_rectified, (3, 3), and the baseline."""
    baseline = float(np.linalg.norm(left_from_right[:3, 3]))
    forward = left_from_right[:3, 2] + np.array([0.0, 0.0, 1.0])
    if baseline == 0.0 or left_from_right[0, 3] < 0.5 * baseline:
        raise InputError("cam1 must lie to the right of cam0. Check T_BS in the two files sensor.yaml.")
    x = left_from_right[:3, 3] / baseline
    y = np.cross(forward, x)
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1), baseline


def _common_pinhole(
    calibrations: tuple[Calibration, Calibration], turns: tuple[FloatArray, FloatArray], size: tuple[int, int]
) -> FloatArray:
    """Return fx, fy, cx, cy of the rectified cameras."""
    focal = float(np.mean([calibration.pinhole()[:2] for calibration in calibrations]))
    centers = []
    for calibration, camera_from_rectified in zip(calibrations, turns, strict=True):
        middle = np.array([[0.5 * size[0], 0.5 * size[1]]])
        ray = cameras.model(calibration.model).unproject(calibration.params, middle)[0] @ camera_from_rectified
        centers.append(middle[0] - focal * ray[:2] / ray[2])
    return np.array([focal, focal, *np.mean(centers, axis=0)])


def _sensor(folder: Path, calibration: Calibration | None) -> _Sensor:
    path = folder / "sensor.yaml"
    pose = np.eye(4)
    if path.is_file():
        with reading(path, "sensor.yaml"):
            entries = yaml_entries(path)
            pose = yaml_numbers(entries, "T_BS.data", path).reshape(4, 4)
            if np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() > 1e-3:
                raise FileFormatError(f"{path}: T_BS is not a rigid motion.")
            calibration = calibration or calibration_in(entries, path)
    if calibration is None:
        raise InputError(f"There is no {path}. Add it, or pass camera= and kind='mono'.")
    return _Sensor(calibration, pose, _images(folder))


def _images(folder: Path) -> list[tuple[float, Path]]:
    """Return times and files, as ``data.csv`` lists them or as they are named."""
    table, data = folder / "data.csv", folder / "data"
    if not table.is_file():
        named = sorted((path for path in data.iterdir() if path.stem.isdecimal()), key=lambda path: int(path.stem))
        return [(int(path.stem) * 1e-9, path) for path in named]
    with reading(table, "list of images"):
        found = []
        for number, line in read_lines(table):
            place = f"{table}, line {number}"
            time, *names = line.replace(",", " ").split() or [""]
            name = names[0] if names else f"{time}.png"
            found.append((whole(time, place, "a time in nanoseconds") * 1e-9, listed_file(data, name, place)))
        return found


def _reference(root: Path, body_from_cam: FloatArray) -> Trajectory | None:
    path = root / "state_groundtruth_estimate0" / "data.csv"
    if not path.is_file():
        return None
    body = read_trajectory(path, "euroc")
    pose = np.broadcast_to(se3.from_matrix(body_from_cam), body.world_from_cam.shape)
    return body.replace(world_from_cam=se3.compose(body.world_from_cam, pose))
