# SPDX-License-Identifier: BSD-3-Clause
r"""What frames measure, and the factors made of it.

The same tables serve the estimate of one pose against a fixed map and the adjustment of a window; only the indices
differ. A depth along a segment is measured as the inverse depths of its two ends, which is what depth cameras and
stereo pairs know with even noise, and in which a straight line stays straight. As a factor it is the reprojection into
a *virtual camera* displaced by b across the segment, where an end at inverse depth w appears at :math:`u - f b w`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.factors.contract import Factor, Ref
from groma.factors.losses import Loss
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.plane_observation import PlaneObservation
from groma.factors.observations.point_depth import PointDepth
from groma.factors.observations.point_reprojection import PointReprojection
from groma.factors.observations.stereo_point import StereoPoint
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.manifold import Euclidean
from groma.problem.variables import Variables
from groma.tracking.frame.camera import PINHOLE, TrackCamera

#: Baseline of the virtual cameras, scene units: inverse depths of noise 0.003 then weigh like pixels.
VIRTUAL_BASELINE = 0.6
#: cam_from_body of the virtual cameras: displaced along x, and along y.
VIRTUAL = np.array([[0, 0, 0, 1, -VIRTUAL_BASELINE, 0, 0], [0, 0, 0, 1, 0, -VIRTUAL_BASELINE, 0.0]])


@dataclass(frozen=True)
class _Rows(ABC):
    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def take(self, rows: IntArray | BoolArray) -> Self:
        """Return some rows."""
        return replace(self, **{item.name: getattr(self, item.name)[rows] for item in fields(self)})

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
    #: (N,) column in the right image, pixels; NaN where unknown.
    right: FloatArray

    @classmethod
    def empty(cls) -> Self:
        """Return a table without rows."""
        none = np.zeros(0)
        return cls(np.zeros(0, np.int64), np.zeros((0, 2)), none, none, none, none)


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


def constants(camera: TrackCamera) -> dict[str, Variables]:
    """Return the groups of variables that never move: calibration and virtual cameras."""
    return {
        "intrinsics": Variables(Euclidean(4, "intrinsics"), camera.params[None], constant=True),
        "virtual": Variables(POSE_CHARTS["left"], VIRTUAL, constant=True),
    }


def point_factors(camera: TrackCamera, table: PointMeasurements, pose_idx: IntArray, loss: Loss) -> list[Factor]:
    """Reprojections of points, in both images where the right one is known, and their depths."""
    factors: list[Factor] = []
    paired = np.isfinite(table.right)
    single = ~paired
    rows = np.flatnonzero(single)
    if len(rows):
        factors.append(
            PointReprojection(
                pose=Ref("poses", pose_idx[rows]), point=Ref("points", table.index[rows]),
                intrinsics=Ref("intrinsics", np.zeros(len(rows), np.int64)), camera_model=PINHOLE,
                pixels=table.pixel[rows], sqrt_information=1.0 / table.sigma[rows], loss=loss,
            )
        )  # fmt: skip
    rows = np.flatnonzero(paired)
    if len(rows):
        factors.append(
            StereoPoint(
                pose=Ref("poses", pose_idx[rows]), point=Ref("points", table.index[rows]),
                intrinsics=Ref("intrinsics", np.zeros(len(rows), np.int64)), camera_model=PINHOLE,
                pixels=np.column_stack([table.pixel[rows], table.right[rows]]), baseline=camera.baseline,
                sqrt_information=1.0 / table.sigma[rows], loss=loss,
            )
        )  # fmt: skip
    rows = np.flatnonzero(np.isfinite(table.depth))
    if len(rows):
        factors.append(
            PointDepth(
                pose=Ref("poses", pose_idx[rows]), point=Ref("points", table.index[rows]), depths=table.depth[rows],
                sqrt_information=1.0 / table.depth_sigma[rows], loss=loss,
            )
        )  # fmt: skip
    return factors


def line_factors(camera: TrackCamera, table: LineMeasurements, pose_idx: IntArray, loss: Loss) -> list[Factor]:
    """Reprojections of lines, and the inverse depths of their ends where known."""
    if not len(table):
        return []
    zeros = np.zeros(len(table), np.int64)
    factors: list[Factor] = [
        LineReprojection(
            pose=Ref("poses", pose_idx), line=Ref("lines", table.index), intrinsics=Ref("intrinsics", zeros),
            camera_model=PINHOLE, segments=table.ends, sqrt_information=1.0 / table.sigma, loss=loss,
        )
    ]  # fmt: skip
    rows = np.flatnonzero(np.isfinite(table.inverse_depth).all(axis=1))
    if len(rows):
        ends, inverse = table.ends[rows].copy(), table.inverse_depth[rows]
        way = np.abs(ends[:, 2:] - ends[:, :2])
        flat = way[:, 0] > way[:, 1]  # displaced along y, else along x
        focal = np.where(flat, camera.fy, camera.fx)
        shift = focal[:, None] * VIRTUAL_BASELINE * inverse
        column = np.where(flat, 1, 0)
        every = np.arange(len(rows))
        ends[every, column] -= shift[:, 0]
        ends[every, 2 + column] -= shift[:, 1]
        noise = focal[:, None] * VIRTUAL_BASELINE * table.inverse_depth_sigma[rows]
        noise = np.sqrt(noise**2 + table.sigma[rows, None] ** 2)
        factors.append(
            LineReprojection(
                pose=Ref("poses", pose_idx[rows]), line=Ref("lines", table.index[rows]),
                intrinsics=Ref("intrinsics", zeros[rows]), extrinsics=Ref("virtual", flat.astype(int)),
                camera_model=PINHOLE, segments=ends, sqrt_information=_diagonal(1.0 / noise), loss=loss,
            )
        )  # fmt: skip
    return factors


def plane_factors(table: PlaneMeasurements, pose_idx: IntArray, loss: Loss) -> list[Factor]:
    """Planes measured in the camera."""
    if not len(table):
        return []
    return [
        PlaneObservation(
            pose=Ref("poses", pose_idx), plane=Ref("planes", table.index), planes_in_cam=table.plane,
            sqrt_information=table.sqrt_information, loss=loss,
        )
    ]  # fmt: skip


def _diagonal(values: FloatArray) -> FloatArray:
    out = np.zeros((*values.shape, values.shape[1]))
    out[:, np.arange(values.shape[1]), np.arange(values.shape[1])] = values
    return out


__all__ = [
    "LineMeasurements",
    "Measurements",
    "PlaneMeasurements",
    "PointMeasurements",
    "constants",
    "line_factors",
    "plane_factors",
    "point_factors",
]
