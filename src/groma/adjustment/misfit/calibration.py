# SPDX-License-Identifier: BSD-3-Clause
"""Calibrations that cannot be those of the images, recognised before an adjustment."""

from __future__ import annotations

import numpy as np

from groma._counted import counted
from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.misfit.lens import LENS
from groma.cameras import model as camera_model
from groma.errors import ProblemError
from groma.scene import Scene


def refuse_focal_lengths(scene: Scene) -> None:
    """Raise ProblemError, naming the camera, where one that took an image has no usable focal length."""
    cameras, used = scene.cameras, _used(scene)
    for name, rows in cameras.by_model().items():
        model = camera_model(name)
        needed = cameras.params[rows][:, [*model.focal_indices, *model.known_indices]]
        bad = used[rows] & ~(np.isfinite(needed) & (needed > 0.0)).all(axis=1)
        if not bad.any():
            continue
        what = "focal lengths" if model.is_planar else "width and height"
        raise ProblemError(
            f"Camera {cameras.ids[rows[bad][0]]} ({model.name}) needs positive {what} in pixels; got "
            f"{needed[bad][0].tolist()}. Correct them in the scene's cameras."
        )


def doubtful_cameras(scene: Scene) -> tuple[str, ...]:
    """Return sentences about cameras of unknown size, and about those whose observations lie outside their images.

    BAL files have no image sizes; their cameras are not checked.
    """
    cameras = scene.cameras
    used = _used(scene) & np.array([name != "BAL" for name in cameras.models], bool)
    if not used.any():
        return ()
    sized = (cameras.width > 0) & (cameras.height > 0)
    said = []
    if len(unsized := np.flatnonzero(used & ~sized)):
        have = "has" if len(unsized) == 1 else "have"
        said.append(
            f"{_named(scene, unsized)} {have} no image size (0 x 0 pixels): whether the observations are inside cannot "
            "be checked. Give the cameras their width and height."
        )
    share_outside = _share_outside(scene)
    if len(strange := np.flatnonzero(used & sized & (share_outside > LENS.share_outside))):
        first, share = strange[0], share_outside[strange[0]]
        said.append(
            f"{_named(scene, strange)}: {100 * share:.0f} % of the observations are outside the image of "
            f"{cameras.width[first]} x {cameras.height[first]} pixels. Is the calibration of images of another size? "
            "Give the cameras the size and parameters that belong to the photographs."
        )
    return tuple(said)


def _used(scene: Scene) -> BoolArray:
    """Which cameras took an image."""
    used = np.zeros(len(scene.cameras), bool)
    used[scene.images.camera_idx] = True
    return used


def _share_outside(scene: Scene) -> FloatArray:
    """Share of the observations of each camera that are outside its image; 0 without observations."""
    points, lines = scene.point_observations, scene.line_observations
    image = np.concatenate([points.image_idx, np.repeat(lines.image_idx, 2)])
    pixel = np.concatenate([points.pixel, lines.segment.reshape(-1, 2)])
    camera, cameras = scene.images.camera_idx[image], scene.cameras
    outside = (pixel[:, 0] > cameras.width[camera]) | (pixel[:, 1] > cameras.height[camera]) | (pixel < 0.0).any(axis=1)
    count = np.bincount(camera, minlength=len(cameras))
    return np.bincount(camera, weights=outside, minlength=len(cameras)) / np.maximum(count, 1)


def _named(scene: Scene, rows: IntArray) -> str:
    first = f"Camera {scene.cameras.ids[rows[0]]}"
    return first if len(rows) == 1 else f"{first} and {counted(len(rows) - 1, 'others')}"
