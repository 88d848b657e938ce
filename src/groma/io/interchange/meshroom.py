# SPDX-License-Identifier: BSD-3-Clause
r"""Scenes of Meshroom (AliceVision): ``cameras.sfm``, ``sfm.json``, the text of its SfMData.

Views name an image, its intrinsics and its pose; a pose has the rotation from camera to world, row by row, and the
camera centre; the structure, where it was exported, has points and their observations. Axes are ours, numbers texts.

===================================  ==========================================
``type``, or ``distortionType``      becomes
===================================  ==========================================
``pinhole`` or ``none``              SIMPLE_PINHOLE
``radial1``, ``radialk1``            SIMPLE_RADIAL
``radial3``, ``radialk3``            RADIAL, with k3 FULL_OPENCV
``brown``: k1, k2, k3, t1, t2        OPENCV, with k3 FULL_OPENCV
``fisheye4``, ``fisheye``: k1 to k4  OPENCV_FISHEYE
===================================  ==========================================

The focal length is in pixels, since version 1.2.2 in millimetres of a sensor of given width. The principal point is a
pixel, since version 1.2.1 an offset from the image centre. The centre of the first pixel is (0, 0), so half a pixel is
added.

Reference: the documentation of AliceVision, *SfMData*, and files of versions 1.0.0 and 1.2.6.
"""

from __future__ import annotations

import os
import posixpath
from pathlib import Path
from typing import Any

import numpy as np

from groma._typing import FloatArray
from groma.bounded.documents import member, names_early, of_kind, read_document, size, table
from groma.bounded.names import existing
from groma.bounded.text import finite, shown
from groma.errors import FileFormatError
from groma.io.interchange.calibration import Calibration, camera_table, fisheye, polynomial
from groma.io.interchange.poses import points_table, rigid
from groma.io.pose_conventions import MESHROOM
from groma.io.reading import reading
from groma.io.registry import SceneFormat, register_format
from groma.scene import PointObservations, Scene

#: From the centre of the first pixel at (0, 0) to ours.
_HALF = 0.5
#: How many coefficients a lens has.
_KINDS = {
    "pinhole": 0, "none": 0, "radial1": 1, "radialk1": 1, "radial3": 3, "radialk3": 3, "brown": 5,
    "fisheye": 4, "fisheye4": 4,
}  # fmt: skip


def read_meshroom(path: str | os.PathLike[str]) -> Scene:
    """Read the views that have a pose and intrinsics, and the structure that they see, if the file has it.

    Names are relative to the folder that all images share.

    Raises
    ------
    FileFormatError
        If a part is missing, a camera or a rig cannot be read, or no view has a pose.
    """
    place = existing(path)
    with reading(place, "Meshroom file"):
        document = of_kind(read_document(place), dict, place)
        if document.get("rigs"):
            raise FileFormatError(f"{place} has rigs, which are not read. Export its poses without rigs.")
        version = tuple(int(value) for value in _numbers(document, "version", 3, place))
        lenses = {_key(one, "intrinsicId", place): one for one in _entries(document, "intrinsics", place)}
        poses = {_key(one, "poseId", place): one for one in _entries(document, "poses", place)}
        views = [
            view
            for view in _entries(document, "views", place)
            if str(view.get("poseId")) in poses and str(view.get("intrinsicId")) in lenses
        ]
        if not views:
            raise FileFormatError(
                f"{place} has no view with intrinsics and a pose. Take cameras.sfm of the node StructureFromMotion."
            )
        posed = [_transform(poses[str(view["poseId"])], place) for view in views]
        used = [str(view["intrinsicId"]) for view in views]
        camera_row = {key: row for row, key in enumerate(sorted(set(used)))}
        ids, xyz, color, seen = _structure(document, views, place)
        return Scene.from_images(
            camera_table([_calibration(lenses[key], version, place) for key in camera_row], place),
            _names([member(view, "path", str, place) for view in views]),
            np.array([camera_row[key] for key in used]),
            rigid(
                np.array([rotation for rotation, _ in posed]).reshape(-1, 3, 3),
                np.array([center for _, center in posed]),
                place,
                MESHROOM,
            ),
            points=points_table(ids, xyz, color, place),
            point_observations=PointObservations.numbered(
                seen[:, 0].astype(np.int64), seen[:, 1].astype(np.int64), seen[:, 2:] + _HALF
            ),
        )


def _entries(document: dict[str, Any], name: str, place: object) -> list[dict[str, Any]]:
    """Return the entries of a part; an empty one, or none, is an empty text."""
    return [of_kind(one, dict, f"{place}, {name}") for one in document.get(name) or []]


def _key(holder: dict[str, Any], name: str, place: object) -> str:
    if name not in holder:
        raise FileFormatError(f"{place}: expected {shown(name)}, which is missing. Is the file complete?")
    return str(holder[name])


def _numbers(holder: dict[str, Any], name: str, count: int, place: object) -> list[float]:
    """Return as many numbers, which stand as texts or not, one of them alone or all in a list."""
    value = holder.get(name)
    found = finite([str(one) for one in (value if isinstance(value, list) else [value])], f"{place}, {shown(name)}")
    if len(found) != count:
        raise FileFormatError(f"{place}, {shown(name)}: expected {count} numbers; got {len(found)}. Correct the file.")
    return found


def _transform(pose: dict[str, Any], place: object) -> tuple[list[float], list[float]]:
    inner = member(member(pose, "pose", dict, place), "transform", dict, place)
    return _numbers(inner, "rotation", 9, place), _numbers(inner, "center", 3, place)


def _names(paths: list[str]) -> list[str]:
    """Return paths relative to the folder that all share."""
    bare = [path.replace("\\", "/") for path in paths]
    shared = posixpath.commonpath([posixpath.dirname(path) for path in bare])
    return [posixpath.relpath(path, shared) for path in bare]


def _calibration(lens: dict[str, Any], version: tuple[int, ...], place: object) -> Calibration:
    where = f"{place}, intrinsics {_key(lens, 'intrinsicId', place)}"
    kind = member(lens, "type", str, where)
    kind = member(lens, "distortionType", str, where) if kind == "pinhole" and "distortionType" in lens else kind
    if kind not in _KINDS:
        raise FileFormatError(f"{where}: the camera {shown(kind)} is not read; known are {', '.join(_KINDS)}.")
    sides = {name: _numbers(lens, name, 1, where)[0] for name in ("width", "height")}
    width, height = size(sides, ("width", "height"), where)
    if "pxFocalLength" in lens:
        focal = _numbers(lens, "pxFocalLength", 1 if version < (1, 2, 0) else 2, where)
    else:
        focal = [width * _numbers(lens, "focalLength", 1, where)[0] / _numbers(lens, "sensorWidth", 1, where)[0]]
        if _numbers({"pixelRatio": 1, **lens}, "pixelRatio", 1, where) != [1.0]:
            raise FileFormatError(f"{where}: pixels that are not square are not read. Reconstruct with pixelRatio 1.")
    center = np.array(_numbers(lens, "principalPoint", 2, where)) + _HALF
    if version >= (1, 2, 1):
        center += (width / 2, height / 2)
    middle = (float(center[0]), float(center[1]))
    both = (focal[0], focal[-1])
    values = _numbers(lens, "distortionParams", _KINDS[kind], where) if _KINDS[kind] else []
    if kind.startswith("fisheye"):
        return fisheye(both, middle, values, (width, height))
    return polynomial(both, middle, values[:3], (values[3], values[4]) if kind == "brown" else None, (width, height))


def _structure(
    document: dict[str, Any], views: list[dict[str, Any]], place: object
) -> tuple[list[int], FloatArray, FloatArray, FloatArray]:
    """Return identifiers, places and colours of the points, and rows of image, point and pixel (N, 4)."""
    image_row = {_key(view, "viewId", place): row for row, view in enumerate(views)}
    entries = _entries(document, "structure", place)
    seen = [
        (image_row[str(one.get("observationId"))], point, *_numbers(one, "x", 2, f"{place}, an observation"))
        for point, entry in enumerate(entries)
        for one in _entries(entry, "observations", place)
        if str(one.get("observationId")) in image_row
    ]
    xyz = [_numbers(entry, "X", 3, f"{place}, structure") for entry in entries]
    color = [_numbers({"color": [0, 0, 0], **entry}, "color", 3, f"{place}, structure") for entry in entries]
    ids = list(range(1, len(entries) + 1))
    return ids, table(xyz, (3,), place), table(color, (3,), place), table(seen, (4,), place)


def _recognise(path: Path, head: bytes) -> bool:
    if path.is_dir() or b'"sfm_data_version"' in head:
        return False
    return names_early(path, head, b"{", "intrinsicId")


register_format(
    SceneFormat("meshroom", source="a Meshroom file (cameras.sfm)", recognise=_recognise, read=read_meshroom)
)
