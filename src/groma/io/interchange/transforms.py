# SPDX-License-Identifier: BSD-3-Clause
r"""Cameras and poses of nerfstudio, instant-ngp and NeRF's Blender scenes: ``transforms.json``, read and written.

A frame has a matrix from the camera to the world, :math:`M`. Its camera looks along the negative z axis with y up. With
:math:`D = \mathrm{diag}(1, -1, -1)`

.. math:: T_{wc} = M\, \mathrm{diag}(D, 1).

Intrinsics (``fl_x fl_y cx cy w h k1 k2 k3 k4 p1 p2``, or ``camera_angle_x``) stand at the top of the file, or with a
frame, which then counts. Pixels are ours: the centre of the first one is (0.5, 0.5). Coefficients go from undistorted
to distorted, in OpenCV's order. Where there is no size it is read from the photograph.

============================================  ==================================================================
``camera_model``                              ours
============================================  ==================================================================
none                                          SIMPLE_PINHOLE or PINHOLE; with distortion OPENCV; ``is_fisheye``:
                                              OPENCV_FISHEYE
``SIMPLE_PINHOLE``, ``PINHOLE``               the same
``SIMPLE_RADIAL``, ``RADIAL``, ``OPENCV``     the same; with two focal lengths or p1, p2 OPENCV, with k3 FULL_OPENCV
``OPENCV_FISHEYE``                            the same
``EQUIRECTANGULAR``                           the same
============================================  ==================================================================

The world of the scene is that of the file, which ``applied_transform`` made of the one of the program before:
:class:`Transforms` has it, and all else that a scene has no place for. Points come from ``ply_file_path``, where
the file is there; nothing observes them. Depths, masks and times of frames are not read.

Reference: the documentation of nerfstudio, *Data conventions*, and of instant-ngp, *NeRF dataset tips*.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from groma import cameras as camera_models
from groma.bounded.documents import member, names_early, number, of_kind, read_document, size, table
from groma.bounded.names import IMAGES, existing, listed_file
from groma.bounded.text import shown
from groma.errors import FileFormatError, InputError
from groma.geometry import quaternion
from groma.io.atomic import atomic_output
from groma.io.interchange.calibration import Calibration, camera_table, fisheye, panorama, polynomial, shared
from groma.io.interchange.poses import file_in, points_table, rigid, size_of_image
from groma.io.ply import write_ply
from groma.io.ply_tables import read_ply_points
from groma.io.pose_conventions import FLIP, TRANSFORMS
from groma.io.reading import reading
from groma.io.registry import SceneFormat, register_format
from groma.scene import Cameras, Points, Scene
from groma.scene.checks import check_scene_given

_NAME = "transforms.json"
#: A camera, as given in a frame or at the top of a file.
INTRINSICS = (
    "camera_model", "is_fisheye", "camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h",
    "k1", "k2", "k3", "k4", "p1", "p2",
)  # fmt: skip
#: How many radial coefficients a camera model has, and whether it has tangential ones.
_POLYNOMIALS = {
    "SIMPLE_PINHOLE": (0, False),
    "PINHOLE": (0, False),
    "SIMPLE_RADIAL": (1, False),
    "RADIAL": (2, False),
    "OPENCV": (4, True),
}
#: Models that are written, and under which names.
_WRITTEN = {
    **{name: name for name in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")},
    "BAL": "RADIAL",
    "FULL_OPENCV": "OPENCV",
    **dict.fromkeys(
        ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"), "OPENCV_FISHEYE"
    ),
}


@dataclass(frozen=True, eq=False)
class Transforms:
    """A scene, and the other entries of its file."""

    #: Cameras, poses and points.
    scene: Scene
    #: Further entries at the top of the file, such as ``applied_transform`` and ``aabb_scale``.
    others: dict[str, Any] = field(default_factory=dict)


def read_transforms(path: str | os.PathLike[str]) -> Transforms:
    """Read a ``transforms.json``.

    Raises
    ------
    FileFormatError
        If it is damaged, a matrix is no pose, or a camera is not determined or not known.
    """
    place = file_in(existing(path), _NAME)
    with reading(place, "transforms file"):
        document = of_kind(read_document(place), dict, place)
        frames = [
            of_kind(frame, dict, f"{place}, frame {row}")
            for row, frame in enumerate(member(document, "frames", list, place), 1)
        ]
        names = [_name(frame, f"{place}, frame {row}") for row, frame in enumerate(frames, 1)]
        calibrations, camera_idx = shared(_calibrations(document, frames, names, place))
        matrices = table([frame.get("transform_matrix") for frame in frames], (4, 4), f"{place}, transform_matrix")
        if len(matrices) and np.abs(matrices[:, 3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
            turned = np.abs(matrices[:, :, 3] - [0.0, 0.0, 0.0, 1.0]).max() <= 1e-6
            remedy = "Transpose them." if turned else "Divide each by its last number, or leave out what scaled it."
            raise FileFormatError(f"{place}: expected matrices whose last row is 0 0 0 1. {remedy}")
        scene = Scene.from_images(
            camera_table(calibrations, place),
            names,
            np.array(camera_idx, np.int64),
            rigid(matrices[:, :3, :3], matrices[:, :3, 3], place, TRANSFORMS),
            points=_points(document, place),
        )
    known = {"frames", "ply_file_path", *INTRINSICS}
    return Transforms(scene, {name: value for name, value in document.items() if name not in known})


def _name(frame: dict[str, Any], place: str) -> str:
    """Return the path of an image as the file has it, without ``./``; Blender scenes leave ``.png`` out."""
    name = member(frame, "file_path", str, place).replace("\\", "/")
    name = name.removeprefix("./")
    if not name:
        raise FileFormatError(f"{place}: expected the name of an image in 'file_path'; got an empty one.")
    return name if name.lower().endswith(IMAGES) or "." in name.rsplit("/", 1)[-1] else f"{name}.png"


def _calibrations(
    document: dict[str, Any], frames: list[dict[str, Any]], names: list[str], path: Path
) -> list[Calibration]:
    """Return the camera of each frame: entries of the frame override those at the top of the document."""
    top = {name: document[name] for name in INTRINSICS if name in document}
    has_sizes = {"w", "h"} <= top.keys() or all({"w", "h"} <= frame.keys() for frame in frames)
    sizes = (size_of_image(path.parent, name) for name in ([] if has_sizes else names))
    common = next((one for one in sizes if one != (0, 0)), (0, 0))
    found = []
    for row, (frame, name) in enumerate(zip(frames, names, strict=True), 1):
        own = {key: frame[key] for key in INTRINSICS if key in frame}
        said = {**top, **own}
        if not {"w", "h"} <= said.keys():
            said["w"], said["h"] = size_of_image(path.parent, name) if own else common
        found.append(_calibration(said, f"{path}, frame {row}"))
    return found


def _calibration(said: dict[str, Any], place: str) -> Calibration:
    """Return the camera that intrinsics describe."""
    if said.get("w") == 0:
        raise FileFormatError(
            f"{place}: expected the size of the images, 'w' and 'h', and found neither these nor the photograph. Put "
            "the file beside the images, or add them."
        )
    extent = size(said, ("w", "h"), place)
    fallback = "OPENCV_FISHEYE" if said.get("is_fisheye") is True else ""
    model = of_kind(said.get("camera_model", fallback), str, place)
    if model == "EQUIRECTANGULAR":
        return panorama(extent)
    focal_x = _focal(said, "x", extent[0], None, place)
    focal = (focal_x, _focal(said, "y", extent[1], focal_x, place))
    center = (number(said, "cx", place, extent[0] / 2), number(said, "cy", place, extent[1] / 2))
    radial = [number(said, f"k{order}", place, 0.0) for order in range(1, 5)]
    tangential = (number(said, "p1", place, 0.0), number(said, "p2", place, 0.0))
    if model == "OPENCV_FISHEYE":
        return fisheye(focal, center, radial, extent)
    if model == "":
        model = "OPENCV" if any(radial) or any(tangential) else "PINHOLE"
        if model == "PINHOLE":
            return polynomial(focal, center, [], None, extent)
    if model not in _POLYNOMIALS:
        known = ", ".join([*_POLYNOMIALS, "OPENCV_FISHEYE", "EQUIRECTANGULAR"])
        raise FileFormatError(f"{place}: the camera model {shown(model)} is not read; known are {known}.")
    count, has_tangential = _POLYNOMIALS[model]
    if any(radial[count:]) or (any(tangential) and not has_tangential):
        count, has_tangential = 4, True  # coefficients that are there are meant
    if model == "PINHOLE" and not count:
        return Calibration("PINHOLE", (*focal, *center), extent)
    return polynomial(focal, center, radial[:count], tangential if has_tangential else None, extent)


def _focal(said: dict[str, Any], axis: str, length: int, default: float | None, place: str) -> float:
    if f"fl_{axis}" in said:
        return number(said, f"fl_{axis}", place)
    if f"camera_angle_{axis}" in said:
        angle = number(said, f"camera_angle_{axis}", place)
        if not 0.0 < angle < math.pi:
            raise FileFormatError(f"{place}: expected 'camera_angle_{axis}' between 0 and pi radians; got {angle:g}.")
        return 0.5 * length / math.tan(0.5 * angle)
    if default is None:
        raise FileFormatError(f"{place}: expected a focal length, 'fl_x' or 'camera_angle_x', and found neither.")
    return default


def _points(document: dict[str, Any], path: Path) -> Points:
    """Return the points of the PLY file that the document names; none where it is not there."""
    name = document.get("ply_file_path")
    if name is None:
        return Points()
    place = listed_file(path.parent, of_kind(name, str, path), f"{path}, 'ply_file_path'")
    if not place.is_file() or place.suffix.lower() != ".ply":
        return Points()
    xyz, color = read_ply_points(place)
    return points_table(np.arange(len(xyz)) + 1, xyz, color, place)


# Writing


def write_transforms(
    scene: Scene, path: str | os.PathLike[str], force: bool = False, others: Mapping[str, Any] | None = None
) -> None:
    """Write cameras and poses as a ``transforms.json``, and the points as ``NAME.points.ply`` beside it.

    Parameters
    ----------
    scene : Scene
        What to write. Observations, lines and planes have no place in the file.
    path : path
        The file. The names of the images are taken as paths from its folder.
    force : bool
        Replace existing files.
    others : mapping, optional
        Further entries at the top, such as :attr:`Transforms.others`.

    Raises
    ------
    InputError
        If a camera has no size, or a model that transforms files do not support.
    """
    check_scene_given(scene)
    place = Path(path)
    cameras = [_entries(scene.cameras, row) for row in range(scene.num_cameras)]
    poses = scene.cam_from_world
    inverse = quaternion.conjugate(poses[:, :4])
    matrices = np.tile(np.eye(4), (scene.num_images, 1, 1))
    matrices[:, :3, :3] = quaternion.to_matrix(inverse) * FLIP
    matrices[:, :3, 3] = -quaternion.rotate(inverse, poses[:, 4:])
    used = np.unique(scene.images.camera_idx)
    one = len(used) == 1
    frames = [
        {"file_path": name, **({} if one else cameras[camera]), "transform_matrix": matrix}
        for name, camera, matrix in zip(
            scene.images.names, scene.images.camera_idx.tolist(), matrices.tolist(), strict=True
        )
    ]
    document = {**(cameras[used[0]] if one else {}), **(others or {}), "frames": frames}
    if scene.num_points:
        document["ply_file_path"] = f"{place.stem}.points.ply"
    with atomic_output(place, force) as draft:
        draft.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        if scene.num_points:  # within: neither is there without the other
            write_ply(scene, place.with_name(document["ply_file_path"]), force, parts=("points",))


def check_transforms(scene: Scene) -> None:
    """Raise InputError if a camera has no size, or a model that transforms files do not support."""
    for row in np.unique(scene.images.camera_idx).tolist():
        _entries(scene.cameras, row)


def _entries(cameras: Cameras, row: int) -> dict[str, Any]:
    """Return the entries of a camera."""
    model, size = cameras.models[row], (int(cameras.width[row]), int(cameras.height[row]))
    if min(size) <= 0:
        raise InputError(
            f"A transforms file holds the size of the images; that of camera {cameras.ids[row]} is not known. Read the "
            "scene from a file that has it, or with the photographs beside it."
        )
    values = dict(zip(camera_models.model(model).parameter_names, cameras.params_of(row).tolist(), strict=True))
    words = {"w": size[0], "h": size[1]}
    if model == "EQUIRECTANGULAR":
        return {"camera_model": model, **words}
    written = _WRITTEN.get(model)
    if written is None or any(values.get(name) for name in ("k4", "k5", "k6") if model == "FULL_OPENCV"):
        raise InputError(
            f"A transforms file holds cameras of the models {', '.join(_WRITTEN)} and EQUIRECTANGULAR (FULL_OPENCV "
            f"without k4, k5, k6); camera {cameras.ids[row]} has the model {model}. Write a COLMAP model, or undistort "
            "the images."
        )
    focal_x, focal_y = (values.get(name, values.get("f")) for name in ("fx", "fy"))
    center = {"cx": values.get("cx", size[0] / 2), "cy": values.get("cy", size[1] / 2)}
    distortion = {"k1" if name == "k" else name: value for name, value in values.items() if name[0] in "kp"}
    if model == "FULL_OPENCV":
        distortion = {name: value for name, value in distortion.items() if name not in ("k4", "k5", "k6")}
    return {"camera_model": written, "fl_x": focal_x, "fl_y": focal_y, **center, **words, **distortion}


def _recognise(path: Path, head: bytes) -> bool:
    if path.is_dir():
        return (path / _NAME).is_file()
    return names_early(path, head, b"{", "transform_matrix", "camera_angle_x", "fl_x")


register_format(
    SceneFormat(
        "transforms",
        source="a transforms.json of nerfstudio or instant-ngp",
        target=".json for nerfstudio and instant-ngp",
        endings=(".json",),
        recognise=_recognise,
        read=lambda path: read_transforms(path).scene,
        write=write_transforms,
        check=check_transforms,
    )
)
