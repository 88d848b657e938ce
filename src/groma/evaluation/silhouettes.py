# SPDX-License-Identifier: BSD-3-Clause
"""How far lines leave the silhouette of an object: a true line of it projects into the silhouette from every view.

Neither a mesh nor edges are needed, only masks of the object. What hides what does not matter: hidden edges project
into the silhouette, too. A contour that moves with the view becomes a chord or a tangent, which leaves it somewhere.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from groma._typing import FloatArray
from groma.bounded.images import decoded
from groma.cameras import model as camera_model
from groma.errors import InputError
from groma.evaluation.lines import places_on
from groma.geometry import quaternion
from groma.scene import Scene
from groma.scene.line_intervals import line_pieces

#: Places along a line that are tested in a view (cost: time).
_PLACES = 100
#: Distances at which lines are counted, pixels (convention: rows of the report).
LIMITS = (1.0, 3.0, 10.0)


@dataclass(frozen=True)
class SilhouetteScores:
    """How far the lines of a scene leave the silhouettes."""

    #: (L,) greatest distance of a place of each line from the silhouette in any view, pixels.
    distance: FloatArray
    #: Number of views that have a silhouette.
    num_views: int

    def to_dict(self) -> dict[str, object]:
        """Return counts for a machine-readable report."""
        outside = {f"{limit:g}": int((self.distance > limit).sum()) for limit in LIMITS}
        worst = float(self.distance.max(initial=0.0))
        return {"num_lines": len(self.distance), "num_views": self.num_views, "outside_px": outside, "worst_px": worst}


def evaluate_silhouettes(scene: Scene, masks: Mapping[str, npt.NDArray[np.bool_]]) -> SilhouetteScores:
    """Return how far the supported intervals of lines leave the silhouettes of an object.

    Parameters
    ----------
    scene : Scene
        Lines, and the cameras of the views.
    masks : mapping of str to (H, W) bool
        Where the object is, by name of the image. Places outside of a mask's frame, and behind the camera, do not
        count, nor do masks without the object, from which there is no distance.

    Raises
    ------
    InputError
        If no image of the scene has a mask.
    """
    pieces, line = line_pieces(scene)
    places, owner = places_on(pieces, np.full(len(pieces), _PLACES))
    views = [(image, masks[name]) for image, name in enumerate(scene.images.names) if name in masks]
    views = [(image, mask) for image, mask in views if mask.any()]
    if not views:
        raise InputError(
            "No image of the scene has a silhouette. Name the masks like the images; the object is not black."
        )
    distance, poses = np.zeros(len(places)), scene.cam_from_world
    for image, mask in views:
        camera = scene.images.camera_idx[image]
        model = camera_model(scene.cameras.models[camera])
        in_cam = np.ascontiguousarray(quaternion.rotate(poses[image, :4], places) + poses[image, 4:])
        pixels = model.project(scene.cameras.params[camera, : model.num_parameters], in_cam)
        seen = np.isfinite(pixels).all(axis=1) & (model.sees_behind | (in_cam[:, 2] > 0.0))
        size = np.array([scene.cameras.width[camera], scene.cameras.height[camera]], float)
        scale = np.array(mask.shape[::-1]) / np.where(size > 0, size, mask.shape[::-1])
        at = np.floor(np.where(seen[:, None], pixels, -1.0) * scale).astype(np.int64)
        inside = ((at >= 0) & (at < mask.shape[::-1])).all(axis=1)
        away = np.asarray(distance_transform_edt(~mask)) / scale.mean()
        rows = np.flatnonzero(seen & inside)
        distance[rows] = np.maximum(distance[rows], away[at[rows, 1], at[rows, 0]])
    worst = np.zeros(scene.num_lines)
    np.maximum.at(worst, line[owner], distance)
    return SilhouetteScores(worst, len(views))


def read_silhouettes(folder: str | os.PathLike[str], names: tuple[str, ...]) -> dict[str, npt.NDArray[np.bool_]]:
    """Read masks of images: files of the same names, or with another ending, that are not black where the object is.

    Raises
    ------
    InputError
        If the folder is none, or a file is no image.
    """
    place = Path(folder)
    if not place.is_dir():
        raise InputError(f"{place} is not a folder. Pass the folder of the silhouettes.")
    masks = {}
    for name in names:
        stem = place / Path(name).with_suffix("")
        files = sorted(stem.parent.glob(f"{stem.name}.*")) if stem.parent.is_dir() else []
        if files:
            picture = decoded(files[0].read_bytes(), 0)  # grey
            if picture is None:
                raise InputError(f"{files[0]} is not an image that can be read. Save the silhouette as PNG.")
            masks[name] = picture > 0
    return masks
