# SPDX-License-Identifier: BSD-3-Clause
"""Which calibration a query has: given, that of the map, what its file says, or none."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from groma.errors import InputError, did_you_mean
from groma.gates import gate
from groma.io.colmap.load import load_pycolmap, quiet
from groma.localization.localizer import unknown_camera
from groma.localization.pose.camera import QueryCamera

#: Where calibrations may come from.
SOURCES = ("auto", "map", "exif", "unknown")


@dataclass(frozen=True)
class CalibrationGates:
    """When a query has the camera of the map."""

    focal: float = gate(
        0.1, "share", "by which the focal length in the file may differ from that in files of the map, or of the map",
        "derived from focal lengths in files: good to some per cent",
    )  # fmt: skip


GATES = CalibrationGates()


@dataclass(frozen=True, eq=False)
class Calibration:
    """The calibration that a query begins with."""

    #: None: that of the map for photographs of its size is assumed; or nothing is known.
    camera: QueryCamera | None
    #: Whether focal length and distortion are estimated from there.
    refine: bool


@dataclass(frozen=True)
class CalibrationChoice:
    """What the user said of the cameras of queries."""

    #: One of :data:`SOURCES`. ``auto``: the map's for images of its size unless their files, or what they show, say
    #: otherwise, then what the file says, then unknown.
    source: str = "auto"
    #: Model and parameters, if they are known.
    model: str | None = None
    params: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if self.source not in SOURCES:
            raise InputError(
                f"--calibration must be one of {', '.join(SOURCES)}; got {self.source!r}."
                + did_you_mean(self.source, SOURCES)
            )
        if (self.model is None) != (self.params is None):
            raise InputError("--camera-model and --camera-params belong together. Pass both, or none.")
        if self.model is not None and self.params is not None:
            QueryCamera(self.model, np.array(self.params), 1, 1)  # refuses what does not fit, before any work


def calibration_of(
    path: Path,
    size: tuple[int, int],
    of_map: QueryCamera | None,
    choice: CalibrationChoice,
    photograph: Path | None = None,
) -> Calibration:
    """Return the calibration of a photograph of a size (width, height).

    Parameters
    ----------
    path, size
        The photograph.
    of_map
        The camera of the map for images of this size.
    choice
        What the user said.
    photograph
        One that the camera of the map took. What its file tells is compared with what the query's tells: both are wrong
        alike where photographs were cropped.
    """
    if choice.model is not None and choice.params is not None:
        return Calibration(QueryCamera(choice.model, np.array(choice.params), *size), False)
    if choice.source == "map":
        if of_map is None:
            raise InputError(
                f"{path.name}: the map has no camera for images of {size[0]}x{size[1]} pixels, or several. Pass "
                "--camera-model and --camera-params, or --calibration unknown."
            )
        return Calibration(of_map, False)
    focal = _focal_length(path) if choice.source in ("auto", "exif") else None
    if choice.source == "auto" and of_map is not None:
        own = None if focal is None or photograph is None else _focal_length_once(photograph)
        own = own or float(of_map.kind.focal_length(of_map.params))
        if focal is None or abs(focal - own) <= GATES.focal * own:
            return Calibration(None, False)
    if focal is None:
        return Calibration(None, True)
    return Calibration(unknown_camera(*size, focal), True)


def _focal_length(path: Path) -> float | None:
    """The focal length that a file tells, pixels."""
    pycolmap = load_pycolmap()
    with quiet(pycolmap):
        bitmap = pycolmap.Bitmap.read(str(path), False)
    focal = None if bitmap is None else bitmap.exif_focal_length()
    return float(focal) if focal and np.isfinite(focal) and focal > 0 else None


#: The same for a photograph of the map, which is read for the first query alone.
_focal_length_once = lru_cache(_focal_length)
