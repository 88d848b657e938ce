# SPDX-License-Identifier: BSD-3-Clause
"""Positions of cameras from a text file: one image a line, separated by commas, semicolons or white space.

===================  ================================================================================================
no header            ``name x y z``, and one or three standard deviations
header               the columns by name: ``name`` (``image``, ``filename``, ``label``); ``x y z`` (``easting``,
                     ``northing``, ``height``), or ``longitude latitude altitude``; ``sigma`` (``accuracy``),
                     or ``sx sy sz``, or ``horizontal vertical``; others are not read. Metashape, RealityCapture
                     and others write it as the last comment before the first image, the system in one above
first line a system  ``EPSG:32611``, ``WGS84 UTM 11N`` or ``+proj=...``: what follows is in that system. This is
                     ``geo.txt`` of OpenDroneMap: ``name x y z omega phi kappa horizontal vertical``; all after z
                     may be missing
===================  ================================================================================================

Of longitude and latitude, x is the longitude. Numbers of an unnamed system that look like these are refused.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from groma._counted import counted
from groma.bounded.names import existing
from groma.bounded.text import finite, read_lines, read_text, shown
from groma.errors import FileFormatError
from groma.io.reading import reading
from groma.io.survey.coordinates import CoordinateSystem, Places

_KIND = "file of positions"
#: How much smaller than their distance from the origin places are apart that look like degrees (convention: a tenth).
FAR = 0.1
#: Names of columns: the letters of what is left by :data:`_UNITS` and :data:`_QUALIFIERS`.
_COLUMNS = {
    "name": ("name", "image", "imagename", "filename", "file", "label", "photo"),
    "x": ("x", "easting", "east", "e", "geox"),
    "y": ("y", "northing", "north", "n", "geoy"),
    "z": ("z", "height", "altitude", "alt", "elevation", "elev", "up", "h", "geoz"),
    "longitude": ("longitude", "lon", "long", "lng"),
    "latitude": ("latitude", "lat"),
    "east": ("longituderef",),
    "north": ("latituderef",),
    "sigma": ("sigma", "accuracy", "std", "stddev", "sd"),
    "sx": ("sx", "sigmax", "stdx", "se", "xaccuracy", "accuracyx", "accuracyeasting", "sdx"),
    "sy": ("sy", "sigmay", "stdy", "sn", "yaccuracy", "accuracyy", "accuracynorthing", "sdy"),
    "sz": ("sz", "sigmaz", "stdz", "su", "zaccuracy", "accuracyz", "sdz"),
    "horizontal": (
        "horizontal",
        "horizontalaccuracy",
        "accuracyhorizontal",
        "horzaccuracy",
        "accuracyhorz",
        "sh",
        "hacc",
    ),
    "vertical": ("vertical", "verticalaccuracy", "accuracyvertical", "vertaccuracy", "accuracyvert", "sv", "vacc"),
}
#: What names of columns add: another name after a stroke, brackets and units; and qualifiers, as of GPSLatitude and
#: altitude_amsl. Heights above sea level and the ellipsoid differ by a constant at one place.
_UNITS = re.compile(r"[(\[/].*|[_ ](m|meters?|metres?|deg|degrees|dd)$")
_QUALIFIERS = re.compile(r"^(gps|utm|source|ellipsoidal)(?=.)|(?<=.)(amsl|msl|wgs|ellipsoidal)$")
#: Two numbers of which each has a comma, apart by something else.
_DECIMAL_COMMAS = re.compile(r"\d,\d+\s*[;\s]\s*-?\d+,\d")
#: A code of a coordinate system in a comment; of those in well-known text the last is that of the whole.
_CODE = re.compile(r"EPSG(?:::?\s?|\",\s?\")(\d{3,6})")
_MEANING = {word: meaning for meaning, words in _COLUMNS.items() for word in words}


def read_positions(path: str | os.PathLike[str]) -> Places:
    """Read positions of cameras; see the module for the layouts.

    Raises
    ------
    FileFormatError
        If the file is damaged, or its columns cannot be identified.
    """
    place = existing(path)
    with reading(place, _KIND):
        rows = [(number, split(line)) for number, line in read_lines(place)]
        if not rows:
            raise FileFormatError(f"{place} holds no position. Expected lines of name, x, y and z.")
        system = CoordinateSystem.parse(next(line for _, line in read_lines(place)))
        if system is not None:
            return _places(place, rows[1:], ["name", "x", "y", "z"], system, _after_z)
        above = read_text(place).splitlines()[: rows[0][0] - 1]
        codes = [] if any("LOCAL_CS[" in line for line in above) else _CODE.findall(" ".join(above))
        system = CoordinateSystem(f"EPSG:{codes[-1]}" if codes else "")
        comments = (_words(line.strip().lstrip("#")) for line in reversed(above) if line.strip())
        if _header(rows[0][1]) is None and (words := next(comments, None)) and _header(words) is not None:
            rows.insert(0, (0, words))
        columns = _header(rows[0][1])
        if columns is None:
            return _not_degrees(_places(place, rows, ["name", "x", "y", "z"], system, _plain))
        return _not_degrees(_with_header(place, rows, columns, system))


def _not_degrees(places: Places) -> Places:
    """Return places of an unnamed system, unless they are far from its origin, and farther apart in height than else.

    So are degrees: those of a flight differ by a thousandth, heights by metres. Of lengths that is an odd choice of an
    origin, which can be confirmed.
    """
    first, second, height = np.ptp(places.coordinates, axis=0) if len(places.names) > 1 else np.zeros(3)
    least, most = np.sort(np.abs(places.coordinates[:, :2]).max(axis=0))
    is_near = max(first, second) < FAR * np.abs(places.coordinates[:, :2]).min()
    if places.system.is_local and least <= 90.0 and most <= 180.0 and is_near and height > max(first, second) > 0.0:
        raise FileFormatError(
            f"{places.source}: the first two coordinates differ by {first:.2g} and {second:.2g}, heights by "
            f"{height:.2g}: they look like degrees. Name the columns in a first line, such as "
            "name,latitude,longitude,altitude; or, if they are lengths, write 'local' there."
        )
    return places


def split(line: str) -> list[str]:
    """Return the words of a line: between semicolons, tabs or commas where there are any, else between white space.

    Raises
    ------
    FileFormatError
        If its numbers have decimal commas.
    """
    if _DECIMAL_COMMAS.search(line):
        raise FileFormatError(f"{shown(line)} has decimal commas. Write points, as in 1.25.")
    return _words(line)


def _words(line: str) -> list[str]:
    mark = next((mark for mark in ";\t," if mark in line), None)
    words = [word.strip().strip('"') for word in line.split(mark)]
    while words and not words[-1]:
        words.pop()
    return words


def _header(words: Sequence[str]) -> dict[str, int] | None:
    """Return the column of each meaning; None if the line holds no names of columns."""
    found: dict[str, int] = {}
    for column, word in enumerate(words):
        plain = _UNITS.sub("", word.strip().lower().replace("x/y", "horizontal"))
        bare = _QUALIFIERS.sub("", re.sub(r"[^a-z]", "", plain))
        if bare in _MEANING and not re.search(r"\.(jpe?g|png|tiff?|dng)$", word.lower()):
            found.setdefault(_MEANING[bare], column)
    return found if len(found) >= 3 else None


def _with_header(
    place: Path, rows: Sequence[tuple[int, list[str]]], columns: dict[str, int], system: CoordinateSystem
) -> Places:
    geographic = {"longitude", "latitude"} <= columns.keys()
    needed = ("name", *(("longitude", "latitude") if geographic else ("x", "y")), "z")
    if missing := [name for name in needed if name not in columns]:
        raise FileFormatError(
            f"{place}: the header {shown(' '.join(rows[0][1]))} names no column for {', '.join(missing)}. Expected "
            "name, x, y, z or name, longitude, latitude, altitude."
        )
    order = [columns[name] for name in needed]
    one = columns.get("sigma")
    across, up = columns.get("horizontal", one), columns.get("vertical", columns.get("sz", one))
    sigma = [columns.get("sx", across), columns.get("sy", across), columns.get("sz", up)]
    stated = [column for column in sigma if column is not None] if None not in sigma else []
    last = max(order)
    ordered = []
    for number, words in rows[1:]:
        if len(words) <= last:
            raise FileFormatError(f"{place}, line {number}: expected {last + 1} columns; got {len(words)}.")
        values = [words[column] for column in order]
        for row, side in ((1, "east"), (2, "north")) if geographic else ():
            if side in columns and "".join(words[columns[side] :][:1]).upper().startswith(("S", "W")):
                values[row] = f"-{values[row].lstrip('-')}"
        accuracy = ["".join(words[column:][:1]) or "0" for column in stated]  # left empty: not stated
        ordered.append((number, values + accuracy))
    if geographic:
        system = CoordinateSystem("EPSG:4326")
    return _places(place, ordered, list(needed), system, _plain)


def _places(
    place: Path, rows: Sequence[tuple[int, list[str]]], names: list[str], system: CoordinateSystem,
    tail: Callable[[list[float], str], list[float]],
) -> Places:  # fmt: skip
    """Return places of rows of a name, three coordinates, and what ``tail`` turns into three standard deviations."""
    found: dict[str, list[float]] = {}
    without_height = 0
    for number, words in rows:
        where = f"{place}, line {number}"
        if len(words) < 3 or (len(words) < 4 and tail is not _after_z):
            raise FileFormatError(f"{where}: expected {', '.join(names)}; got {shown(' '.join(words))}.")
        if words[0] in found:
            raise FileFormatError(f"{where}: {shown(words[0])} has a position already. Leave one of the two out.")
        without_height += len(words) < 4
        numbers = finite(words[1:] if len(words) > 3 else [*words[1:], "0"], where, "numbers after the name")
        found[words[0]] = [*numbers[:3], *tail(numbers[3:], where)]
    table = np.array(list(found.values())).reshape(-1, 6)
    notes = (
        [f"{place.name}: {counted(without_height, 'positions')} without a height; 0 is taken."]
        if without_height
        else []
    )
    sigma = np.where(table[:, 3:] > 0.0, table[:, 3:], np.nan)
    return Places(tuple(found), table[:, :3], sigma, system, str(place), tuple(notes))


def _plain(rest: list[float], where: str) -> list[float]:
    """Standard deviations after three coordinates: none, one, or three."""
    if len(rest) not in (0, 1, 3):
        raise FileFormatError(f"{where}: expected one or three standard deviations after x, y and z; got {len(rest)}.")
    return (rest * 3)[:3] if rest else [0.0] * 3


def _after_z(rest: list[float], where: str) -> list[float]:
    """What follows z in ``geo.txt``: three angles, which are not used, then horizontal and vertical accuracy."""
    if len(rest) >= 5:
        return [rest[3], rest[3], rest[4]]
    if len(rest) in (0, 3):
        return [0.0] * 3
    if len(rest) == 2:
        return [rest[0], rest[0], rest[1]]
    return [rest[0] if len(rest) == 1 else rest[3]] * 3
