# SPDX-License-Identifier: BSD-3-Clause
r"""Reconstructions of OpenMVG: ``sfm_data.json``.

Views name an image, its intrinsics and its pose; intrinsics have a kind of camera; extrinsics a rotation and a camera
centre, :math:`X_c = R (X - c)`; the structure has points and their observations. Axes are ours. The kinds:

========================  ================================  ============================================
``pinhole``                                                 SIMPLE_PINHOLE
``pinhole_radial_k1``     ``disto_k1``                      SIMPLE_RADIAL
``pinhole_radial_k3``     ``disto_k3``: k1, k2, k3          RADIAL, with k3 FULL_OPENCV
``pinhole_brown_t2``      ``disto_t2``: k1, k2, k3, t1, t2  OPENCV, with k3 FULL_OPENCV
``fisheye``               ``fisheye``: k1 to k4             OPENCV_FISHEYE
``spherical``                                               EQUIRECTANGULAR
========================  ================================  ============================================

Coefficients go from undistorted to distorted, as ours. The centre of the first pixel is (0, 0) there, so half a pixel
is added to observations and principal points; panoramas are measured from the image centre and stay. Views without a
pose are left out, as are priors of views and control points.

The file is written by the library cereal: a kind stands in words where it first occurs, with the highest bit of its
number set, and afterwards by the number.

Reference: P. Moulon, P. Monasse, R. Perrot, R. Marlet, *OpenMVG: open multiple view geometry*, 2016, and its
documentation of the file.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from groma._typing import FloatArray
from groma.bounded.documents import begins_with, member, number, of_kind, read_document, size, table
from groma.bounded.names import existing
from groma.bounded.text import shown
from groma.errors import FileFormatError
from groma.io.interchange.calibration import Calibration, camera_table, fisheye, panorama, polynomial
from groma.io.interchange.poses import file_in, points_table, rigid
from groma.io.pose_conventions import OPENMVG
from groma.io.reading import reading
from groma.io.registry import SceneFormat, register_format
from groma.scene import PointObservations, Scene

_NAME = "sfm_data.json"
#: What cereal adds to the number of a kind where its name is given (file format).
_FIRST_TIME = 1 << 31
#: From the centre of the first pixel at (0, 0) to ours.
_HALF = 0.5
#: Where the coefficients of a kind stand, and how many there are.
_KINDS = {
    "pinhole": ("", 0),
    "pinhole_radial_k1": ("disto_k1", 1),
    "pinhole_radial_k3": ("disto_k3", 3),
    "pinhole_brown_t2": ("disto_t2", 5),
    "fisheye": ("fisheye", 4),
    "spherical": ("", 0),
}


@dataclass(frozen=True)
class _View:
    """An image that has a pose: its number, its name, and the keys of intrinsics and pose."""

    key: int
    name: str
    intrinsics: int
    pose: int


def read_openmvg(path: str | os.PathLike[str]) -> Scene:
    """Read the views that have a pose and intrinsics, and the structure that they see.

    Raises
    ------
    FileFormatError
        If a part is missing, a reference is to nothing, or a kind of camera is not known.
    """
    place = file_in(existing(path), _NAME)
    with reading(place, "OpenMVG file"):
        document = of_kind(read_document(place), dict, place)
        intrinsics = _intrinsics(document, place)
        extrinsics = {key: value for key, value, _ in _entries(document, "extrinsics", place)}
        views = [v for v in _views(document, place) if v.pose in extrinsics and v.intrinsics in intrinsics]
        if not views:
            raise FileFormatError(f"{place} has no view with intrinsics and a pose. Was it saved after reconstruction?")
        rotation = table([extrinsics[view.pose].get("rotation") for view in views], (3, 3), f"{place}, rotation")
        center = table([extrinsics[view.pose].get("center") for view in views], (3,), f"{place}, center")
        poses = rigid(rotation, center, place, OPENMVG)
        if not np.isfinite(poses).all():
            raise FileFormatError(f"{place}: a camera centre is too far away. Correct the file.")
        keys = sorted(intrinsics)
        camera_row = {key: row for row, key in enumerate(keys)}
        camera_idx = np.array([camera_row[view.intrinsics] for view in views])
        ids, xyz, seen = _structure(document, views, place)
        is_flat = np.array([intrinsics[key].model != "EQUIRECTANGULAR" for key in keys])
        image_idx, point_idx = seen[:, :2].astype(np.int64).T
        pixel = seen[:, 2:] + _HALF * is_flat[camera_idx[image_idx]][:, None]
        return Scene.from_images(
            camera_table([intrinsics[key] for key in keys], place),
            [view.name for view in views],
            camera_idx,
            poses,
            points=points_table(ids, xyz, np.zeros((len(ids), 3)), place),
            point_observations=PointObservations.numbered(image_idx, point_idx, pixel),
        )


def _entries(document: dict[str, Any], name: str, path: Path) -> Iterator[tuple[int, dict[str, Any], str]]:
    """Yield the entries of a part: key, value, and the place for messages."""
    for row, entry in enumerate(member(document, name, list, path), 1):
        place = f"{path}, {name}, entry {row}"
        found = of_kind(entry, dict, place)
        yield _key(found, "key", place), member(found, "value", dict, place), place


def _key(holder: dict[str, Any], name: str, place: str) -> int:
    value = number(holder, name, place)
    if not (0 <= value < 2**53 and value == int(value)):
        raise FileFormatError(f"{place}: expected {shown(name)}, a whole number; got {value:g}. Correct the file.")
    return int(value)


def _data(value: dict[str, Any], place: str) -> dict[str, Any]:
    """Return what a pointer of cereal points to."""
    return member(member(value, "ptr_wrapper", dict, place), "data", dict, place)


def _views(document: dict[str, Any], path: Path) -> Iterator[_View]:
    for key, value, place in _entries(document, "views", path):
        data = _data(value, place)
        if "value0" in data and "filename" not in data:  # a view with priors keeps the view inside
            data = member(data, "value0", dict, place)
        folder = of_kind(data.get("local_path", ""), str, place).strip("/\\")
        name = member(data, "filename", str, place)
        name = f"{folder}/{name}".replace("\\", "/") if folder not in ("", ".") else name
        yield _View(key, name, _key(data, "id_intrinsic", place), _key(data, "id_pose", place))


def _intrinsics(document: dict[str, Any], path: Path) -> dict[int, Calibration]:
    names: dict[int, str] = {}
    found = {}
    for key, value, place in _entries(document, "intrinsics", path):
        kind = _key(value, "polymorphic_id", place)
        if kind >= _FIRST_TIME or "polymorphic_name" in value:
            names[kind % _FIRST_TIME] = member(value, "polymorphic_name", str, place)
        name = names.get(kind % _FIRST_TIME, "")
        if name not in _KINDS:
            raise FileFormatError(f"{place}: the camera {shown(name)} is not read; known are {', '.join(_KINDS)}.")
        try:
            found[key] = _calibration(name, _data(value, place), place)
        except FileFormatError as error:
            raise FileFormatError(f"{place}: {error}".replace(f"{place}: {place}", place)) from error
    return found


def _calibration(kind: str, data: dict[str, Any], place: str) -> Calibration:
    if kind == "spherical":
        inner = data.get("value0", data)  # the size stands in what all cameras share
        return panorama(size(of_kind(inner, dict, place), ("width", "height"), place))
    inner = data.get("value0", data) if "focal_length" not in data else data
    inner = of_kind(inner, dict, place)
    extent = size(inner, ("width", "height"), place)
    focal = number(inner, "focal_length", place)
    center = table([member(inner, "principal_point", list, place)], (2,), f"{place}, principal_point")[0] + _HALF
    where, count = _KINDS[kind]
    values = table([member(data, where, list, place)], (count,), f"{place}, {where}")[0].tolist() if where else []
    middle = (float(center[0]), float(center[1]))
    if kind == "fisheye":
        return fisheye((focal, focal), middle, values, extent)
    tangential = (values[3], values[4]) if kind == "pinhole_brown_t2" else None
    return polynomial((focal, focal), middle, values[:3], tangential, extent)


def _structure(document: dict[str, Any], views: list[_View], path: Path) -> tuple[list[int], FloatArray, FloatArray]:
    """Return identifiers and places of the points, and rows of image, point and pixel (N, 4)."""
    image_row = {view.key: row for row, view in enumerate(views)}
    ids, places, seen = [], [], []
    entries = _entries(document, "structure", path) if "structure" in document else ()
    for point, (key, value, place) in enumerate(entries):
        ids.append(key)
        places.append(value.get("X"))
        observations = member(value, "observations", list, place)
        try:
            rows = [(image_row.get(entry["key"], -1), point, *entry["value"]["x"]) for entry in observations]
        except (KeyError, TypeError) as error:
            raise FileFormatError(f"{place}: expected observations with 'key' and 'value', 'x'. Correct it.") from error
        seen += [row for row in rows if row[0] >= 0]
    return ids, table(places, (3,), f"{path}, X of the structure"), table(seen, (4,), f"{path}, an observation")


def _recognise(path: Path, head: bytes) -> bool:
    if path.is_dir():
        return (path / _NAME).is_file()
    return begins_with(head, b"{") and b'"sfm_data_version"' in head


register_format(
    SceneFormat("openmvg", source="an OpenMVG file (sfm_data.json)", recognise=_recognise, read=read_openmvg)
)
