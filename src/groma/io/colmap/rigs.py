# SPDX-License-Identifier: BSD-3-Clause
"""Rigs of photographs, as COLMAP's ``rig_config.json`` describes them: which images were taken at the same moment.

A camera of a rig has a prefix of image names; the rest of a name identifies the frame. The file may hold the pose of
each camera on its rig and its calibration. Where a pose is missing, the images are first mapped without rigs, and the
pose is taken from that model.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from groma import cameras as camera_models
from groma._counted import counted
from groma._typing import FloatArray
from groma.bounded.documents import member, of_kind, read_document, table
from groma.errors import FileFormatError, InputError
from groma.io.colmap.load import opened

#: How COLMAP calls such a file.
RIG_FILE = "rig_config.json"


@dataclass(frozen=True)
class RigCamera:
    """A camera of a rig."""

    #: Prefix of the names of its images.
    prefix: str
    #: Whether its frame is that of the rig.
    is_reference: bool
    #: Its pose on the rig [qx qy qz qw tx ty tz]; None where it is not known. The reference has the identity.
    cam_from_rig: tuple[float, ...] | None = None
    #: Its camera model, by COLMAP's name, and parameters; None where they are not known.
    camera_model: str | None = None
    camera_params: tuple[float, ...] | None = None


@dataclass(frozen=True)
class RigDescription:
    """Cameras that are fixed to each other."""

    cameras: tuple[RigCamera, ...]

    @property
    def is_posed(self) -> bool:
        """Whether the poses of all cameras on the rig are known."""
        return all(camera.cam_from_rig is not None for camera in self.cameras)


def read_rigs(path: str | os.PathLike[str]) -> tuple[RigDescription, ...]:
    """Read a rig file of COLMAP.

    Raises
    ------
    FileFormatError
        If it is no such file, or a rig has no reference camera or several.
    """
    found = of_kind(read_document(path), list, path)
    rigs = tuple(_rig(of_kind(one, dict, place := f"{path}, rig {i + 1}"), place) for i, one in enumerate(found))
    prefixes = [camera.prefix for rig in rigs for camera in rig.cameras]
    for prefix in prefixes:
        other = next((one for one in prefixes if one is not prefix and one.startswith(prefix)), None)
        if other is not None:
            raise FileFormatError(
                f"{path}: images of {other!r} would also be images of {prefix!r}. Write prefixes that tell cameras "
                "apart, such as 'left/' and 'right/'."
            )
    return rigs


def check_rigs(rigs: Sequence[RigDescription], names: Sequence[str]) -> str:
    """Check that every camera of the rigs has images; return a sentence with the number of frames.

    Raises
    ------
    InputError
        If a camera has no images, or no two images were taken at the same moment.
    """
    if not rigs:
        return ""
    for camera in (camera for rig in rigs for camera in rig.cameras):
        if not any(name.startswith(camera.prefix) for name in names):
            raise InputError(
                f"The rig file has a camera with images {camera.prefix}..., and there are none; an image is "
                f"{names[0]!r}. Pass the folder that holds the folders of all cameras, or correct image_prefix."
            )
    frames: dict[tuple[int, str], int] = {}
    for name in names:
        if (found := _moment(rigs, name)) is not None:
            frames[found[:2]] = frames.get(found[:2], 0) + 1
    shared = sum(count > 1 for count in frames.values())
    if not shared:
        raise InputError(
            "No two images belong to the same frame of the rig: their names must be equal after the prefix of the "
            f"camera, and are, for example, {names[0]!r} and {names[-1]!r}. Rename the images or correct the rig file."
        )
    alone = len(names) - sum(frames.values())
    others = f", {counted(alone, 'images')} of no rig" if alone else ""
    incomplete = len(frames) - shared
    some = f", {counted(incomplete, 'frames')} of one image" if incomplete else ""
    return f"{counted(len(rigs), 'rigs')}: {counted(shared, 'frames')} of several images{some}{others}."


def by_frames(rigs: Sequence[RigDescription], names: Sequence[str]) -> list[str]:
    """Return the names sorted by frame, since neighbours in this order are matched."""

    def place(name: str) -> tuple[str, str]:
        found = _moment(rigs, name)
        return (name if found is None else found[1], name)

    return sorted(names, key=place)


def camera_of(rigs: Sequence[RigDescription], name: str) -> RigCamera | None:
    """Return the camera of a rig that took an image; None if none did."""
    found = _moment(rigs, name)
    return None if found is None else found[2]


def map_frames(
    pycolmap: Any, database: Path, rigs: Sequence[RigDescription], attempt: Callable[[Path], list[Any]]
) -> list[Any]:
    """Return the models of a database in which images are held by rigs.

    Parameters
    ----------
    pycolmap : module
        What :func:`groma.io.colmap.load.load_pycolmap` returns.
    database : Path
        Images alone, with matches; it stays as it is.
    rigs : sequence of RigDescription
        Without any, images stand alone.
    attempt : callable
        Makes models of a database.
    """
    if not rigs:
        return attempt(database)
    alone = None
    if not all(rig.is_posed for rig in rigs):
        alone = max(attempt(database), key=lambda model: model.num_reg_images(), default=None)
        if alone is None:
            return []
    with_rigs = database.with_name("rigs.db")
    shutil.copyfile(database, with_rigs)
    with opened(pycolmap, with_rigs) as content:
        pycolmap.apply_rig_config([_configured(pycolmap, rig) for rig in rigs], content, alone)
        poses = [pose for rig in content.read_all_rigs() for pose in rig.non_ref_sensors.values()]
    if any(pose is None for pose in poses):
        raise InputError(
            "Where a camera sits on its rig could not be found from the images. Add cam_from_rig_rotation and "
            "cam_from_rig_translation to the rig file."
        )
    return attempt(with_rigs)


# ----------------------------------------------------------------------------------------------------------- helpers


def _moment(rigs: Sequence[RigDescription], name: str) -> tuple[int, str, RigCamera] | None:
    """Number of the rig, frame and camera of an image."""
    for number, rig in enumerate(rigs):
        for camera in rig.cameras:
            if name.startswith(camera.prefix):
                return number, name[len(camera.prefix) :], camera
    return None


def _rig(content: dict[str, Any], place: str) -> RigDescription:
    listed = member(content, "cameras", list, place)
    cameras = [
        _camera(of_kind(one, dict, inside := f"{place}, camera {i + 1}"), inside) for i, one in enumerate(listed)
    ]
    references = sum(camera.is_reference for camera in cameras)
    if references != 1:
        raise FileFormatError(f"{place}: expected one camera with ref_sensor true; got {references}. Correct the file.")
    return RigDescription(tuple(cameras))


def _camera(content: dict[str, Any], place: str) -> RigCamera:
    prefix = member(content, "image_prefix", str, place)
    reference = content.get("ref_sensor", False)
    pose: tuple[float, ...] | None = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0) if reference else None
    rotation, translation = content.get("cam_from_rig_rotation"), content.get("cam_from_rig_translation")
    if reference and (rotation is not None or translation is not None):
        raise FileFormatError(
            f"{place}: the reference camera has a pose on the rig. Remove it; its frame is the rig's."
        )
    if (rotation is None) != (translation is None):
        raise FileFormatError(f"{place}: expected cam_from_rig_rotation and cam_from_rig_translation, or neither.")
    if rotation is not None:
        quaternion = _numbers(rotation, 4, f"{place}, cam_from_rig_rotation")  # w x y z
        length = float(np.linalg.norm(quaternion))
        if abs(length - 1.0) > 1e-2:  # derived from four numbers of two decimals
            raise FileFormatError(
                f"{place}: expected a unit quaternion w, x, y, z as cam_from_rig_rotation; its length is {length:g}."
            )
        shift = _numbers(translation, 3, f"{place}, cam_from_rig_translation")
        pose = (*(quaternion[[1, 2, 3, 0]] / length).tolist(), *shift.tolist())
    return RigCamera(prefix, bool(reference), pose, *_calibration(content, place))


def _calibration(content: dict[str, Any], place: str) -> tuple[str | None, tuple[float, ...] | None]:
    if "camera_model_name" not in content and "camera_params" not in content:
        return None, None
    name = member(content, "camera_model_name", str, place)
    known = {model.colmap_name: model for model in camera_models.models() if model.colmap_name is not None}
    if name not in known:
        raise FileFormatError(f"{place}: expected a camera model of COLMAP ({', '.join(known)}); got {name!r}.")
    values = _numbers(content.get("camera_params"), known[name].num_parameters, f"{place}, camera_params of {name}")
    return name, tuple(values.tolist())


def _numbers(value: Any, count: int, place: str) -> FloatArray:
    return table([value], (count,), place)[0]


def _configured(pycolmap: Any, rig: RigDescription) -> Any:
    """A rig as pycolmap takes it."""
    cameras = []
    for camera in rig.cameras:
        one = pycolmap.RigConfigCamera()
        one.image_prefix, one.ref_sensor = camera.prefix, camera.is_reference
        if not camera.is_reference and camera.cam_from_rig is not None:
            pose = np.array(camera.cam_from_rig)
            one.cam_from_rig = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:4]), pose[4:])
        cameras.append(one)
    config = pycolmap.RigConfig()
    config.cameras = cameras
    return config
