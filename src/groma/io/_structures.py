# SPDX-License-Identifier: BSD-3-Clause
"""Lines, planes, directions and relations beside a COLMAP model: ``structures/groma.npz``."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np

from groma._typing import IntArray
from groma.io.archive import read_archive, write_archive
from groma.scene import Keypoints, PointObservations, Relations, Scene

_NAME = Path("structures") / "groma.npz"


def write_structures(scene: Scene, folder: Path) -> None:
    """Write what a COLMAP model cannot hold, where there is any of it."""
    if not (scene.num_lines or scene.num_planes or scene.num_directions):
        return
    (folder / _NAME.parent).mkdir()
    write_archive(scene.replace(point_observations=PointObservations(), keypoints=Keypoints()), folder / _NAME)


def read_structures(scene: Scene, folder: Path) -> Scene:
    """Return the scene with the structures found beside its model; rows whose image or point is gone are left out."""
    if not (folder / _NAME).is_file():
        return scene
    stored = read_archive(folder / _NAME)
    image = _translation(stored.images.ids, scene.images.ids)
    point = _translation(stored.points.ids, scene.points.ids)
    seen = stored.line_observations
    seen = seen.replace(image_idx=image[seen.image_idx]).take(image[seen.image_idx] >= 0)
    relations = {}
    for item in fields(stored.relations):
        pairs = getattr(stored.relations, item.name).copy()
        if item.name.startswith("point_"):
            pairs[:, 0] = point[pairs[:, 0]]
        relations[item.name] = pairs[pairs[:, 0] >= 0]
    return scene.replace(
        lines=stored.lines,
        line_observations=seen,
        planes=stored.planes,
        directions=stored.directions,
        relations=Relations(**relations),
    )


def _translation(old_ids: IntArray, new_ids: IntArray) -> IntArray:
    """Return for each old row the new row with the same identifier, -1 where there is none."""
    order = np.argsort(new_ids)
    place = np.searchsorted(new_ids[order], old_ids)
    found = np.append(order, -1)[np.minimum(place, len(order))]
    same = np.append(new_ids, -1)[found] == old_ids
    return np.where(same & (found >= 0), found, -1)
