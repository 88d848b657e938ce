# SPDX-License-Identifier: BSD-3-Clause
"""From a scene to a :class:`pycolmap.Reconstruction`."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from groma import cameras as camera_models
from groma._typing import FloatArray, IntArray
from groma.errors import InputError
from groma.io._numbering import numbered_keypoints
from groma.io.colmap.load import load_pycolmap
from groma.scene import Cameras, Scene, Sensors
from groma.scene.camera import CAMERA
from groma.scene.checks import check_scene_given

if TYPE_CHECKING:
    import pycolmap


def to_pycolmap(scene: Scene, points: bool = True) -> pycolmap.Reconstruction:
    """Return a :class:`pycolmap.Reconstruction` of cameras, rigs, frames, images and, if wanted, points of a scene."""
    check_scene_given(scene)
    pycolmap = load_pycolmap()
    reconstruction = pycolmap.Reconstruction()
    for row, number in enumerate(scene.cameras.ids.tolist()):
        name, params = colmap_camera(scene.cameras, row)
        reconstruction.add_camera(
            pycolmap.Camera(
                camera_id=number,
                model=name,
                width=int(scene.cameras.width[row]),
                height=int(scene.cameras.height[row]),
                params=params,
            )
        )
    _add_rigs(pycolmap, reconstruction, scene)
    pixels, keypoint_idx = _numbered(scene)
    _add_images(pycolmap, reconstruction, scene, pixels)
    if points:
        _add_points(pycolmap, reconstruction, scene, keypoint_idx)
    return reconstruction


def colmap_camera(cameras: Cameras, row: int) -> tuple[str, list[float]]:
    """Return COLMAP's name of the model of a camera and its parameters; raise InputError where COLMAP has none."""
    name, params = cameras.models[row], cameras.params_of(row).tolist()
    if name == "BAL":
        return "RADIAL", [params[0], cameras.width[row] / 2, cameras.height[row] / 2, *params[1:]]
    colmap_name = camera_models.model(name).colmap_name
    if colmap_name is None:
        raise InputError(
            f"Camera {cameras.ids[row]} has model {name}, which COLMAP does not know. Write a groma archive (.npz)."
        )
    return colmap_name, params


def _sensor(pycolmap: Any, sensors: Sensors, row: int) -> Any:
    kind = pycolmap.SensorType.CAMERA if sensors.kind[row] == CAMERA else pycolmap.SensorType.IMU
    return pycolmap.sensor_t(kind, int(sensors.sensor_ids[row]))


def _add_rigs(pycolmap: Any, reconstruction: pycolmap.Reconstruction, scene: Scene) -> None:
    sensors = scene.sensors
    for rig_idx, number in enumerate(scene.rigs.ids.tolist()):
        rig = pycolmap.Rig(rig_id=number)
        rows = np.flatnonzero(sensors.rig_idx == rig_idx)
        for row in rows[np.argsort(-sensors.is_reference[rows], kind="stable")].tolist():
            if sensors.is_reference[row]:
                rig.add_ref_sensor(_sensor(pycolmap, sensors, row))
            else:
                pose = _rigid(pycolmap, sensors.cam_from_rig[row]) if sensors.has_pose[row] else None
                rig.add_sensor(_sensor(pycolmap, sensors, row), pose)
        reconstruction.add_rig(rig)


def _add_images(pycolmap: Any, reconstruction: pycolmap.Reconstruction, scene: Scene, pixels: list[FloatArray]) -> None:
    images = scene.images
    for frame_idx, number in enumerate(scene.frames.ids.tolist()):
        frame = pycolmap.Frame(frame_id=number, rig_id=int(scene.rigs.ids[scene.frames.rig_idx[frame_idx]]))
        frame.rig_from_world = _rigid(pycolmap, scene.frames.rig_from_world[frame_idx])
        for row in np.flatnonzero(images.frame_idx == frame_idx).tolist():
            sensor = _sensor(pycolmap, scene.sensors, int(images.sensor_idx[row]))
            frame.add_data_id(pycolmap.data_t(sensor, int(images.ids[row])))
        reconstruction.add_frame(frame)
    for row, number in enumerate(images.ids.tolist()):
        image = pycolmap.Image(
            name=images.names[row],
            keypoints=pixels[row],
            camera_id=int(scene.cameras.ids[images.camera_idx[row]]),
            image_id=number,
        )
        image.frame_id = int(scene.frames.ids[images.frame_idx[row]])
        reconstruction.add_image(image)
    for number in scene.frames.ids.tolist():
        reconstruction.register_frame(number)


def _numbered(scene: Scene) -> tuple[list[FloatArray], IntArray]:
    """Return the 2D points of every image in the order of their numbers, and the number of each observation."""
    centre = np.zeros((scene.num_cameras, 2))
    for row, name in enumerate(scene.cameras.models):
        if name == "BAL":  # its pixels count from the image centre, COLMAP's from the corner
            centre[row] = scene.cameras.width[row] / 2, scene.cameras.height[row] / 2
    tables = (scene.point_observations, scene.keypoints)
    image_idx = np.concatenate([table.image_idx for table in tables])
    pixel = np.concatenate([table.pixel for table in tables]) + centre[scene.images.camera_idx[image_idx]]
    order, ends, number = numbered_keypoints(scene)
    pixels = [pixel[order[start:end]] for start, end in pairwise(ends.tolist())]
    return pixels, number[: len(scene.point_observations)]


def _add_points(pycolmap: Any, reconstruction: pycolmap.Reconstruction, scene: Scene, keypoint_idx: IntArray) -> None:
    seen, points = scene.point_observations, scene.points
    order = np.lexsort((keypoint_idx, seen.image_idx, seen.point_idx))
    ends = np.searchsorted(seen.point_idx[order], np.arange(len(points) + 1)).tolist()
    image_ids = scene.images.ids[seen.image_idx[order]].tolist()
    elements = list(map(pycolmap.TrackElement, image_ids, keypoint_idx[order].tolist()))
    columns = points.ids.tolist(), points.xyz, points.color, points.error.tolist(), pairwise(ends)
    for number, xyz, color, error, (begin, end) in zip(*columns, strict=True):
        point = pycolmap.Point3D()  # its fields as arguments take five times as long
        point.xyz, point.color, point.error = xyz, color, error
        point.track = pycolmap.Track(elements[begin:end])
        reconstruction.add_point3D_with_id(number, point)
    numbers, owners = keypoint_idx.tolist(), points.ids[seen.point_idx].tolist()
    images = [reconstruction.image(number).set_point3D_for_point2D for number in scene.images.ids.tolist()]
    for image_idx, number, owner in zip(seen.image_idx.tolist(), numbers, owners, strict=True):
        images[image_idx](number, owner)


def _rigid(pycolmap: Any, pose: FloatArray) -> Any:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:4]), pose[4:])
