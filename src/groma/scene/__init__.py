# SPDX-License-Identifier: BSD-3-Clause
"""Scenes: tables of arrays and identifiers, without algorithms."""

from groma.scene.camera import Cameras, PrincipalPointPriors, Rigs, Sensors
from groma.scene.image import Frames, Images
from groma.scene.landmarks import Directions, Lines, Planes, Points
from groma.scene.line_intervals import LineIntervals
from groma.scene.measurements import LineDepths, PlaneObservations, PointDepths, PosePriors, RightColumns
from groma.scene.motions import CameraMotions
from groma.scene.observations import Keypoints, LineObservations, PointObservations, Relations
from groma.scene.scene import Scene
from groma.scene.similarity import Similarity
from groma.scene.survey import (
    CameraPoses,
    CameraPositions,
    ControlPoints,
    Distances,
    Held,
    KnownDirections,
    KnownPlanes,
    Marks,
)

__all__ = [
    "CameraMotions",
    "CameraPoses",
    "CameraPositions",
    "Cameras",
    "ControlPoints",
    "Directions",
    "Distances",
    "Frames",
    "Held",
    "Images",
    "Keypoints",
    "KnownDirections",
    "KnownPlanes",
    "LineDepths",
    "LineIntervals",
    "LineObservations",
    "Lines",
    "Marks",
    "PlaneObservations",
    "Planes",
    "PointDepths",
    "PointObservations",
    "Points",
    "PosePriors",
    "PrincipalPointPriors",
    "Relations",
    "RightColumns",
    "Rigs",
    "Scene",
    "Sensors",
    "Similarity",
]
