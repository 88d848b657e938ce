# SPDX-License-Identifier: BSD-3-Clause
"""What makes a scene valid: references point to rows, quaternions have unit length, cameras and rigs are consistent."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from groma.errors import InputError
from groma.scene.camera import CAMERA
from groma.scene.table import OBJECTS, check_index, check_quaternions, object_references, references

if TYPE_CHECKING:
    from groma.scene.scene import Scene


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
    """Raise where a column that refers to objects by kind has an index out of range."""
    for name, column, kinds in object_references(type(scene)):
        table = getattr(scene, name)
        if not len(table):
            continue
        for number in np.unique(getattr(table, kinds)):
            rows = getattr(table, kinds) == number
            target = OBJECTS[number]
            check_index(f"{name}.{column}", getattr(table, column)[rows], len(getattr(scene, target)), target)
