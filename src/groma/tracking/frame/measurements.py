# SPDX-License-Identifier: BSD-3-Clause
"""What frames measure: light tables, one row per landmark seen, whose indices are rows of the map.

They become tables of a scene (:mod:`groma.tracking.map.map_scene`), of which :mod:`groma.adjustment.assemble` makes
problems: the pose of one frame, a window, the whole map.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray

#: Baseline at which the inverse depths of segments are compared, scene units: noise of 0.003 then weighs like pixels.
DEPTH_BASELINE = 0.6


@dataclass(frozen=True)
class _Rows(ABC):
    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def take(self, rows: IntArray | BoolArray) -> Self:
        """Return some rows."""
        return type(self)(*[column[rows] for column in vars(self).values()])

    @classmethod
    def stack(cls, tables: list[Self]) -> Self:
        """Return the rows of several tables, one after the other."""
        if not tables:
            return cls.empty()
        return cls(**{item.name: np.concatenate([getattr(t, item.name) for t in tables]) for item in fields(cls)})

    @classmethod
    @abstractmethod
    def empty(cls) -> Self:
        """Return a table without rows."""


@dataclass(frozen=True)
class PointMeasurements(_Rows):
    """Points in images."""

    #: (N,) landmark.
    index: IntArray
    #: (N, 2) pixel, and its standard deviation (N,).
    pixel: FloatArray
    sigma: FloatArray
    #: (N,) depth and its standard deviation, scene units; NaN where unknown.
    depth: FloatArray
    depth_sigma: FloatArray
    #: (N, 2) pixel in the right image of a pair, turned back as it was known then; NaN where unknown. Its row tells
    #: nothing but how the right camera is turned.
    right: FloatArray

    @classmethod
    def empty(cls) -> Self:
        """Return a table without rows."""
        none = np.zeros(0)
        return cls(np.zeros(0, np.int64), np.zeros((0, 2)), none, none, none, np.zeros((0, 2)))


@dataclass(frozen=True)
class LineMeasurements(_Rows):
    """Segments in images."""

    #: (N,) landmark.
    index: IntArray
    #: (N, 4) segment, pixels, darker side to the left; standard deviation of an end across it (N,).
    ends: FloatArray
    sigma: FloatArray
    #: (N, 2) inverse depths of the ends and their standard deviations; NaN where unknown.
    inverse_depth: FloatArray
    inverse_depth_sigma: FloatArray

    @classmethod
    def empty(cls) -> Self:
        """Return a table without rows."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 4)), np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2)))


@dataclass(frozen=True)
class PlaneMeasurements(_Rows):
    """Planes in the camera."""

    #: (N,) landmark.
    index: IntArray
    #: (N, 4) plane in the camera, unit normal.
    plane: FloatArray
    #: (N, 3, 3) square root information in the basis of
    #: :class:`~groma.factors.observations.plane_observation.PlaneObservation`.
    sqrt_information: FloatArray

    @classmethod
    def empty(cls) -> Self:
        """Return a table without rows."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 4)), np.zeros((0, 3, 3)))


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
