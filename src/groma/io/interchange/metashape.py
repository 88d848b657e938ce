# SPDX-License-Identifier: BSD-3-Clause
r"""Cameras of Agisoft Metashape: the XML file of *Export Cameras*.

A chunk has sensors with a calibration and cameras with a label and a pose: the 4 x 4 matrix from camera to chunk, row
by row. Its component, in older files the chunk, has the similarity from there to the world. Axes are ours, the centre
of the first pixel is (0.5, 0.5). With :math:`x, y` the point of a ray at depth 1 and :math:`r` its radius, in a
``fisheye`` the angle,

.. math:: x' = x\,(1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + p_1\,(r^2 + 2 x^2) + 2 p_2\, x y, \quad
          u = w / 2 + c_x + x'\,(f + b_1)

and the same for y without :math:`b_1`; p1 and p2 are those of OpenCV exchanged. Frames become RADIAL, OPENCV or
FULL_OPENCV, with b1 alone PINHOLE, fisheyes OPENCV_FISHEYE, spherical cameras EQUIRECTANGULAR.

Where the chunk has a coordinate system of the Earth, the world is geocentric. It is turned and moved to east, north and
up at the middle of the cameras, in metres. Cameras without a pose are left out, as are disabled ones.

Reference: Agisoft LLC, *Metashape User Manual*, appendix *Camera models*.
"""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from groma._typing import FloatArray
from groma.bounded.content import read_content
from groma.bounded.documents import size
from groma.bounded.names import existing
from groma.bounded.text import finite, shown
from groma.errors import FileFormatError
from groma.io.interchange.calibration import Calibration, camera_table, fisheye, panorama, polynomial
from groma.io.interchange.poses import rigid
from groma.io.pose_conventions import METASHAPE
from groma.io.reading import reading, warn_of_the_others
from groma.io.registry import SceneFormat, register_format
from groma.scene import Scene

#: Coefficients of each kind that no model of ours has.
_UNKNOWN = {"frame": ("k4", "b2", "p3", "p4"), "fisheye": ("p1", "p2", "b2", "p3", "p4")}
#: Of the polar to the equatorial axis of WGS84, squared (convention: the ellipsoid).
_FLATTENED = 1.0 - 0.0066943799901413165


def read_metashape(path: str | os.PathLike[str]) -> Scene:
    """Read the cameras that have a pose; of several chunks and components the one with most cameras, with a warning.

    Raises
    ------
    FileFormatError
        If the file is damaged, has no pose, or a lens cannot be represented.
    """
    place = existing(path)
    with reading(place, "Metashape file"):
        groups = [group for chunk in _document(place).iter("chunk") for group in _components(chunk)]
        if not groups:
            raise FileFormatError(f"{place} has no camera with a pose. Align the photos and export them again.")
        chunk, similarity, cameras = max(groups, key=lambda group: len(group[2]))
        local = np.array([_numbers(camera, "transform", 16, place) for camera in cameras]).reshape(-1, 4, 4)
        rotation, scale, shift = similarity
        center = scale * local[:, :3, 3] @ rotation.T + shift
        rotations = rotation @ local[:, :3, :3]
        if (chunk.findtext("reference") or "LOCAL_CS").split("[")[0] != "LOCAL_CS" and np.any(shift):
            level = _east_north_up(center.mean(axis=0))
            center, rotations = (center - center.mean(axis=0)) @ level.T, level @ rotations
        used = sorted({camera.get("sensor_id", "") for camera in cameras})
        sensors = {sensor.get("id", ""): sensor for sensor in chunk.iter("sensor")}
        scene = Scene.from_images(
            camera_table([_calibration(sensors.get(key), key, place) for key in used], place),
            [camera.get("label", "").replace("\\", "/") for camera in cameras],
            np.array([used.index(camera.get("sensor_id", "")) for camera in cameras]),
            rigid(rotations, center, place, METASHAPE),
        )
    warn_of_the_others(path, [len(cameras) for _, _, cameras in groups])
    return scene


def _document(path: Path) -> Element:
    content = read_content(path)
    if b"<!" in content.replace(b"<!--", b"") or b"\0" in content:  # entities that expand without end
        raise FileFormatError(f"{path} declares a document type or entities, which no file of Metashape does.")
    try:
        return ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        raise FileFormatError(f"{path} is not XML: {error}. Fetch or export it again.") from error


_Similarity = tuple[FloatArray, float, FloatArray]


def _components(chunk: Element) -> list[tuple[Element, _Similarity, list[Element]]]:
    """Return the components of a chunk that have cameras: the chunk, the similarity to the world, the cameras."""
    found: dict[str, list[Element]] = {}
    for camera in chunk.iter("camera"):
        if camera.findtext("transform") and camera.get("enabled", "true") not in ("false", "0"):
            found.setdefault(camera.get("component_id", ""), []).append(camera)
    own = {one.get("id", ""): one for one in chunk.iter("component")}
    return [(chunk, _similarity(own.get(key, chunk)), cameras) for key, cameras in found.items()]


def _similarity(holder: Element) -> _Similarity:
    inner = holder.find("transform")
    if inner is None:
        return np.eye(3), 1.0, np.zeros(3)
    rotation = _numbers(inner, "rotation", 9, "transform", np.eye(3).ravel())
    scale = _numbers(inner, "scale", 1, "transform", np.ones(1))[0]
    return rotation.reshape(3, 3), scale, _numbers(inner, "translation", 3, "transform", np.zeros(3))


def _numbers(holder: Element, name: str, count: int, place: object, default: FloatArray | None = None) -> FloatArray:
    text = holder.findtext(name)
    if text is None and default is not None:
        return default
    found = finite((text or "").split(), f"{place}, {name}")
    if len(found) != count:
        raise FileFormatError(f"{place}, {name}: expected {count} numbers; got {len(found)}. Correct the file.")
    return np.array(found)


def _east_north_up(center: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) from geocentric axes to east, north and up at a place on the Earth."""
    up = center * (1.0, 1.0, 1.0 / _FLATTENED)  # the normal of the ellipsoid
    up /= np.linalg.norm(up)
    east = np.array([-up[1], up[0], 0.0]) / np.hypot(up[0], up[1])
    north = np.cross(up, east).astype(np.float64)
    return np.stack([east, north, up])


def _calibration(sensor: Element | None, key: str, place: object) -> Calibration:
    where = f"{place}, sensor {shown(key)}"
    found = sensor.find("calibration") if sensor is not None else None
    if sensor is None or found is None:
        raise FileFormatError(f"{where}: expected a calibration, which is missing. Align the photos and export again.")
    adjusted = sensor.find("calibration[@class='adjusted']")
    found = found if adjusted is None else adjusted
    resolution = found.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    sides = {} if resolution is None else resolution.attrib
    numbers = {name: finite([sides.get(name, "0")], where)[0] for name in ("width", "height")}
    width, height = size(numbers, ("width", "height"), where)
    kind = found.get("type", sensor.get("type", ""))
    if kind == "spherical":
        return panorama((width, height))
    if kind not in _UNKNOWN:
        raise FileFormatError(f"{where}: cameras of the type {shown(kind)} are not read; frame and fisheye are.")

    def value(name: str) -> float:
        return float(_numbers(found, name, 1, where, np.zeros(1))[0])

    if unknown := [name for name in _UNKNOWN[kind] if value(name)]:
        raise FileFormatError(f"{where}: a lens with {', '.join(unknown)} is not read. Optimise the cameras without.")
    focal = (value("f") + value("b1"), value("f"))
    center = (width / 2 + value("cx"), height / 2 + value("cy"))
    if kind == "fisheye":
        return fisheye(focal, center, [value(name) for name in ("k1", "k2", "k3", "k4")], (width, height))
    tangential = (value("p2"), value("p1"))
    radial = [value(name) for name in ("k1", "k2", "k3")]
    return polynomial(focal, center, radial, tangential if any(tangential) else None, (width, height))


def _recognise(path: Path, head: bytes) -> bool:
    return not path.is_dir() and b"<?xml" in head and b"<document" in head and b"<chunk" in head


register_format(
    SceneFormat(
        "metashape", source="a Metashape file (Export Cameras, .xml)", recognise=_recognise, read=read_metashape
    )
)
