# SPDX-License-Identifier: BSD-3-Clause
"""What was measured besides the places in the images: depths, stereo pairs, planes, poses.

One table for each kind of measurement, one row for each measurement, with its standard deviation. A kind is added by a
table here, a field of :class:`~groma.scene.Scene` and a term of :mod:`groma.adjustment.terms`; columns declare what
they refer to and how they change with the unit of length, and everything else follows. Files may lack these tables.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.scene.landmarks import check_normals
from groma.scene.table import Table, check_sigma, column


@dataclass(frozen=True, eq=False)
class PointDepths(Table, noun="depth", optional=True):
    """Depths of points, as depth cameras measure them: coordinates along the optical axis."""

    #: (N,) the image.
    image_idx: IntArray = column(np.int64, refers="images")
    #: (N,) the point.
    point_idx: IntArray = column(np.int64, refers="points")
    #: (N,) depth, scene units.
    depth: FloatArray = column(np.float64, length=1)
    #: (N,) its standard deviation, scene units.
    sigma: FloatArray = column(np.float64, length=1, check=check_sigma)


@dataclass(frozen=True, eq=False)
class RightColumns(Table, noun="column", optional=True):
    """Observed points found in the right image of a rectified stereo pair, too, in the same row of pixels."""

    #: (N,) the observation in the left image; at most one column for each.
    observation_idx: IntArray = column(np.int64, refers="point_observations")
    #: (N,) column in the right image, pixels. The disparity is the column in the left image less this one.
    u_right: FloatArray = column(np.float64)
    #: (N,) distance of the right camera from the left one along its x axis, scene units.
    baseline: FloatArray = column(np.float64, length=1, check=check_sigma)
    #: (N,) standard deviation, relative to that of the usual point observation.
    sigma: FloatArray = column(np.float64, fill=1.0, check=check_sigma)


@dataclass(frozen=True, eq=False)
class LineDepths(Table, noun="segment", optional=True):
    """Inverse depths of the two ends of observed segments: what depth cameras and stereo pairs know with even noise.

    They are compared as what they are for a second camera, displaced across the segment: an end at the inverse depth w
    appears there shifted by f b w pixels.
    """

    #: (N,) the observed segment.
    observation_idx: IntArray = column(np.int64, refers="line_observations")
    #: (N, 2) inverse depths of its first and second end, 1 / scene units, and their standard deviations.
    inverse_depth: FloatArray = column(np.float64, 2, length=-1)
    sigma: FloatArray = column(np.float64, 2, length=-1, check=check_sigma)
    #: (N,) baseline b of the second camera, scene units: the larger, the less its view tells about the place across the
    #: segment, which the first tells already. For stereo pairs that of the pair. A few different ones at most.
    baseline: FloatArray = column(np.float64, length=1, check=check_sigma)


@dataclass(frozen=True, eq=False)
class PlaneObservations(Table, noun="observation", optional=True):
    """Planes measured in the camera, such as those fitted to a depth image."""

    #: (N,) the image.
    image_idx: IntArray = column(np.int64, refers="images")
    #: (N,) the plane.
    plane_idx: IntArray = column(np.int64, refers="planes")
    #: (N, 4) unit normal n and offset w in the camera frame, n.X + w = 0; offset in scene units.
    plane_in_cam: FloatArray = column(np.float64, 4, length=(0, 0, 0, 1), check=check_normals)
    #: (N, 3, 3) square-root information of two angles of the normal and the offset, in the basis of
    #: :class:`~groma.factors.observations.plane_observation.PlaneObservation`; radians and scene units.
    sqrt_information: FloatArray = column(np.float64, 3, 3, length=(0, 0, -1))


@dataclass(frozen=True, eq=False)
class PosePriors(Table, noun="pose", optional=True):
    """Prior poses of frames: from other instruments, or predicted."""

    #: (N,) the frame.
    frame_idx: IntArray = column(np.int64, refers="frames")
    #: (N, 7) pose [qx qy qz qw tx ty tz].
    rig_from_world: FloatArray = column(np.float64, 7, world="poses")
    #: (N, 6) standard deviations along the axes of the rig (scene units) and about them (radians).
    sigma: FloatArray = column(np.float64, 6, length=(1, 1, 1, 0, 0, 0), check=check_sigma)
