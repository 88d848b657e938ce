# SPDX-License-Identifier: BSD-3-Clause
r"""When, while an image with a rolling shutter was read, something was seen: what factors need besides the pose.

The row where a landmark appears depends on the pose, and the pose on the row. Taking the row where it was **observed**
settles that, but is wrong by a little that adds up: with the motion :math:`p'` of the image, pixels per row, the noise
:math:`\varepsilon` of the row leaves a residual of :math:`(1 - p')\,\varepsilon`, so least squares would choose motions
that make all residuals smaller. Where directions of readout are parallel, little else holds the motions. So the row is
that where the scene, as it is when the problem is made, **predicts** the landmark:

.. math:: s_{k+1} = s\big(\pi(T(s_k)\,X)\big), \qquad s_0 \text{ from the observed row},

which noise enters only as far as it has entered the scene. What is not predicted near where it was observed keeps the
observed row: at a start far from the solution, and of wrong matches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.terms.contract import Draft
from groma.cameras import model as camera_model
from groma.errors import InputError
from groma.factors.contract import Ref
from groma.gates import NORMAL, gate
from groma.geometry import quaternion
from groma.geometry.algebra import unit
from groma.scene import Scene
from groma.scene.motions import COLUMNS

#: The group of the motions: those of the table, and one that is held at zero, of images that were taken at once.
MOTIONS = "motions"


@dataclass(frozen=True)
class ReadoutGates:
    """Which row counts."""

    iterations: int = gate(3, "times", "that a row is predicted", "cost: each is ten times nearer than the last")


GATES = ReadoutGates()


def offsets_of(scene: Scene, image_idx: IntArray, pixels: FloatArray) -> FloatArray:
    """Return when in the readout, from -1/2 to 1/2, pixels (N, 2) were taken, (N,)."""
    table, camera = scene.camera_motions, scene.images.camera_idx[image_idx]
    axis = np.zeros(scene.num_images, np.int64)
    axis[table.image_idx] = table.axis
    by_columns = axis[image_idx] == COLUMNS
    size = np.where(by_columns, scene.cameras.width[camera], scene.cameras.height[camera])
    return np.where(by_columns, pixels[:, 0], pixels[:, 1]) / np.maximum(size, 1) - 0.5


def motion_of(scene: Scene, image_idx: IntArray) -> FloatArray:
    """Return the motions (N, 6) of images; zeros for those that were taken at once."""
    motion = np.zeros((scene.num_images, 6))
    motion[scene.camera_motions.image_idx] = scene.camera_motions.motion
    return motion[image_idx]


def point_refs(draft: Draft, name: str, image_idx: IntArray, xyz: FloatArray, pixels: FloatArray) -> dict[str, Any]:
    """Return motions, and when points were seen, for factors of points in cameras of one model.

    Parameters
    ----------
    draft : Draft
        The scene.
    name : str
        The camera model.
    image_idx, xyz, pixels : (N,) int, (N, 3) and (N, 2) float
        The images, the points in the world, and where they were observed.
    """
    scene = draft.scene
    if not len(scene.camera_motions):
        return {}
    poses, motion, params = scene.cam_from_world[image_idx], motion_of(scene, image_idx), draft.params(name, image_idx)
    inside = quaternion.rotate(poses[:, :4], xyz) + poses[:, 4:]

    def predict(s: FloatArray) -> FloatArray:
        moved = quaternion.rotate(_turn(motion, s), inside - s[:, None] * motion[:, :3])
        return camera_model(name).project(params, moved)

    return _refs(draft, image_idx, [(pixels, predict)], draft.options.point_sigma_px)


def line_refs(
    draft: Draft, name: str, image_idx: IntArray, plucker: FloatArray, places: tuple[FloatArray, FloatArray]
) -> dict[str, Any]:
    """Return motions, and when the two places (N, 2) of segments were seen: where the image of the line is nearest."""
    scene = draft.scene
    if not len(scene.camera_motions):
        return {}
    poses, motion, params = scene.cam_from_world[image_idx], motion_of(scene, image_idx), draft.params(name, image_idx)
    model = camera_model(name)
    d = quaternion.rotate(poses[:, :4], plucker[:, 3:])
    m = quaternion.rotate(poses[:, :4], plucker[:, :3]) + np.cross(poses[:, 4:], d)

    def predicting(place: FloatArray) -> Callable[[FloatArray], FloatArray]:
        ray = model.unproject(params, place)

        def predict(s: FloatArray) -> FloatArray:
            moved = m - np.cross(s[:, None] * motion[:, :3], d)
            normal = unit(quaternion.rotate(_turn(motion, s), moved))
            return model.project(params, ray - np.einsum("ni,ni->n", ray, normal)[:, None] * normal)

        return predict

    ends = [np.ascontiguousarray(place) for place in places]
    return _refs(draft, image_idx, [(end, predicting(end)) for end in ends], draft.options.line_sigma_px)


def _turn(motion: FloatArray, s: FloatArray) -> FloatArray:
    return quaternion.exp(-s[:, None] * motion[:, 3:])


def _refs(
    draft: Draft,
    image_idx: IntArray,
    seen: list[tuple[FloatArray, Callable[[FloatArray], FloatArray]]],
    sigma_px: float,
) -> dict[str, Any]:
    """Return ``motion`` and ``offsets`` of factors, from observed places and what predicts each at a time."""
    scene, table = draft.scene, draft.scene.camera_motions
    sizes = np.minimum(scene.cameras.width, scene.cameras.height)[scene.images.camera_idx[table.image_idx]]
    if (sizes == 0).any():
        raise InputError(
            "A rolling shutter needs the size of the images, and a camera has none. Give width and height."
        )
    offsets = []
    for pixels, predict in seen:
        observed = offset = offsets_of(scene, image_idx, pixels)
        near = np.zeros(len(pixels), dtype=bool)
        for _ in range(GATES.iterations):
            place = predict(offset)
            near = np.linalg.norm(place - pixels, axis=1) <= NORMAL.mistake * sigma_px  # False for NaN
            offset = np.where(near, offsets_of(scene, image_idx, np.where(near[:, None], place, pixels)), observed)
        offsets.append(offset)
    row = np.full(scene.num_images, len(table))
    row[table.image_idx] = np.arange(len(table))
    return {"motion": Ref(MOTIONS, row[image_idx]), "offsets": np.stack(offsets, axis=1)}
