# SPDX-License-Identifier: BSD-3-Clause
"""Do photographs show the points of a model? Those of another scene may have the same names.

Where two photographs see a point, they look alike: more alike than this place of the one and any other of the other. Of
another scene's points they are so half of the time, by chance, and somewhat more often, as the sky is above the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from groma._typing import FloatArray
from groma.cameras import model as camera_model
from groma.errors import InputError
from groma.execution import map_in_threads
from groma.features.sift import describe_upright
from groma.gates import gate
from groma.geometry import quaternion
from groma.mapping.photographs import read_gray
from groma.scene import Scene


@dataclass(frozen=True)
class ShownGates:
    """How photographs are compared with the points of a model."""

    pairs: int = gate(5, "pairs", "of the images that see most points, each with another", "cost: 0.2 s each")
    points: int = gate(200, "points", "of a pair at most", "cost: of describing them")
    least: int = gate(20, "points", "of a pair at least", "derived from ranks: the share is good to a tenth")
    roll: float = gate(0.5, "rad", "between the photographs of a pair", "convention: places are described upright")
    alike: float = gate(
        0.8, "share", "of other places that are less alike, in the median of the pairs",
        "chosen on castle, fountain, Herz-Jesus, cabinet, kitchen: at least 0.95, at others' points at most 0.65",
    )  # fmt: skip


GATES = ShownGates()


def check_points_shown(scene: Scene, files: Sequence[Path]) -> None:
    """Check that photographs show the points of a model.

    Parameters
    ----------
    scene
        The model. Where its images share too few points, nothing is checked.
    files
        The photographs of its images.

    Raises
    ------
    InputError
        If most pairs that were looked at do not.
    """
    count = np.bincount(scene.point_observations.image_idx, minlength=scene.num_images)
    most = np.argsort(-count, kind="stable")[: GATES.pairs].tolist()
    pairs = [pair for pair in map_in_threads(partial(_compared, scene, files), most) if pair is not None]
    middle = sorted(pairs)[len(pairs) // 2] if pairs else (1.0, "")
    if middle[0] < GATES.alike:
        raise InputError(
            f"The photographs do not show the points of the model: where {middle[1]} should see the same point, they "
            f"are more alike than elsewhere in {100 * middle[0]:.0f} % of cases (right ones in nearly all, others in "
            "about 50 %). Photographs of another scene may have the same names: pass those that the model was made "
            "from."
        )


def _compared(scene: Scene, files: Sequence[Path], image: int) -> tuple[float, str] | None:
    """How alike a photograph and another are where both see a point, and their names; None if these points are few."""
    other, pixels = _shared(scene, image)
    first, second = (_described(files[i], own) for i, own in zip((image, other), pixels, strict=True))
    shown = first.any(axis=1) & second.any(axis=1)
    if shown.sum() < GATES.least:
        return None
    alike = first[shown] @ second[shown].T
    share = float((np.diag(alike)[:, None] > alike).sum()) / (len(alike) * (len(alike) - 1))
    return share, f"{files[image]} and {files[other].name}"


def _shared(scene: Scene, image: int) -> tuple[int, list[FloatArray]]:
    """The image that shares most points with one, of those held alike; and the pixels (n, 2) of some in both."""
    table, rotation = scene.point_observations, quaternion.to_matrix(scene.cam_from_world[:, :4])
    own = np.flatnonzero(table.image_idx == image)
    seen = np.zeros(scene.num_points, bool)
    seen[table.point_idx[own]] = True
    count = np.bincount(table.image_idx[seen[table.point_idx]], minlength=scene.num_images)
    turn = rotation @ rotation[image].T
    roll = np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])
    flat = np.array([camera_model(name).is_planar for name in scene.cameras.models])[scene.images.camera_idx]
    count[(np.abs(roll) > GATES.roll) | ~flat | (np.arange(scene.num_images) == image) | ~flat[image]] = 0
    other = int(np.argmax(count))
    there = np.flatnonzero(table.image_idx == other) if count[other] else own[:0]
    _, here, there_too = np.intersect1d(table.point_idx[own], table.point_idx[there], return_indices=True)
    step = max(len(here) // GATES.points, 1)
    return other, [table.pixel[own[here[::step]]], table.pixel[there[there_too[::step]]]]


def _described(file: Path, pixels: FloatArray) -> FloatArray:
    """Descriptors (n, 128) of places of a photograph, of length one; zeros where there is none."""
    out = np.zeros((len(pixels), 128))
    if len(pixels):
        found, rows = describe_upright(read_gray(file), pixels)
        out[rows] = np.sqrt(found.descriptors / np.maximum(found.descriptors.sum(axis=1, keepdims=True), 1e-9))
    return out
