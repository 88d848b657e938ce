# SPDX-License-Identifier: BSD-3-Clause
"""What makes a scene valid: all references point somewhere, quaternions are of unit length, cameras are consistent.

And what callers pass where a scene is wanted: refused, with the way to one, unless it is a scene.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from groma.errors import InputError, check_kind
from groma.scene.camera import CAMERA
from groma.scene.table import OBJECTS, check_index, check_quaternions, object_references, references

if TYPE_CHECKING:
    from groma.scene.scene import Scene


def check_scene_given(value: object, name: str = "scene", *other: type) -> None:
    """Raise InputError unless a value is a scene, or of another kind that will do; ``name`` is that of the argument."""
    from groma.scene.scene import Scene

    if isinstance(value, (Scene, *other)):
        return
    has_one = isinstance(getattr(value, "scene", None), Scene)
    way = (
        "It has a scene: pass its .scene."
        if has_one
        else "Read one with groma.read_scene(path), or turn a pycolmap.Reconstruction into one with "
        "groma.io.from_pycolmap(reconstruction)."
    )
    check_kind(value, (Scene, *other), name, way)


def check_scene(scene: Scene) -> None:
    """Raise InputError or ShapeError where a scene is not valid."""
    for name, column, side, target in references(type(scene)):
        if len(index := getattr(getattr(scene, name), column)):
            where, index = (column, index) if side is None else (f"{column}[:, {side}]", index[:, side])
            check_index(f"{name}.{where}", index, len(getattr(scene, target)), target.replace("_", " "))
    _check_objects(scene)
    is_camera = scene.sensors.kind == CAMERA
    check_index("sensors.camera_idx", scene.sensors.camera_idx[is_camera], len(scene.cameras), "cameras")
    check_quaternions("frames.rig_from_world", scene.frames.rig_from_world)
    check_quaternions("sensors.cam_from_rig", scene.sensors.cam_from_rig)
    check_quaternions("pose_priors.rig_from_world", scene.pose_priors.rig_from_world)
    check_quaternions("camera_poses.cam_from_world", scene.camera_poses.cam_from_world)
    if len(scene.images):
        sensor = scene.images.sensor_idx
        if (scene.sensors.camera_idx[sensor] != scene.images.camera_idx).any() or (~is_camera[sensor]).any():
            raise InputError("images.camera_idx must be the camera of the image's sensor. Correct one of the two.")
        if (scene.sensors.rig_idx[sensor] != scene.frames.rig_idx[scene.images.frame_idx]).any():
            raise InputError("images.sensor_idx must be a sensor of the rig of the image's frame. Correct one.")


def _check_objects(scene: Scene) -> None:
    """Raise where columns that refer to objects by kind point nowhere."""
    for name, column, kinds in object_references(type(scene)):
        table = getattr(scene, name)
        if not len(table):
            continue
        for number in np.unique(getattr(table, kinds)):
            rows = getattr(table, kinds) == number
            target = OBJECTS[number]
            check_index(f"{name}.{column}", getattr(table, column)[rows], len(getattr(scene, target)), target)
