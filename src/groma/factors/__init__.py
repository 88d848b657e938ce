# SPDX-License-Identifier: BSD-3-Clause
"""Factors: one residual per file, each with its formula, its kernels, its class and its registration.

Importing this package registers every factor of groma; nothing is compiled before a factor is evaluated.
"""

from groma.factors._check import FactorCheck, check_factor
from groma.factors._factor import Example, Factor, Ref, Slot, register, registered
from groma.factors._selfcheck import SelfCheckReport, SelfCheckRow, selfcheck
from groma.factors.line_bearing import LineBearing
from groma.factors.line_direction import LineDirection
from groma.factors.line_normal import LineNormal
from groma.factors.line_on_plane import LineOnPlane, SegmentOnPlane
from groma.factors.line_reprojection import LineReprojection
from groma.factors.line_to_pixel import LineToPixel
from groma.factors.losses import (
    LOSSES,
    Barron,
    Cauchy,
    GemanMcClure,
    Huber,
    Loss,
    SoftL1,
    Trivial,
    Truncated,
    Tukey,
    loss,
)
from groma.factors.on_plane_pixels import PointOnPlanePixels, SegmentOnPlanePixels
from groma.factors.orthogonal import (
    LineParallelToPlane,
    LinePerpendicularToDirection,
    OrthogonalDirections,
    OrthogonalLines,
    OrthogonalPlanes,
    PlaneParallelToDirection,
)
from groma.factors.parallel import (
    LinePerpendicularToPlane,
    ParallelDirections,
    ParallelLines,
    ParallelPlanes,
    PlanePerpendicularToDirection,
)
from groma.factors.plane_observation import PlaneObservation
from groma.factors.plane_quaternion import PlaneQuaternion
from groma.factors.point_depth import PointDepth
from groma.factors.point_on_line import PointOnLine
from groma.factors.point_on_plane import PointOnPlane
from groma.factors.point_reprojection import PointReprojection
from groma.factors.point_to_image_line import PointToImageLine
from groma.factors.pose_between import PoseBetween
from groma.factors.pose_prior import PosePrior
from groma.factors.position_prior import PositionPrior
from groma.factors.stereo_line import StereoLine
from groma.factors.stereo_point import StereoPoint
from groma.factors.user import UserFactor, factor
from groma.factors.vector_prior import VectorPrior

__all__ = [
    "LOSSES",
    "Barron",
    "Cauchy",
    "Example",
    "Factor",
    "FactorCheck",
    "GemanMcClure",
    "Huber",
    "LineBearing",
    "LineDirection",
    "LineNormal",
    "LineOnPlane",
    "LineParallelToPlane",
    "LinePerpendicularToDirection",
    "LinePerpendicularToPlane",
    "LineReprojection",
    "LineToPixel",
    "Loss",
    "OrthogonalDirections",
    "OrthogonalLines",
    "OrthogonalPlanes",
    "ParallelDirections",
    "ParallelLines",
    "ParallelPlanes",
    "PlaneObservation",
    "PlaneParallelToDirection",
    "PlanePerpendicularToDirection",
    "PlaneQuaternion",
    "PointDepth",
    "PointOnLine",
    "PointOnPlane",
    "PointOnPlanePixels",
    "PointReprojection",
    "PointToImageLine",
    "PoseBetween",
    "PosePrior",
    "PositionPrior",
    "Ref",
    "SegmentOnPlane",
    "SegmentOnPlanePixels",
    "SelfCheckReport",
    "SelfCheckRow",
    "Slot",
    "SoftL1",
    "StereoLine",
    "StereoPoint",
    "Trivial",
    "Truncated",
    "Tukey",
    "UserFactor",
    "VectorPrior",
    "check_factor",
    "factor",
    "loss",
    "register",
    "registered",
    "selfcheck",
]
