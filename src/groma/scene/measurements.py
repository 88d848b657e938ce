# SPDX-License-Identifier: BSD-3-Clause
# ruff: noqa: RUF009 - column() is dataclasses.field() with metadata
"""What was measured besides the places in the images: depths, stereo pairs, planes, poses.

One table for each kind of measurement, one row for each measurement, with its standard deviation. A kind is added by a
table here, a field of :class:`~groma.scene.Scene` and a term of :mod:`groma.adjustment.terms`; columns declare what
they refer to and how they change with the unit of length, and everything else follows. Files may lack these tables.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.scene.landmarks import check_unit
from groma.scene.table import Table, check_sigma, column


@dataclass(frozen=True, eq=False)
class PointDepths(Table):
    """Depths of points, as depth cameras measure them: coordinates along the optical axis."""

    noun: ClassVar[str] = "depth"
    optional: ClassVar[bool] = True
    #: (N,) the image.
    image_idx: IntArray = column(np.int64, refers="images")
    #: (N,) the point.
    point_idx: IntArray = column(np.int64, refers="points")
    #: (N,) depth, scene units.
    depth: FloatArray = column(np.float64, length=1)
    #: (N,) its standard deviation, scene units.
    sigma: FloatArray = column(np.float64, length=1)

    def _check(self) -> None:
        check_sigma("PointDepths.sigma", self.sigma)


@dataclass(frozen=True, eq=False)
class RightColumns(Table):
    """Observed points found in the right image of a rectified stereo pair, too, in the same row of pixels."""

    noun: ClassVar[str] = "column"
    optional: ClassVar[bool] = True
    #: (N,) the observation in the left image; at most one column for each.
    observation_idx: IntArray = column(np.int64, refers="point_observations")
    #: (N,) column in the right image, pixels. The disparity is the column in the left image less this one.
    u_right: FloatArray = column(np.float64)
    #: (N,) distance of the right camera from the left one along its x axis, scene units.
    baseline: FloatArray = column(np.float64, length=1)
    #: (N,) standard deviation, relative to that of the usual point observation.
    sigma: FloatArray = column(np.float64, fill=1.0)

    def _check(self) -> None:
        check_sigma("RightColumns.baseline", self.baseline)
        check_sigma("RightColumns.sigma", self.sigma)


@dataclass(frozen=True, eq=False)
class LineDepths(Table):
    """Inverse depths of the two ends of observed segments: what depth cameras and stereo pairs know with even noise.

    They are compared as what they are for a second camera, displaced across the segment: an end at the inverse depth w
    appears there shifted by f b w pixels.
    """

    noun: ClassVar[str] = "segment"
    optional: ClassVar[bool] = True
    #: (N,) the observed segment.
    observation_idx: IntArray = column(np.int64, refers="line_observations")
    #: (N, 2) inverse depths of its first and second end, 1 / scene units, and their standard deviations.
    inverse_depth: FloatArray = column(np.float64, 2, length=-1)
    sigma: FloatArray = column(np.float64, 2, length=-1)
    #: (N,) baseline b of the second camera, scene units: the larger, the less its view tells about the place across the
    #: segment, which the first tells already. For stereo pairs that of the pair. A few different ones at most.
    baseline: FloatArray = column(np.float64, length=1)

    def _check(self) -> None:
        check_sigma("LineDepths.sigma", self.sigma)
        check_sigma("LineDepths.baseline", self.baseline)


@dataclass(frozen=True, eq=False)
class PlaneObservations(Table):
    """Planes measured in the camera, such as those fitted to a depth image."""

    noun: ClassVar[str] = "observation"
    optional: ClassVar[bool] = True
    #: (N,) the image.
    image_idx: IntArray = column(np.int64, refers="images")
    #: (N,) the plane.
    plane_idx: IntArray = column(np.int64, refers="planes")
    #: (N, 4) unit normal n and offset w in the camera frame, n.X + w = 0; offset in scene units.
    plane_in_cam: FloatArray = column(np.float64, 4, length=(0, 0, 0, 1))
    #: (N, 3, 3) square-root information of two angles of the normal and the offset, in the basis of
    #: :class:`~groma.factors.observations.plane_observation.PlaneObservation`; radians and scene units.
    sqrt_information: FloatArray = column(np.float64, 3, 3, length=(0, 0, -1))

    def _check(self) -> None:
        check_unit("PlaneObservations.plane_in_cam[:, :3]", self.plane_in_cam[:, :3])


@dataclass(frozen=True, eq=False)
class PosePriors(Table):
    """Poses of frames known beforehand: from other instruments, or predicted."""

    noun: ClassVar[str] = "pose"
    optional: ClassVar[bool] = True
    #: (N,) the frame.
    frame_idx: IntArray = column(np.int64, refers="frames")
    #: (N, 7) pose [qx qy qz qw tx ty tz].
    rig_from_world: FloatArray = column(np.float64, 7, world="poses")
    #: (N, 6) standard deviations along the axes of the rig (scene units) and about them (radians).
    sigma: FloatArray = column(np.float64, 6, length=(1, 1, 1, 0, 0, 0))

    def _check(self) -> None:
        check_sigma("PosePriors.sigma", self.sigma)
