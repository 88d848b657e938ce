# SPDX-License-Identifier: BSD-3-Clause
"""COLMAP models, binary and text, through pycolmap.

Kept: rigs, sensors, frames, images, 2D points with and without a 3D point, points with colour, error and track. Images
and frames without a pose are left out: COLMAP does not write them to files either.

A COLMAP model has no place for lines, planes, directions and relations. They are written beside it, to the folder
``structures`` in LIMAP 2's layout (:mod:`groma.io.limap.structures`), and put back when the model is read: rows refer
to images and points by identifier, so they survive changes made to the model by other programs.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from groma import cameras as camera_models
from groma._typing import FloatArray
from groma.errors import FileFormatError, InputError, OutputError
from groma.io.atomic import atomic_output
from groma.io.colmap.binary_points import POINT_IN_SPACE, points_in_space, write_points
from groma.io.colmap.files import (
    POINT,
    check_binary_model,
    check_text_rows,
    damage_in_text,
    find_model,
    is_model,
    missing_from_parts,
    models_in_parts,
    points_in_images,
)
from groma.io.colmap.load import load_pycolmap, quiet
from groma.io.colmap.to_pycolmap import colmap_camera, to_pycolmap
from groma.io.limap.structures import Structures, read_beside, write_beside
from groma.io.reading import reading, warn_of_the_others
from groma.io.registry import SceneFormat, register_format
from groma.scene import Cameras, Frames, Images, Keypoints, PointObservations, Points, Rigs, Scene, Sensors
from groma.scene.camera import CAMERA, OTHER
from groma.scene.checks import check_scene_given

if TYPE_CHECKING:
    import pycolmap

_KIND = "COLMAP model"
#: Where the format has no point.
_NO_POINT = 2**64 - 1
_IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


# Reading


def read_colmap(path: str | os.PathLike[str]) -> Scene:
    """Read a COLMAP model, and the structures beside it where there are any.

    Parameters
    ----------
    path : path
        Folder of the model, or a folder with the model in ``sparse``, ``sparse/0`` or ``0``.

    Raises
    ------
    FileFormatError
        If the files are not a consistent model.
    InputError
        If a camera model is not one of groma's.
    """
    folder, form = find_model(path)
    if folder in (parts := models_in_parts(Path(path))):
        warn_of_the_others(path, list(parts.values()), f", in {folder.relative_to(path)}")
        if missing := missing_from_parts(Path(path)):
            warnings.warn(f"{path} holds a further model that is not read, since {missing}.", stacklevel=2)
    pycolmap = load_pycolmap()
    with reading(folder, _KIND), quiet(pycolmap):
        reconstruction, seen, points = pycolmap.Reconstruction(), None, None
        if form == "binary":
            check_binary_model(folder, _num_params_by_number(pycolmap))
            reconstruction.read_binary(str(folder))
            seen, points = points_in_images(folder / "images.bin"), points_in_space(folder / "points3D.bin")
        else:
            _read_text(reconstruction, folder)
        scene = _scene_of(reconstruction, seen, points)
        if form == "text":
            whole = _spaced_names(folder / "images.txt")
            pairs = zip(scene.images.ids.tolist(), scene.images.names, strict=True)
            names = tuple(whole.get(number, name) for number, name in pairs)
            scene = scene.replace(images=scene.images.replace(names=names))
    return read_beside(scene, folder)


def _read_text(reconstruction: pycolmap.Reconstruction, folder: Path) -> None:
    try:
        reconstruction.read_text(str(folder))
    except Exception as error:  # whatever pycolmap raises on damaged files
        if place := damage_in_text(folder):
            raise FileFormatError(f"{folder} is damaged in {place}. Fetch or export it again.") from error
        raise


def _spaced_names(path: Path) -> dict[int, str]:
    """Return the image names with white space in a text file, by image; COLMAP writes them, and reads one word."""
    found = {}
    with path.open(encoding="utf-8", errors="surrogateescape") as file:
        for line in file:
            words = line.split(maxsplit=9)
            if not words or words[0].startswith("#"):
                continue
            next(file, None)  # the observations
            if len(words) == 10 and len(words[9].split()) > 1:
                found[int(words[0])] = words[9].strip()
    return found


def from_pycolmap(reconstruction: pycolmap.Reconstruction) -> Scene:
    """Return the scene that a :class:`pycolmap.Reconstruction` holds; frames without a pose are left out."""
    return _scene_of(reconstruction)


def _scene_of(
    reconstruction: pycolmap.Reconstruction,
    seen: Mapping[int, np.ndarray] | None = None,
    in_space: np.ndarray | None = None,
) -> Scene:
    """Return the scene of a reconstruction whose points may have been read from the files, not by pycolmap.

    ``seen`` are the 2D points of each image by its identifier, and ``in_space`` the 3D points.
    """
    cameras = _cameras(reconstruction)
    camera_row = _rows(cameras.ids)
    rigs = Rigs(np.array(sorted(reconstruction.rigs), np.int64))
    sensors = _sensors(reconstruction, rigs, camera_row)
    rig_row = _rows(rigs.ids)
    sensor_row = {
        (int(rig), int(sensor)): row
        for row, (rig, kind, sensor) in enumerate(zip(sensors.rig_idx, sensors.kind, sensors.sensor_ids, strict=True))
        if kind == CAMERA
    }
    posed = sorted(
        (number, image)
        for number, image in reconstruction.images.items()
        if image.frame is not None
        and image.frame.has_pose()
        and _mounted(sensors, sensor_row, rig_row[image.frame.rig_id], image.camera_id)
    )
    frames_used = sorted({image.frame_id: image.frame for _, image in posed}.items())
    frame_row = _rows([number for number, _ in frames_used])
    frames = Frames(
        ids=np.array([number for number, _ in frames_used], np.int64),
        rig_idx=np.array([rig_row[frame.rig_id] for _, frame in frames_used], np.int64),
        rig_from_world=_poses([frame.rig_from_world for _, frame in frames_used]),
    )
    images = Images(
        ids=np.array([number for number, _ in posed], np.int64),
        names=tuple(image.name for _, image in posed),
        camera_idx=np.array([camera_row[image.camera_id] for _, image in posed], np.int64),
        frame_idx=np.array([frame_row[image.frame_id] for _, image in posed], np.int64),
        sensor_idx=np.array([sensor_row[rig_row[image.frame.rig_id], image.camera_id] for _, image in posed], np.int64),
    )
    points = _points(_in_space(reconstruction) if in_space is None else in_space)
    found = [seen[number] if seen else _seen_in(image) for number, image in posed]
    observations, keypoints = _observations(found, points)
    return Scene(cameras, rigs, sensors, frames, images, points, observations, keypoints)


def _mounted(sensors: Sensors, sensor_row: dict[tuple[int, int], int], rig: int, camera: int) -> bool:
    row = sensor_row.get((rig, camera))
    if row is None:
        raise FileFormatError(f"An image was taken by camera {camera}, which is not on its rig.")
    return bool(sensors.has_pose[row])


def _cameras(reconstruction: pycolmap.Reconstruction) -> Cameras:
    known = {model.colmap_name: model.name for model in camera_models.models() if model.colmap_name}
    found = sorted(reconstruction.cameras.items())
    for number, camera in found:
        if camera.model_name not in known:
            raise InputError(
                f"Camera {number} has model {camera.model_name}, which groma does not have (it has "
                f"{', '.join(known)}). "
                "Undistort the images, or register the model with groma.cameras.register_camera."
            )
    return Cameras.of(
        ids=[number for number, _ in found],
        models=[known[camera.model_name] for _, camera in found],
        params=[camera.params for _, camera in found],
        sizes=[(camera.width, camera.height) for _, camera in found],
    )


def _sensors(reconstruction: pycolmap.Reconstruction, rigs: Rigs, camera_row: dict[int, int]) -> Sensors:
    rows = []
    for rig_idx, number in enumerate(rigs.ids.tolist()):
        rig = reconstruction.rigs[number]
        if rig.num_sensors() == 0:
            continue
        others = sorted(rig.non_ref_sensors.items(), key=lambda item: (int(item[0].type), item[0].id))
        for sensor, pose in [(rig.ref_sensor_id, None), *others]:
            is_camera = sensor.type.name == "CAMERA"
            reference = sensor == rig.ref_sensor_id
            state = _IDENTITY if pose is None else (*pose.rotation.quat, *pose.translation)
            camera = camera_row[sensor.id] if is_camera else -1
            known = reference or pose is not None
            rows.append((rig_idx, CAMERA if is_camera else OTHER, sensor.id, camera, state, reference, known))
    table = list(zip(*rows, strict=True)) or [()] * 7
    return Sensors(
        rig_idx=np.array(table[0], np.int64),
        kind=np.array(table[1], np.int64),
        sensor_ids=np.array(table[2], np.int64),
        camera_idx=np.array(table[3], np.int64),
        cam_from_rig=_unit(np.array(table[4], float).reshape(-1, 7)),
        is_reference=np.array(table[5], np.int64),
        has_pose=np.array(table[6], np.int64),
    )


def _points(found: np.ndarray) -> Points:
    """The table of points from those of a model, by their identifiers."""
    if len(found) and found["id"][-1] > 2**63 - 1:
        raise FileFormatError(f"Point identifier {found['id'][-1]} is too large.")
    return Points(
        found["id"].astype(np.int64), *(np.ascontiguousarray(found[name]) for name in ("xyz", "color", "error"))
    )


def _in_space(reconstruction: pycolmap.Reconstruction) -> np.ndarray:
    """The points of a model, by their identifiers."""
    table = np.zeros(len(reconstruction.points3D), POINT_IN_SPACE)
    for row, (number, point) in enumerate(sorted(reconstruction.points3D.items(), key=itemgetter(0))):
        table[row] = number, point.xyz, point.color, point.error, 0
    return table


def _seen_in(image: Any) -> np.ndarray:
    """The 2D points of an image."""
    found = list(image.points2D)
    seen = np.empty(len(found), POINT)
    seen["xy"] = np.array([point.xy for point in found], float).reshape(-1, 2)
    seen["point"] = np.array([point.point3D_id for point in found], np.uint64)
    return seen


def _observations(images: list[np.ndarray], points: Points) -> tuple[PointObservations, Keypoints]:
    """Return matched and unmatched 2D points, in the order of the images and within them."""
    if not images:
        return PointObservations(), Keypoints()
    image_all = np.repeat(np.arange(len(images)), [len(found) for found in images])
    keypoint_all, everything = np.concatenate([np.arange(len(found)) for found in images]), np.concatenate(images)
    pixel_all, id_all = everything["xy"], everything["point"]
    matched = id_all != _NO_POINT
    wanted = id_all[matched].astype(np.int64)
    point_idx = np.searchsorted(points.ids, wanted)
    dangling = np.append(points.ids, -1)[np.minimum(point_idx, len(points))] != wanted
    if dangling.any():
        raise FileFormatError(f"A 2D point refers to point {wanted[dangling][0]}, which is not in the model.")
    observations = PointObservations(image_all[matched], point_idx, pixel_all[matched], keypoint_all[matched])
    return observations, Keypoints(image_all[~matched], pixel_all[~matched], keypoint_all[~matched])


def _poses(rigid: list[Any]) -> FloatArray:
    poses = np.array([[*pose.rotation.quat, *pose.translation] for pose in rigid], float).reshape(-1, 7)
    return _unit(poses)


def _unit(poses: FloatArray) -> FloatArray:
    """Scale quaternions to length one where they are not; text files round them."""
    length = np.linalg.norm(poses[:, :4], axis=1)
    if not (length > 0.5).all():
        raise FileFormatError(f"Pose {int(length.argmin())} has the quaternion {poses[length.argmin(), :4].tolist()}.")
    off = np.abs(length - 1) > 1e-14
    poses[off, :4] /= length[off, None]
    return poses


def _rows(ids: npt.ArrayLike) -> dict[int, int]:
    return {int(number): row for row, number in enumerate(np.asarray(ids, np.int64).tolist())}


def _num_params_by_number(pycolmap: Any) -> dict[int, int]:
    return {
        int(number): len(pycolmap.Camera.create_from_model_id(1, number, 1.0, 1, 1).params)
        for name, number in pycolmap.CameraModelId.__members__.items()
        if name != "INVALID"
    }


# Writing


def write_colmap(
    scene: Scene,
    path: str | os.PathLike[str],
    form: Literal["binary", "text"] = "binary",
    force: bool = False,
    like: Structures | None = None,
) -> None:
    """Write a scene as a COLMAP model that pycolmap opens; structures go beside it, where LIMAP opens them.

    Parameters
    ----------
    scene : Scene
        What to write. Landmarks seen in no image are written too.
    path : path
        The new folder.
    form : "binary" or "text"
        Form of the files.
    force : bool
        Replace an existing folder.
    like : Structures, optional
        The LIMAP structures that the scene came from (:func:`groma.io.limap.structures.read_limap`), to keep what a
        scene cannot hold: 2D lines without a 3D line, scores, weights, uncertainties, other groups.

    Raises
    ------
    InputError
        If an image name has white space in a text model, or a camera model is unknown to COLMAP. The BAL model is
        written as RADIAL, its centre at half the image size.
    """
    check_scene_given(scene)
    check_colmap(scene, form)
    reconstruction = to_pycolmap(scene, points=form == "text")
    with atomic_output(path, force) as draft:
        draft.mkdir()
        if form == "binary":
            reconstruction.write_binary(str(draft))
            write_points(scene, draft)
        else:
            reconstruction.write_text(str(draft))
        _check_written(draft, form, reconstruction, path)
        write_beside(scene, draft, form, like)


def _check_written(
    draft: Path, form: Literal["binary", "text"], reconstruction: pycolmap.Reconstruction, path: str | os.PathLike[str]
) -> None:
    """Raise OutputError if a file is incomplete: pycolmap does not notice when a disk is full."""
    try:
        if form == "binary":
            check_binary_model(draft, _num_params_by_number(load_pycolmap()))
        else:
            check_text_rows(draft, {
                "cameras.txt": reconstruction.num_cameras(),
                "images.txt": 2 * reconstruction.num_reg_images(),
                "points3D.txt": reconstruction.num_points3D(),
            })  # fmt: skip
    except FileFormatError as error:
        raise OutputError(f"Cannot write {path}: a file of the model came out incomplete. Is the disk full?") from error


def check_colmap(scene: Scene, form: Literal["binary", "text"] = "binary") -> None:
    """Ask whether a COLMAP model can hold a scene.

    Raises
    ------
    InputError
        If an image name has white space in a text model, or a camera model is unknown to COLMAP.
    """
    if form not in ("binary", "text"):
        raise InputError(f"form must be 'binary' or 'text'; got {form!r}.")
    spaced = [name for name in scene.images.names if name.split() != [name]]
    if form == "text" and spaced:
        raise InputError(
            f"A COLMAP text model cannot hold the image name {spaced[0]!r}: it is cut at white space. Use binary."
        )
    for row in range(scene.num_cameras):
        colmap_camera(scene.cameras, row)


register_format(
    SceneFormat(
        "colmap",
        source="the folder of a COLMAP model",
        target="a folder name for COLMAP",
        endings=("",),
        recognise=lambda place, head: is_model(place),
        read=lambda place: read_colmap(place if place.is_dir() else place.parent),
        write=lambda scene, path, force, like: write_colmap(scene, path, "binary", force, like),
        check=check_colmap,
        keeps_structures=True,
    )
)
register_format(
    SceneFormat(
        "colmap_text",
        write=lambda scene, path, force, like: write_colmap(scene, path, "text", force, like),
        check=lambda scene: check_colmap(scene, "text"),
        keeps_structures=True,
    )
)

__all__ = ["check_colmap", "find_model", "from_pycolmap", "read_colmap", "to_pycolmap", "write_colmap"]
