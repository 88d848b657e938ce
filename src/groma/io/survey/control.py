# SPDX-License-Identifier: BSD-3-Clause
"""Control points with their marks in the images.

OpenDroneMap, ``gcp_list.txt``: the first line names the coordinate system (:mod:`groma.io.survey.coordinates`), each
other line is one mark, ``x y z u v image`` and mostly a name. Points without a name are identified by their
coordinates. Also read: ``local`` as the system, and ``- - -`` for a point whose place was not measured. Pixel (0, 0) is
the centre of the first pixel there, (0.5, 0.5) here.

OpenSfM, ``ground_control_points.json``: points with ``id``, ``position`` (latitude, longitude, altitude; some have
none), perhaps ``role``, and ``observations``, whose ``projection`` is divided by the larger of width and height and
counts from the image centre.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from groma._counted import first_of
from groma._typing import BoolArray, FloatArray, IntArray
from groma.bounded.documents import begins_with, member, number, of_kind, read_document, table
from groma.bounded.names import existing
from groma.bounded.text import finite, read_lines, shown
from groma.errors import FileFormatError
from groma.io.reading import reading
from groma.io.survey.coordinates import CoordinateSystem, Places
from groma.io.survey.positions import split

_KIND = "file of control points"


@dataclass(frozen=True, eq=False)
class ControlFile:
    """Control points and their marks, as a file holds them."""

    #: The points; of those without a place the coordinates are NaN.
    places: Places
    #: (N,) whether the file wants a point kept back to check the result.
    is_check: BoolArray
    #: (M,) names of images and rows of points of the marks.
    image_names: tuple[str, ...]
    point_idx: IntArray
    #: (M, 2) pixels, or divided by the larger of width and height and from the image centre.
    pixels: FloatArray
    normalized: bool


def read_control(path: str | os.PathLike[str]) -> ControlFile:
    """Read control points and marks; see the module for the layouts.

    Raises
    ------
    FileFormatError
        If the file is damaged, or of another kind.
    """
    place = existing(path)
    with reading(place, _KIND):
        with place.open("rb") as file:
            head = file.read(64)
        found = _read_opensfm(place) if begins_with(head, b"{") else _read_list(place)
    if not found.image_names:
        raise FileFormatError(f"{place} holds no mark of a control point in an image. Expected x y z u v image name.")
    return found


def _read_list(place: Path) -> ControlFile:
    rows: dict[str, int] = {}
    places: list[list[float] | None] = []
    images, points, pixels = [], [], []
    lines = iter(read_lines(place))
    first = next(lines, (0, ""))[1]
    system = CoordinateSystem.parse(first)
    if system is None:
        raise FileFormatError(
            f"{place}, line 1: expected a coordinate system such as EPSG:32611 or WGS84 UTM 11N; got {shown(first)}. "
            "Write it there."
        )
    for line_number, line in lines:
        where, words = f"{place}, line {line_number}", split(line)
        if len(words) < 6:
            words = line.split()
        if len(words) < 6:
            raise FileFormatError(f"{where}: expected x y z u v image and a name; got {shown(line)}.")
        unknown = words[:3] == ["-"] * 3
        numbers = finite(["0"] * 3 + words[3:5] if unknown else words[:5], where, "x y z u v, finite numbers")
        name = words[6] if len(words) > 6 else f"({words[0]}, {words[1]}, {words[2]})"
        row = rows.setdefault(name, len(rows))
        if row == len(places):
            places.append(None if unknown else numbers[:3])
        elif places[row] != (None if unknown else numbers[:3]):
            raise FileFormatError(f"{where}: {shown(name)} has other coordinates before. Correct one of the two.")
        images.append(words[5])
        points.append(row)
        pixels.append([numbers[3] + 0.5, numbers[4] + 0.5])
    coordinates = np.array([[np.nan] * 3 if one is None else one for one in places]).reshape(-1, 3)
    notes = tuple(f"{place.name}: {note}" for note in _doubts_of_heights(tuple(rows), coordinates))
    sigma = np.full(coordinates.shape, np.nan)
    found = Places(tuple(rows), coordinates, sigma, system, str(place), notes)
    marks = tuple(images), np.array(points, np.int64), np.array(pixels).reshape(-1, 2)
    return ControlFile(found, np.zeros(len(rows), bool), *marks, normalized=False)


def _doubts_of_heights(names: tuple[str, ...], coordinates: FloatArray) -> list[str]:
    """Return sentences about heights that are the same everywhere, and about points that differ in height alone."""
    heights = coordinates[np.isfinite(coordinates[:, 2]), 2]
    if len(heights) > 2 and np.ptp(heights) == 0.0:
        return [f"all {len(heights)} control points have the height {heights[0]:g}; it was hardly measured."]
    first: dict[tuple[float, ...], str] = {}
    alike = [(first.setdefault(tuple(place[:2]), name), name) for name, place in zip(names, coordinates, strict=True)]
    pairs = [f"{before} and {name}" for before, name in alike if before != name]
    if not pairs:
        return []
    sentence = f"control points that differ in height alone: {first_of(pairs, 3)}. If they are one, give it one height."
    return [sentence]


def _read_opensfm(place: Path) -> ControlFile:
    listed = member(of_kind(read_document(place), dict, place), "points", list, place)
    names, places, roles, images, points, projections = [], [], [], [], [], []
    for row, entry in enumerate(listed):
        where = f"{place}, point {row + 1}"
        one = of_kind(entry, dict, where)
        name = str(one.get("id", row))
        names.append(of_kind(name, str, where))
        places.append(_position(one, where))
        roles.append(str(one.get("role", "")).lower() in ("check", "check_point", "checkpoint"))
        for seen in member(one, "observations", list, where):
            seen = of_kind(seen, dict, where)
            images.append(member(seen, "shot_id", str, where))
            points.append(row)
            projections.append(seen.get("projection"))
    if len(set(names)) != len(names):
        raise FileFormatError(f"{place}: two control points have the same id. Rename one.")
    coordinates = np.array(places).reshape(-1, 3)
    system = CoordinateSystem("EPSG:4326")
    found = Places(tuple(names), coordinates, np.full(coordinates.shape, np.nan), system, str(place))
    pixels = table(projections, (2,), f"{place}, projection of an observation")
    return ControlFile(found, np.array(roles, bool), tuple(images), np.array(points, np.int64), pixels, normalized=True)


def _position(one: dict[str, Any], where: str) -> list[float]:
    if "position" not in one:
        return [float("nan")] * 3
    given = member(one, "position", dict, where)
    return [number(given, "longitude", where), number(given, "latitude", where), number(given, "altitude", where, 0.0)]
