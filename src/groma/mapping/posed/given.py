# SPDX-License-Identifier: BSD-3-Clause
"""A scene without points from a file of poses, with the calibration of the file, a given one, or one to estimate; and
scenes in the pixels of photographs that were made smaller or larger.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from groma import cameras as camera_models
from groma.adjustment.terms.principal_points import near_the_middle
from groma.io.colmap.calibrations import cameras_of_photographs
from groma.io.colmap.sfm import PointModelOptions
from groma.io.interchange.poses import size_of_image
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
    if not calibrated:
        return GivenScene(near_the_middle(scene), False, tuple(said))
    scene, scaled = in_pixels_of(scene, images)
    return GivenScene(scene, True, (*said, *scaled))


def in_pixels_of(scene: Scene, images: Path) -> tuple[Scene, tuple[str, ...]]:
    """Return a scene in the pixels of photographs that were made smaller or larger than its cameras, and say so.

    A camera is scaled where all its photographs have one size of its proportions, as far as pixels allow, and both
    sides differ. Anything else stays as it is, for :func:`groma.mapping.photographs.check_images` to refuse.
    """
    of_image = np.array([size_of_image(images, name) for name in scene.images.names], float).reshape(-1, 2)
    was = np.stack([scene.cameras.width, scene.cameras.height], axis=1)
    scale, params = np.ones(was.shape), scene.cameras.params.copy()
    order = np.argsort(scene.images.camera_idx, kind="stable")
    of_camera = np.split(of_image[order], np.cumsum(np.bincount(scene.images.camera_idx, minlength=len(was)))[:-1])
    for row, (size, sizes) in enumerate(zip(was, of_camera, strict=True)):
        found = np.unique(sizes[sizes.all(axis=1)], axis=0)
        model = camera_models.model(scene.cameras.models[row])
        center = list(model.principal_point_indices)  # panoramas have none
        # derived: width and height are each off by less than a pixel
        slip = abs(found[0] @ (size[1], -size[0])) if center and len(found) == 1 and size.all() else np.inf
        if not slip < size.sum() or (found[0] == size).any():
            continue
        scale[row] = found[0] / size
        focal = list(model.focal_indices)
        params[row, focal] *= scale[row] if len(focal) == 2 else scale[row].mean()
        params[row, center] *= scale[row]
    fixed = any(len(table) for table in (scene.marks, scene.right_columns, scene.camera_motions, scene.line_depths))
    if fixed or (scale == 1.0).all():
        return scene, ()
    width, height = np.round(was * scale).astype(np.int64).T
    points, keypoints, lines = scene.point_observations, scene.keypoints, scene.line_observations
    camera, priors = scene.images.camera_idx, scene.principal_point_priors
    scaled = scene.replace(
        cameras=scene.cameras.replace(params=params, width=width, height=height),
        point_observations=points.replace(pixel=points.pixel * scale[camera[points.image_idx]]),
        keypoints=keypoints.replace(pixel=keypoints.pixel * scale[camera[keypoints.image_idx]]),
        line_observations=lines.replace(segment=lines.segment * np.tile(scale[camera[lines.image_idx]], 2)),
        principal_point_priors=priors.replace(
            pixel=priors.pixel * scale[priors.camera_idx], sigma=priors.sigma * scale[priors.camera_idx].mean(axis=1)
        ),
    )
    factors = ", ".join(f"{one:.3g}" for one in np.unique(scale.mean(axis=1))[:4])
    return scaled, (
        f"The photographs have {factors} times the size of the model's cameras, which were scaled with them.",
    )
