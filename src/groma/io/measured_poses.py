# SPDX-License-Identifier: BSD-3-Clause
"""Poses of cameras as measurements, from any file of poses; those by image name may have covariances."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from groma.bounded.text import read_lines
from groma.errors import GromaError
from groma.geometry import se3
from groma.io.pose_files import read_poses
from groma.io.survey.rows import PosesFile, is_measured_poses, read_measured_poses


def read_camera_poses(path: str | os.PathLike[str], images: Sequence[str]) -> PosesFile:
    """Read poses of images: :func:`~groma.io.survey.rows.read_measured_poses`, or any file of poses without noise.

    Parameters
    ----------
    path : path
        The file.
    images : sequence of str
        Names of the images, to assign poses of a file without names.

    Raises
    ------
    FileFormatError, InputError
        If the file is damaged, or its poses cannot be assigned to images.
    """
    if _by_name(Path(path)):
        return read_measured_poses(path)
    found = read_poses(path, images)
    world_from_cam = se3.inverse(found.cam_from_world)
    poses = np.hstack([world_from_cam[:, 4:], world_from_cam[:, :4]])
    return PosesFile(found.names, poses, np.full((len(poses), 6, 6), np.nan), str(path))


def holds_covariances(path: str | os.PathLike[str]) -> bool:
    """Tell whether a file holds poses by name with their noise; False where it cannot be read."""
    try:
        return _by_name(Path(path)) and bool(np.isfinite(read_measured_poses(path).covariance).any())
    except (GromaError, OSError):
        return False


def _by_name(place: Path) -> bool:
    if not place.is_file() or place.suffix.lower() in (".npz", ".json", ".nvm", ".g2o"):
        return False
    try:
        return is_measured_poses(next((line for _, line in read_lines(place)), ""))
    except (GromaError, OSError, UnicodeDecodeError):
        return False
