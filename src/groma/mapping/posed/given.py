# SPDX-License-Identifier: BSD-3-Clause
"""A scene without points from a file of poses, with the calibration of the file, a given one, or one to estimate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from groma.adjustment.terms.principal_points import near_the_middle
from groma.io.colmap.calibrations import cameras_of_photographs
from groma.io.colmap.sfm import PointModelOptions
from groma.io.pose_files import read_poses
from groma.mapping.photographs import image_files
from groma.scene import Scene


@dataclass(frozen=True, eq=False)
class GivenScene:
    """Photographs at the poses of a file."""

    #: Cameras, names and poses; no points.
    scene: Scene
    #: Whether the calibration is known; else it is a guess, to be estimated.
    calibrated: bool
    #: What was concluded.
    sentences: tuple[str, ...]


def scene_at_poses(images: Path, poses: Path, options: PointModelOptions) -> GivenScene:
    """Return the photographs of a folder at the poses of a file.

    Parameters
    ----------
    images, poses : Path
        The folder, and the file; see :func:`groma.io.pose_files.read_poses`.
    options : PointModelOptions
        Camera model and parameters: parameters count for more than those of the file, and a model alone is that of the
        guess where the file holds no calibration.

    Raises
    ------
    InputError
        If poses and photographs do not belong together.
    FileFormatError
        If the file is damaged or of an unknown kind.
    """
    names = [path.relative_to(images).as_posix() for path in image_files(images)]
    found = read_poses(poses, names)
    cameras, camera_idx = found.cameras, found.camera_idx
    calibrated, said = options.camera_params is not None or cameras is not None, list(found.sentences)
    if cameras is None or options.camera_params is not None:
        cameras, camera_idx = cameras_of_photographs(images, found.names, options.camera_model, options.camera_params)
    if not calibrated:
        focal = np.unique(np.round(cameras.params[:, 0]))
        said.append(
            f"{poses} holds no calibration: the focal length is estimated, beginning at "
            f"{', '.join(f'{one:g}' for one in focal[:4])} pixels (EXIF, or 1.2 times the longer side)."
        )
    scene = Scene.from_images(cameras, found.names, camera_idx, found.cam_from_world)
    return GivenScene(scene if calibrated else near_the_middle(scene), calibrated, tuple(said))
