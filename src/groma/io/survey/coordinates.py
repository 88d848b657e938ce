# SPDX-License-Identifier: BSD-3-Clause
r"""Coordinate systems of measured places, and one frame for all of them.

Places are longitude, latitude (degrees) and height, or east, north and height (metres), or of a system of their own.
An adjustment needs a Cartesian frame. Projected and local coordinates are one as they are written. Longitudes and
latitudes on the ellipsoid of WGS84 (a, f) become east, north and up at an origin, through

.. math:: X = (N + h) \cos\varphi \cos\lambda, \quad Y = (N + h) \cos\varphi \sin\lambda, \quad
          Z = ((1 - e^2) N + h) \sin\varphi, \qquad N = a / \sqrt{1 - e^2 \sin^2\varphi},

in which lengths are true; in UTM they are not (0.04 % in the middle of a zone). Everything else needs pyproj.

Reference: Hofmann-Wellenhof et al., *GNSS*, 2008, eqs. (8.1) to (8.8).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError

#: Semi-major axis, metres, and squared eccentricity of WGS84 (convention: the ellipsoid).
_AXIS, _ECCENTRICITY2 = 6378137.0, 0.0066943799901413165
_UTM_WORDS = re.compile(r"(?:WGS\s*84\s+)?UTM\s+(?:zone\s+)?(\d{1,2})\s*([NS])", re.IGNORECASE)
_GEOGRAPHIC = ("EPSG:4326", "EPSG:4979", "EPSG:4258", "EPSG:4269")


@dataclass(frozen=True)
class CoordinateSystem:
    """What coordinates mean."""

    #: As a file names it, such as ``EPSG:32611``; empty for coordinates of a system of their own.
    name: str = ""

    @property
    def is_geographic(self) -> bool:
        """Whether coordinates are longitude, latitude and height."""
        return self.name in _GEOGRAPHIC or "+proj=longlat" in self.name or "+proj=latlong" in self.name

    @property
    def is_local(self) -> bool:
        """Whether coordinates are of a system of their own."""
        return not self.name

    @classmethod
    def parse(cls, text: str) -> CoordinateSystem | None:
        """Return the system that a line of a file names; None if it names none.

        ``EPSG:32611``, ``WGS84 UTM 11N`` and ``+proj=utm +zone=11 ...`` are the same.
        """
        line = " ".join(text.split())
        if line.lower() == "local":
            return cls()
        if found := re.fullmatch(r"EPSG:\s*(\d{3,6})", line, re.IGNORECASE):
            return cls(f"EPSG:{found[1]}")
        if found := _UTM_WORDS.fullmatch(line):
            return cls(_utm(int(found[1]), found[2].upper() == "S"))
        if line.startswith("+proj="):
            parts = (word.lstrip("+").partition("=") for word in line.split())
            words = {name: value for name, _, value in parts}
            wgs84 = words.get("datum", words.get("ellps", "WGS84")) == "WGS84" and words.get("units", "m") == "m"
            if words["proj"] == "utm" and wgs84 and words.get("zone", "").isdigit():
                return cls(_utm(int(words["zone"]), "south" in words))
            return cls(line)
        return None


def _utm(zone: int, south: bool) -> str:
    return f"EPSG:{32700 + zone if south else 32600 + zone}"


@dataclass(frozen=True, eq=False)
class Places:
    """Named places as a file holds them."""

    #: (N,) names: of images or of points.
    names: tuple[str, ...]
    #: (N, 3) longitude, latitude (degrees) and height; or east, north and height.
    coordinates: FloatArray
    #: (N, 3) standard deviations of east, north and height, in the unit of length; NaN: not in the file.
    sigma: FloatArray
    system: CoordinateSystem
    #: Where they come from, for messages.
    source: str
    #: Sentences about what was read and what was assumed.
    notes: tuple[str, ...] = ()
    #: Standard deviations of east, north and height that are usual where none are stated; empty: nothing is usual.
    usual_sigma: tuple[float, ...] = ()


@dataclass(frozen=True)
class WorldFrame:
    """The Cartesian frame that places were brought into."""

    #: Its readable name, such as ``UTM zone 11 north (EPSG:32611)``.
    description: str
    #: The coordinate system; empty for local ones.
    system: str = ""
    #: Longitude, latitude (degrees) and height of the origin of east, north and up; None for other frames.
    origin: tuple[float, float, float] | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        origin = (
            None if self.origin is None else dict(zip(("longitude", "latitude", "height"), self.origin, strict=True))
        )
        return {"description": self.description, "system": self.system, "origin": origin}


def common_frame(groups: Sequence[Places], wanted: str | None = None) -> tuple[list[FloatArray], WorldFrame]:
    """Return the places of each group in one Cartesian frame, and the frame.

    Projected and local coordinates stay as they are. Geographic ones take the system of the others; where all are
    geographic, east, north and up at their middle.

    Parameters
    ----------
    groups : sequence of Places
        At least one.
    wanted : str, optional
        ``enu``, ``utm`` (the zone of the places), or a system such as ``EPSG:25832``; all but ``enu`` needs pyproj.

    Raises
    ------
    InputError
        If systems cannot be joined, or longitude and latitude are exchanged.
    """
    told = [group for group in groups if np.isfinite(group.coordinates).any()]
    if len(told) < len(groups):  # marks of points without coordinates do not determine the frame
        found, frame = common_frame(told, wanted)
        return [found.pop(0) if group in told else group.coordinates for group in groups], frame
    for group in groups:
        _check(group)
    names = sorted({group.system.name for group in groups})
    if not groups:
        return [], WorldFrame("the frame of the scene")
    if "" in names:
        if len(names) > 1 or wanted:
            raise InputError(
                f"{next(group.source for group in groups if group.system.is_local)} does not say its coordinate "
                f"system, and cannot be joined with {wanted or names[1]}. Begin it with a line such as EPSG:32632."
            )
        return [group.coordinates for group in groups], WorldFrame("the coordinates of the file, as written")
    projected = sorted({group.system.name for group in groups if not group.system.is_geographic})
    if wanted in (None, "enu") and not projected:
        return _east_north_up(groups)
    if wanted == "enu":
        raise InputError(f"--crs enu needs longitudes and latitudes; these are in {projected[0]}. Leave it out.")
    target = wanted or projected[0]
    if target == "utm":
        target = projected[0] if projected else _utm_of(groups)
    system = CoordinateSystem.parse(target)
    if system is None or system.is_geographic:
        raise InputError(f"--crs must be enu, utm or a projected system such as EPSG:32632; got {target!r}.")
    return [_projected(group, system.name) for group in groups], WorldFrame(described(system.name), system.name)


def described(system: str) -> str:
    """Return the readable name of a system.

    Raises
    ------
    InputError
        If pyproj is installed and has no such system.
    """
    code = system.removeprefix("EPSG:")
    if code.isdigit() and (32601 <= int(code) <= 32660 or 32701 <= int(code) <= 32760):
        return f"UTM zone {int(code) % 100} {'north' if int(code) < 32700 else 'south'} ({system})"
    try:
        import pyproj  # type: ignore[import-not-found]  # an extra
    except ImportError:
        return f"{system} (as written; whether there is such a system is not checked without pyproj)"
    try:
        found = pyproj.CRS.from_user_input(system)
    except pyproj.exceptions.CRSError:
        raise InputError(f"pyproj knows no coordinate system {system}. Check the code, or write local.") from None
    units = {axis.unit_name for axis in found.axis_info} - {"metre"}
    return f"{found.name} ({', '.join([system, *sorted(units)])})"


def _check(group: Places) -> None:
    x, y = group.coordinates[np.isfinite(group.coordinates).all(axis=1), :2].T
    if len(x) == 0:
        return
    if group.system.is_geographic:
        if np.abs(y).max() > 90.0:
            swapped = np.abs(x).max() <= 90.0 and np.abs(y).max() <= 180.0
            guess = "Are longitude and latitude exchanged?" if swapped else "Are these metres, not degrees?"
            raise InputError(f"{group.source}: a latitude is {y[np.abs(y).argmax()]:g} degrees. {guess}")
        if np.abs(x).max() > 360.0:
            raise InputError(f"{group.source}: a longitude is {x[np.abs(x).argmax()]:g} degrees. Are these metres?")
    elif len(x) > 1 and np.abs(x).max() <= 180.0 and np.abs(y).max() <= 90.0:
        spread = max(float(np.ptp(x)), float(np.ptp(y)))
        if 0.0 < spread < 0.1 and np.hypot(np.median(x), np.median(y)) > 30.0 * spread:
            raise InputError(
                f"{group.source}: all coordinates are within {spread:.2g} of ({np.median(x):.6g}, {np.median(y):.6g}) "
                "and look like degrees, not metres. Name the columns longitude, latitude and altitude, or begin with "
                "EPSG:4326."
            )


def _east_north_up(groups: Sequence[Places]) -> tuple[list[FloatArray], WorldFrame]:
    middle = np.nanmedian(np.concatenate([group.coordinates for group in groups]), axis=0)
    origin = (round(float(middle[0]), 6), round(float(middle[1]), 6), float(round(float(middle[2]))))
    frame = WorldFrame(
        f"east, north and up in metres at longitude {origin[0]:.6f}, latitude {origin[1]:.6f}, height {origin[2]:g}",
        origin=origin,
    )
    return [east_north_up(group.coordinates, origin) for group in groups], frame


def east_north_up(coordinates: FloatArray, origin: tuple[float, float, float]) -> FloatArray:
    """Return longitudes, latitudes (degrees) and heights (N, 3) as east, north and up (N, 3) at an origin, metres."""
    longitude, latitude = math.radians(origin[0]), math.radians(origin[1])
    sin_l, cos_l, sin_p, cos_p = math.sin(longitude), math.cos(longitude), math.sin(latitude), math.cos(latitude)
    axes = np.array(
        [[-sin_l, cos_l, 0.0], [-sin_p * cos_l, -sin_p * sin_l, cos_p], [cos_p * cos_l, cos_p * sin_l, sin_p]]
    )
    return (geocentric(coordinates) - geocentric(np.array([origin]))) @ axes.T


def geocentric(coordinates: FloatArray) -> FloatArray:
    """Return longitudes, latitudes (degrees) and heights (N, 3) as coordinates from the centre of the Earth, metres."""
    longitude, latitude = np.radians(coordinates[:, 0]), np.radians(coordinates[:, 1])
    height, sine = coordinates[:, 2], np.sin(latitude)
    radius = _AXIS / np.sqrt(1.0 - _ECCENTRICITY2 * sine**2)
    around = (radius + height) * np.cos(latitude)
    return np.stack(
        [around * np.cos(longitude), around * np.sin(longitude), ((1.0 - _ECCENTRICITY2) * radius + height) * sine],
        axis=1,
    )


def _utm_of(groups: Sequence[Places]) -> str:
    longitude, latitude = np.nanmedian(np.concatenate([group.coordinates for group in groups]), axis=0)[:2]
    return _utm(min(int((longitude + 180.0) // 6.0) + 1, 60), latitude < 0.0)  # convention: zones of six degrees


def _projected(group: Places, target: str) -> FloatArray:
    if group.system.name == target:
        return group.coordinates
    try:
        import pyproj  # type: ignore[import-not-found]  # an extra
    except ImportError:
        raise InputError(
            f"{group.source} is in {group.system.name}; to bring it into {target} groma needs pyproj: pip install "
            '"groma[geo]".'
        ) from None
    try:
        transformer = pyproj.Transformer.from_crs(group.system.name, target, always_xy=True)
        known = np.isfinite(group.coordinates).all(axis=1)
        found = np.full(group.coordinates.shape, np.nan)
        found[known] = np.stack(transformer.transform(*group.coordinates[known].T), axis=1)
    except pyproj.exceptions.ProjError as error:
        raise InputError(f"pyproj cannot bring {group.system.name} into {target}: {error}. Check the codes.") from error
    if not np.isfinite(found[known]).all():
        raise InputError(f"{group.source}: places lie outside the area of {target}. Is that the right system?")
    return found
