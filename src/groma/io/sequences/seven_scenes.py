# SPDX-License-Identifier: BSD-3-Clause
r"""Folders of the 7-Scenes data set: ``frame-NNNNNN.color.png`` (or jpg), ``.depth.png``, ``.pose.txt``.

The two cameras of the Kinect are not registered to each other in these data: the depth camera has the focal length 585
and the colour camera, whose calibration the authors do not give, about 525. Each depth pixel is moved to the colour
image with the transform between the sensors that the data set's users agree on; the nearest of the depths that meet
in a pixel is kept. The reference poses are those of the depth camera; they are moved to the colour camera.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from groma._numba import loop
from groma._typing import FloatArray
from groma.bounded.text import read_words
from groma.errors import FileFormatError
from groma.geometry import se3, so3
from groma.io.reading import reading
from groma.io.sequences._calibration import from_opencv, read_calibration
from groma.io.sequences._reader import Entry, FileSequence, Preparation, simple_sequence
from groma.io.sequences.layouts import Wishes
from groma.io.trajectories import Trajectory

#: Frames a second (convention: of the camera; the format says none).
RATE = 30.0
#: Numbers in the format per metre.
DEPTH_SCALE = 1000.0
#: fx, fy, cx, cy as OpenCV counts (belongs to the format).
DEPTH_CAMERA = (585.0, 585.0, 320.0, 240.0)
#: The same of the colour camera (belongs to the format).
COLOR_CAMERA = (525.0, 525.0, 320.0, 240.0)
#: color_from_depth of a Kinect, 3x4, metres (belongs to the format).
COLOR_FROM_DEPTH = np.array(
    [
        [0.99996518, 0.00267651, -0.00790410, -0.02555894],
        [-0.00274093, 0.99996303, -0.00815045, 0.00010110],
        [0.00788199, 0.00817183, 0.99993555, 0.00203183],
    ]
)


@loop
def register_depth(depth, depth_camera, color_camera, color_from_depth, registered):
    """Move depth (H, W) to another camera; ``registered`` (h, w) receives the nearest depths, 0 where there is none."""
    registered[:, :] = 0.0
    T = color_from_depth
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = float(depth[v, u])
            if not z > 0.0:
                continue
            x = (u + 0.5 - depth_camera[2]) / depth_camera[0] * z
            y = (v + 0.5 - depth_camera[3]) / depth_camera[1] * z
            other = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if not other > 0.0:
                continue
            a = color_camera[0] * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / other + color_camera[2]
            b = color_camera[1] * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / other + color_camera[3]
            if 0.0 <= a < registered.shape[1] and 0.0 <= b < registered.shape[0]:
                column, row = int(a), int(b)
                if registered[row, column] == 0.0 or other < registered[row, column]:
                    registered[row, column] = other


def seven_scenes_root(folder: Path) -> Path | None:
    """Return the folder that holds the frames, or None if a folder does not have this layout."""
    for root in (folder, folder / "frames"):
        if root.is_dir() and next(root.glob("*.color.*"), None) is not None:
            return root
    return None


def open_seven_scenes(root: Path, wishes: Wishes) -> FileSequence:
    """Open the folder that holds the frames; ``calibration`` is that of the colour camera.

    See :func:`groma.io.sequences.open_sequence`.
    """
    warnings: list[str] = []
    colors = sorted(root.glob("*.color.*"), key=_number)
    depths = {_number(path): path for path in root.glob("*.depth.*")}
    kind = wishes.selection.kind_of("rgbd" if depths else "mono")
    entries = [Entry(_number(path) / RATE, path, depths.get(_number(path))) for path in colors]
    calibration = wishes.calibration or from_opencv(COLOR_CAMERA)
    given = next((path for path in (root.parent, root) if (path / "camera-intrinsics.txt").is_file()), None)
    depth_camera = from_opencv(DEPTH_CAMERA) if given is None else read_calibration(given / "camera-intrinsics.txt")
    source, target = depth_camera.pinhole(), calibration.pinhole()
    transform = np.ascontiguousarray(COLOR_FROM_DEPTH)

    def register(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        registered = np.empty_like(depth)
        register_depth(depth, source, target, transform, registered)
        return registered

    preparation = Preparation(
        depth_scale=wishes.depth_scale or DEPTH_SCALE, register=register if kind == "rgbd" else None
    )
    return simple_sequence(
        kind, wishes.selection.of(entries, warnings), calibration, _reference(root, colors), warnings, preparation
    )


def _number(path: Path) -> int:
    digits = re.search(r"\d+", path.name)
    if digits is None:
        raise FileFormatError(f"{path} has no number in its name; expected frame-000000.color.png and the like.")
    return int(digits[0])


def _reference(root: Path, colors: list[Path]) -> Trajectory | None:
    """Return the poses of the colour camera, as far as there are files."""
    times: list[float] = []
    poses: list[FloatArray] = []
    for color in colors:
        path = root / (color.name.split(".")[0] + ".pose.txt")
        if not path.is_file():
            continue
        with reading(path, "pose"):
            words = [word for _, row in read_words(path) for word in row]
            matrix = np.array([float(word) for word in words]).reshape(4, 4)
            if not np.isfinite(matrix).all():
                continue  # frames that were not tracked
            matrix[:3, :3] = so3.nearest(matrix[:3, :3])
            times.append(_number(color) / RATE)
            poses.append(se3.from_matrix(matrix))
    if not poses:
        return None
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = so3.nearest(COLOR_FROM_DEPTH[:, :3]), COLOR_FROM_DEPTH[:, 3]
    depth_from_color = np.broadcast_to(se3.inverse(se3.from_matrix(matrix)), (len(poses), 7))
    return Trajectory(np.array(times), se3.compose(np.array(poses), depth_from_color))
