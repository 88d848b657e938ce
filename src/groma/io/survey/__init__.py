# SPDX-License-Identifier: BSD-3-Clause
"""What surveyors write: positions and poses of cameras, control points with marks, distances, planes, directions.

Files come in as they lie on disk; out come names, coordinates, standard deviations and the system they are in, as they
stand there. Bringing them into one frame is :mod:`~groma.io.survey.coordinates`; finding the images and the scene that
they belong to is :mod:`groma.adjustment.survey`.
"""

from groma.io.survey.control import ControlFile, read_control
from groma.io.survey.coordinates import CoordinateSystem, Places, WorldFrame, common_frame
from groma.io.survey.exif import read_exif_positions
from groma.io.survey.positions import read_positions
from groma.io.survey.rows import (
    DirectionsFile,
    DistancesFile,
    PlanesFile,
    PosesFile,
    read_directions,
    read_distances,
    read_known_planes,
    read_measured_poses,
)

__all__ = [
    "ControlFile",
    "CoordinateSystem",
    "DirectionsFile",
    "DistancesFile",
    "Places",
    "PlanesFile",
    "PosesFile",
    "WorldFrame",
    "common_frame",
    "read_control",
    "read_directions",
    "read_distances",
    "read_exif_positions",
    "read_known_planes",
    "read_measured_poses",
    "read_positions",
]
