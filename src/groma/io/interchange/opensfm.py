# SPDX-License-Identifier: BSD-3-Clause
r"""Reconstructions of OpenSfM (and of OpenDroneMap): ``reconstruction.json`` and, beside it, ``tracks.csv``.

The file is a list of reconstructions. A shot has an axis and angle and a translation from the world to the camera,
whose axes are ours. Lengths in images are divided by the larger of width and height and count from the image centre,
so that in our pixels

.. math:: u = \max(w, h)\, x + w/2, \qquad v = \max(w, h)\, y + h/2 .

===================================  ====================================================================
``perspective``                      RADIAL
``simple_radial``, ``radial``        SIMPLE_RADIAL, RADIAL; with two focal lengths OPENCV
``brown``                            OPENCV, with k3 FULL_OPENCV
``fisheye``                          RADIAL_FISHEYE
``fisheye_opencv``                   OPENCV_FISHEYE
``spherical``, ``equirectangular``   EQUIRECTANGULAR
===================================  ====================================================================

The observations are in the tracks: ``image track feature x y ...``, separated by tabs, in the versions 0 to 2. For
``reconstructionNAME.json`` they are in ``tracksNAME.csv``. Without them the scene has points that nothing observes.

Where the images have GPS the world is metric, x to the east, y to the north and z up from ``reference_lla``.

Reference: the documentation of OpenSfM, *Geometric models* and *Reconstruction file format*.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.bounded.documents import member, names_early, number, of_kind, read_document, size, table
from groma.bounded.names import existing
from groma.bounded.text import finite, read_text, shown
from groma.errors import FileFormatError
from groma.io.interchange.calibration import Calibration, camera_table, fisheye, panorama, polynomial
from groma.io.interchange.poses import file_in, points_table
from groma.io.pose_conventions import OPENSFM
from groma.io.reading import reading, warn_of_the_others
from groma.io.registry import SceneFormat, register_format
from groma.scene import PointObservations, Scene

_NAME = "reconstruction.json"
_HEADERS = {f"OPENSFM_TRACKS_VERSION_v{version}" for version in range(3)}
#: Rotation vectors and coordinates beyond these are none.
_LARGEST_TURN, _LARGEST = 1e6, 1e100
#: Radial coefficients of each kind of camera.
_RADIAL = {
    "perspective": ("k1", "k2"),
    "simple_radial": ("k1",),
    "radial": ("k1", "k2"),
    "brown": ("k1", "k2", "k3"),
    "fisheye": ("k1", "k2"),
    "fisheye_opencv": ("k1", "k2", "k3", "k4"),
    "spherical": (),
    "equirectangular": (),
}


@dataclass(frozen=True, eq=False)
class OpenSfmReconstruction:
    """One of the reconstructions of a file."""

    #: Cameras, poses, points and, where there are tracks, observations.
    scene: Scene
    #: Latitude and longitude (degrees) and altitude (metres) of the origin of the world; None where it has none.
    reference_lla: tuple[float, float, float] | None


def read_opensfm(path: str | os.PathLike[str]) -> Scene:
    """Read a ``reconstruction.json``; of several reconstructions the one with most images, with a warning.

    Raises
    ------
    FileFormatError
        If the file is damaged, or a kind of camera is not known.
    """
    scenes = [one.scene for one in read_opensfm_reconstructions(path)]
    warn_of_the_others(path, [scene.num_images for scene in scenes])
    return max(scenes, key=lambda scene: scene.num_images)


def read_opensfm_reconstructions(path: str | os.PathLike[str]) -> tuple[OpenSfmReconstruction, ...]:
    """Read all reconstructions of a ``reconstruction.json``, each with the place of its origin on the Earth.

    Raises
    ------
    FileFormatError
        If the file is damaged, or a kind of camera is not known.
    """
    place = file_in(existing(path), _NAME)
    with reading(place, "OpenSfM file"):
        listed = of_kind(read_document(place), list, place)
        if not listed:
            raise FileFormatError(f"{place} holds no reconstruction. Did OpenSfM place any image?")
        tracks_place = _tracks_place(place)
        tracks = _tracks(tracks_place) if tracks_place is not None else {}
        return tuple(
            _reconstruction(of_kind(one, dict, f"{place}, {row}"), tracks, f"{place}, reconstruction {row}")
            for row, one in enumerate(listed, 1)
        )


def _tracks_place(path: Path) -> Path | None:
    name = path.stem.replace("reconstruction", "tracks", 1) + ".csv"
    candidates = [path.with_name(name), path.with_name("tracks.csv")] if name.startswith("tracks") else []
    return next((place for place in candidates if place.is_file()), None)


def _reconstruction(one: dict[str, Any], tracks: dict[str, _Tracks], place: str) -> OpenSfmReconstruction:
    cameras = {
        name: _calibration(of_kind(value, dict, f"{place}, camera {shown(name)}"), f"{place}, camera {shown(name)}")
        for name, value in member(one, "cameras", dict, place).items()
    }
    camera_row = {name: row for row, name in enumerate(cameras)}
    shots = {
        of_kind(name, str, place): of_kind(shot, dict, place)
        for name, shot in member(one, "shots", dict, place).items()
    }
    taken_by = [
        member(of_kind(shot, dict, place), "camera", str, f"{place}, shot {shown(name)}")
        for name, shot in shots.items()
    ]
    if unknown := [name for name in taken_by if name not in cameras]:
        raise FileFormatError(f"{place}: a shot was taken by {shown(unknown[0])}, which is not among its cameras.")
    turn = table([shot.get("rotation") for shot in shots.values()], (3,), f"{place}, rotation of a shot")
    shift = table([shot.get("translation") for shot in shots.values()], (3,), f"{place}, translation of a shot")
    if np.abs(turn).max(initial=0.0) > _LARGEST_TURN or np.abs(shift).max(initial=0.0) > _LARGEST:
        raise FileFormatError(f"{place}: the pose of a shot is too large. Correct the file.")
    points = of_kind(one.get("points", {}), dict, f"{place}, points")
    values = [of_kind(value, dict, f"{place}, a point") for value in points.values()]
    xyz = table([value.get("coordinates") for value in values], (3,), f"{place}, coordinates of a point")
    color = table([value.get("color", [0, 0, 0]) for value in values], (3,), f"{place}, color of a point")
    ids = list(range(1, len(points) + 1))
    if all(name.isdecimal() and name.isascii() and len(name) < 16 for name in points):
        ids = [int(name) for name in points]
    camera_idx = np.array([camera_row[name] for name in taken_by], np.int64)
    extent = np.array([camera.size for camera in cameras.values()], float).reshape(-1, 2)
    image_idx, point_idx, normalized = _seen(tracks, list(shots), list(points))
    extent = extent[camera_idx[image_idx]]
    pixel = extent.max(axis=1, initial=0.0)[:, None] * normalized + extent / 2
    scene = Scene.from_images(
        camera_table(list(cameras.values()), place),
        list(shots),
        camera_idx,
        OPENSFM.cam_from_world(turn, shift),
        points=points_table(ids, xyz, color, place),
        point_observations=PointObservations.numbered(image_idx, point_idx, pixel),
    )
    return OpenSfmReconstruction(scene, _reference(one, place))


def _reference(one: dict[str, Any], place: str) -> tuple[float, float, float] | None:
    if "reference_lla" not in one:
        return None
    found = member(one, "reference_lla", dict, place)
    where = f"{place}, reference_lla"
    return number(found, "latitude", where), number(found, "longitude", where), number(found, "altitude", where)


def _calibration(camera: dict[str, Any], place: str) -> Calibration:
    kind = member(camera, "projection_type", str, place)
    if kind not in _RADIAL:
        raise FileFormatError(
            f"{place}: the projection type {shown(kind)} is not read; known are {', '.join(_RADIAL)}. Reconstruct with "
            "one of these."
        )
    extent = size(camera, ("width", "height"), place)
    if not _RADIAL[kind]:
        return panorama(extent)
    scale = float(max(extent))
    first = "focal" if "focal" in camera else "focal_x"
    focal_x = scale * number(camera, first, place)
    focal_y = scale * number(camera, "focal_y", place, focal_x / scale)
    center_x = scale * number(camera, "c_x", place, 0.0) + extent[0] / 2
    center_y = scale * number(camera, "c_y", place, 0.0) + extent[1] / 2
    radial = [number(camera, name, place, 0.0) for name in _RADIAL[kind]]
    if kind.startswith("fisheye"):
        return fisheye((focal_x, focal_y), (center_x, center_y), radial, extent)
    tangential = (number(camera, "p1", place, 0.0), number(camera, "p2", place, 0.0)) if kind == "brown" else None
    return polynomial((focal_x, focal_y), (center_x, center_y), radial, tangential, extent)


@dataclass(eq=False)
class _Tracks:
    """The observations of one image: names of tracks, and normalised x and y alternating."""

    names: list[str]
    places: list[float]


def _tracks(path: Path) -> dict[str, _Tracks]:
    """Return the observations of a file of tracks, by image."""
    lines = read_text(path).splitlines()
    start = 1 if lines and lines[0].strip() in _HEADERS else 0
    if not start and lines and lines[0].startswith("OPENSFM_TRACKS"):
        raise FileFormatError(f"{path}: expected a version of tracks from 0 to 2; got {shown(lines[0])}.")
    found: dict[str, _Tracks] = {}
    for row, line in enumerate(lines[start:], start + 1):
        words = line.split("\t")
        if len(words) < 5:
            raise FileFormatError(
                f"{path}, line {row}: expected image, track, feature, x and y, separated by tabs; got {shown(line)}."
            )
        image = found.setdefault(words[0], _Tracks([], []))
        image.names.append(words[1])
        image.places += finite(words[3:5], f"{path}, line {row}", "x and y, finite numbers")
    return found


def _seen(tracks: dict[str, _Tracks], images: list[str], points: list[str]) -> tuple[IntArray, IntArray, FloatArray]:
    """Return image, point and normalised place of the observations of the points that were reconstructed."""
    point_row = {name: row for row, name in enumerate(points)}
    counts = [len(tracks[image].names) if image in tracks else 0 for image in images]
    present = [tracks[image] for image in images if image in tracks]
    point_idx = np.array([point_row.get(name, -1) for one in present for name in one.names], np.int64)
    places = np.array([value for one in present for value in one.places]).reshape(-1, 2)
    image_idx = np.repeat(np.arange(len(images)), counts)
    known = point_idx >= 0
    return image_idx[known], point_idx[known], places[known]


def _recognise(path: Path, head: bytes) -> bool:
    if path.is_dir():
        return (path / _NAME).is_file()
    return names_early(path, head, b"[", "cameras", "shots", "rig_cameras", "reference_lla")


register_format(
    SceneFormat("opensfm", source="an OpenSfM file (reconstruction.json)", recognise=_recognise, read=read_opensfm)
)
