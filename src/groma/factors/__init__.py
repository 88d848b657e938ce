# SPDX-License-Identifier: BSD-3-Clause
"""Factors: one residual per file, each with its formula, its kernels, its class and its registration.

Importing this package registers every factor of groma; nothing is compiled before a factor is evaluated.
"""

from groma.factors.checks.check import FactorCheck, check_factor
from groma.factors.checks.selfcheck import SelfCheckReport, SelfCheckRow, selfcheck
from groma.factors.contract import (
    ANY_SIMILARITY,
    WORLD_FIXED,
    Example,
    Factor,
    Invariance,
    Ref,
    Slot,
    register,
    registered,
)
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
    register_loss,
)
from groma.factors.observations.line_bearing import LineBearing
from groma.factors.observations.line_normal import LineNormal
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.line_unprojection import LineUnprojection
from groma.factors.observations.plane_observation import PlaneObservation
from groma.factors.observations.plane_quaternion import PlaneQuaternion
from groma.factors.observations.point_depth import PointDepth
from groma.factors.observations.point_reprojection import PointReprojection
from groma.factors.observations.stereo_line import StereoLine
from groma.factors.observations.stereo_point import StereoPoint
from groma.factors.priors.distance import Distance
from groma.factors.priors.known_direction import CameraDirection, KnownDirection
from groma.factors.priors.on_known_plane import OnKnownPlane
from groma.factors.priors.pose_between import PoseBetween
from groma.factors.priors.pose_prior import PosePrior
from groma.factors.priors.position_prior import PositionPrior
from groma.factors.priors.similarity_between import SimilarityBetween
from groma.factors.priors.vector_prior import VectorPrior
from groma.factors.relations.direction_pairs import (
    LineDirection,
    LineParallelToPlane,
    LinePerpendicularToDirection,
    LinePerpendicularToPlane,
    OrthogonalDirections,
    OrthogonalLines,
    OrthogonalPlanes,
    ParallelDirections,
    ParallelLines,
    ParallelPlanes,
    PlaneParallelToDirection,
    PlanePerpendicularToDirection,
)
from groma.factors.relations.line_on_plane import LineOnPlane, SegmentOnPlane
from groma.factors.relations.line_to_pixel import LineToPixel
from groma.factors.relations.lines_meeting import LinesMeeting
from groma.factors.relations.on_plane_pixels import PointOnPlanePixels, SegmentOnPlanePixels
from groma.factors.relations.point_on_line import PointOnLine
from groma.factors.relations.point_on_plane import PointOnPlane
from groma.factors.relations.point_to_image_line import PointToImageLine
from groma.factors.user import UserFactor, factor

__all__ = [
    "ANY_SIMILARITY",
    "LOSSES",
    "WORLD_FIXED",
    "Barron",
    "CameraDirection",
    "Cauchy",
    "Distance",
    "Example",
    "Factor",
    "FactorCheck",
    "GemanMcClure",
    "Huber",
    "Invariance",
    "KnownDirection",
    "LineBearing",
    "LineDirection",
    "LineNormal",
    "LineOnPlane",
    "LineParallelToPlane",
    "LinePerpendicularToDirection",
    "LinePerpendicularToPlane",
    "LineReprojection",
    "LineToPixel",
    "LineUnprojection",
    "LinesMeeting",
    "Loss",
    "OnKnownPlane",
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
    "SimilarityBetween",
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
    "register_loss",
    "registered",
    "selfcheck",
]
