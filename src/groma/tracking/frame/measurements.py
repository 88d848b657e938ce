# SPDX-License-Identifier: BSD-3-Clause
"""What frames measure: light tables, one row per landmark seen, whose indices are rows of the map.

They become tables of a scene (:mod:`groma.tracking.map.map_scene`), of which :mod:`groma.adjustment.assemble` makes
problems: the pose of one frame, a window, the whole map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._rows import Rows, column
from groma._typing import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class PointMeasurements(Rows):
    """Points in images."""

    #: (N,) landmark.
    index: IntArray = column(dtype=np.int64)
    #: (N, 2) pixel, and its standard deviation (N,).
    pixel: FloatArray = column(2)
    sigma: FloatArray = column()
    #: (N,) depth and its standard deviation, scene units; NaN where unknown.
    depth: FloatArray = column()
    depth_sigma: FloatArray = column()
    #: (N, 2) pixel in the right image of a pair, rectified by the estimate of that time; NaN where unknown. Its row
    #: depends on the rotation of the right camera only.
    right: FloatArray = column(2)


@dataclass(frozen=True, eq=False)
class LineMeasurements(Rows):
    """Segments in images."""

    #: (N,) landmark.
    index: IntArray = column(dtype=np.int64)
    #: (N, 4) segment, pixels, darker side to the left; standard deviation of an end across it (N,).
    ends: FloatArray = column(4)
    sigma: FloatArray = column()
    #: (N, 2) inverse depths of the ends and their standard deviations; NaN where unknown.
    inverse_depth: FloatArray = column(2)
    inverse_depth_sigma: FloatArray = column(2)


@dataclass(frozen=True, eq=False)
class PlaneMeasurements(Rows):
    """Planes in the camera."""

    #: (N,) landmark.
    index: IntArray = column(dtype=np.int64)
    #: (N, 4) plane in the camera, unit normal.
    plane: FloatArray = column(4)
    #: (N, 3, 3) square root information in the basis of
    #: :class:`~groma.factors.observations.plane_observation.PlaneObservation`.
    sqrt_information: FloatArray = column(3, 3)


@dataclass(frozen=True)
class Measurements:
    """What one frame measures of the map."""

    points: PointMeasurements
    lines: LineMeasurements
    planes: PlaneMeasurements

    @classmethod
    def empty(cls) -> Measurements:
        """Return nothing measured."""
        return cls(PointMeasurements.empty(), LineMeasurements.empty(), PlaneMeasurements.empty())
