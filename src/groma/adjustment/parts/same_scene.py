# SPDX-License-Identifier: BSD-3-Clause
"""What is the same in all parts of a scene: cameras, images, poses, planes and directions."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from groma.errors import InputError
from groma.scene import Scene


def check_same_scene(path: Path, scene: Scene, first: Path, head: Scene, planes: bool = True) -> None:
    """Refuse a part that is not of the same scene as the first.

    Raises
    ------
    InputError
        If it has other images, cameras or poses; or, where they take part, other planes or directions.
    """
    if path == first:
        return
    if _of_cameras(scene) != _of_cameras(head):
        raise InputError(
            f"{path} has other images or cameras than {first}, or other poses. All parts need the same ones: cut one "
            "scene with groma convert --parts."
        )
    if planes and _of_planes(scene) != _of_planes(head):
        raise InputError(
            f"{path} has other planes or directions than {first}. All parts need the same ones: cut one scene with "
            "groma convert --parts, or leave planes out (--no-planes)."
        )


def _of_cameras(scene: Scene) -> str:
    poses = scene.frames.rig_from_world, scene.sensors.cam_from_rig
    names = repr((scene.images.names, scene.cameras.models))
    return _digest(names, scene.cameras.params, scene.images.frame_idx, *poses)


def _of_planes(scene: Scene) -> str:
    planes, directions = scene.planes, scene.directions
    return _digest("", planes.ids, planes.hesse, directions.ids, directions.vectors)


def _digest(names: str, *arrays: np.ndarray) -> str:
    state = hashlib.sha256(names.encode())
    for array in arrays:
        state.update(np.ascontiguousarray(array).tobytes())
    return state.hexdigest()
