# SPDX-License-Identifier: BSD-3-Clause
"""groma: reconstruct and adjust scenes made of points, lines and planes.

The public names below are loaded when they are first used (PEP 562), so that ``import groma`` compiles nothing and
costs next to nothing. Sub-packages are reachable the same way: ``groma.geometry``, ``groma.cameras``,
``groma.factors``.
"""

import zlib as _zlib  # noqa: F401  (before pycolmap, whose library hides Python's own deflate and breaks it)
from importlib import import_module

import groma._moved  # noqa: F401  (names the new place of modules that moved)
from groma._version import __version__ as __version__

TYPE_CHECKING = False  # as in typing, which takes longer to import than all the rest
if TYPE_CHECKING:
    from groma import (
        adjustment,
        cameras,
        compilation,
        errors,
        estimators,
        evaluation,
        factors,
        features,
        geometry,
        io,
        localization,
        mapping,
        problem,
        scene,
        solver,
        testing,
        tracking,
        viz,
    )
    from groma.adjustment.adjust import AdjustOptions, adjust
    from groma.adjustment.contributions import contributions
    from groma.adjustment.covariance_files import write_covariances
    from groma.adjustment.diagnosis import diagnose_scene as diagnose
    from groma.adjustment.graphs.pose_graph import PoseGraphOptions, PoseGraphResult, adjust_pose_graph
    from groma.adjustment.parts import adjust_parts, write_parts
    from groma.adjustment.report import AdjustResult
    from groma.adjustment.survey.align import Alignment, align
    from groma.adjustment.survey.given import Survey
    from groma.adjustment.survey.records import Reliability
    from groma.adjustment.survey.reliability import reliability
    from groma.adjustment.uncertainty import uncertainty
    from groma.compilation.warmup import warm_up
    from groma.errors import FileFormatError, GromaError, InputError, OutputError, ProblemError, ShapeError
    from groma.estimators.motion.estimation import Motion, MotionOptions, estimate_motion
    from groma.estimators.motion.matches import LandmarkMatches
    from groma.evaluation.lines import evaluate_lines
    from groma.evaluation.planes import evaluate_planes
    from groma.evaluation.poses import evaluate_poses
    from groma.evaluation.trajectory import score_trajectory as evaluate_trajectory
    from groma.factors.contract import Ref
    from groma.factors.losses import loss
    from groma.factors.observations.line_bearing import LineBearing
    from groma.factors.observations.line_reprojection import LineReprojection
    from groma.factors.observations.plane_observation import PlaneObservation
    from groma.factors.observations.point_reprojection import PointReprojection
    from groma.factors.priors.pose_prior import PosePrior
    from groma.factors.relations.line_on_plane import LineOnPlane
    from groma.factors.relations.point_on_plane import PointOnPlane
    from groma.factors.user import factor
    from groma.io import read_scene, read_trajectory, write_scene
    from groma.io.convert import convert
    from groma.io.sequences import open_sequence
    from groma.localization.localizer import LocalizedImage, LocalizeOptions, Localizer
    from groma.localization.pose.absolute_pose import AbsolutePose, PoseOptions, estimate_absolute_pose
    from groma.localization.pose.camera import QueryCamera
    from groma.mapping.map import MapOptions, map_images
    from groma.mapping.result import MapResult
    from groma.mapping.surveyed import SurveyedResult, adjust_surveyed
    from groma.problem.problem import Problem
    from groma.problem.variables import Variables
    from groma.scene import Scene, Similarity
    from groma.solver.options import SolverOptions
    from groma.solver.report import SolveReport
    from groma.solver.solve import Solution, solve
    from groma.solver.termination import Termination
    from groma.tracking import Tracker, TrackOptions, TrackResult, track
    from groma.viz.report.page import write_report

#: Where each public name lives, and after a colon its name there if that is another; with ``__all__`` and the imports
#: above the only place to touch when one is added.
_HOME = {
    "AbsolutePose": "groma.localization.pose.absolute_pose",
    "AdjustOptions": "groma.adjustment.adjust",
    "AdjustResult": "groma.adjustment.report",
    "Alignment": "groma.adjustment.survey.align",
    "FileFormatError": "groma.errors",
    "GromaError": "groma.errors",
    "InputError": "groma.errors",
    "LandmarkMatches": "groma.estimators.motion.matches",
    "LineBearing": "groma.factors.observations.line_bearing",
    "LineOnPlane": "groma.factors.relations.line_on_plane",
    "LineReprojection": "groma.factors.observations.line_reprojection",
    "LocalizeOptions": "groma.localization.localizer",
    "LocalizedImage": "groma.localization.localizer",
    "Localizer": "groma.localization.localizer",
    "MapOptions": "groma.mapping.map",
    "MapResult": "groma.mapping.result",
    "Motion": "groma.estimators.motion.estimation",
    "MotionOptions": "groma.estimators.motion.estimation",
    "OutputError": "groma.errors",
    "PlaneObservation": "groma.factors.observations.plane_observation",
    "PointOnPlane": "groma.factors.relations.point_on_plane",
    "PointReprojection": "groma.factors.observations.point_reprojection",
    "PoseGraphOptions": "groma.adjustment.graphs.pose_graph",
    "PoseGraphResult": "groma.adjustment.graphs.pose_graph",
    "PoseOptions": "groma.localization.pose.absolute_pose",
    "PosePrior": "groma.factors.priors.pose_prior",
    "Problem": "groma.problem.problem",
    "ProblemError": "groma.errors",
    "QueryCamera": "groma.localization.pose.camera",
    "Ref": "groma.factors.contract",
    "Reliability": "groma.adjustment.survey.records",
    "Scene": "groma.scene",
    "ShapeError": "groma.errors",
    "Similarity": "groma.scene",
    "Solution": "groma.solver.solve",
    "SolveReport": "groma.solver.report",
    "SolverOptions": "groma.solver.options",
    "Survey": "groma.adjustment.survey.given",
    "SurveyedResult": "groma.mapping.surveyed",
    "Termination": "groma.solver.termination",
    "TrackOptions": "groma.tracking",
    "TrackResult": "groma.tracking",
    "Tracker": "groma.tracking",
    "Variables": "groma.problem.variables",
    "adjust": "groma.adjustment.adjust",
    "adjust_parts": "groma.adjustment.parts",
    "adjust_pose_graph": "groma.adjustment.graphs.pose_graph",
    "adjust_surveyed": "groma.mapping.surveyed",
    "align": "groma.adjustment.survey.align",
    "contributions": "groma.adjustment.contributions",
    "convert": "groma.io.convert",
    "diagnose": "groma.adjustment.diagnosis:diagnose_scene",
    "estimate_absolute_pose": "groma.localization.pose.absolute_pose",
    "estimate_motion": "groma.estimators.motion.estimation",
    "evaluate_lines": "groma.evaluation.lines",
    "evaluate_planes": "groma.evaluation.planes",
    "evaluate_poses": "groma.evaluation.poses",
    "evaluate_trajectory": "groma.evaluation.trajectory:score_trajectory",
    "factor": "groma.factors.user",
    "loss": "groma.factors.losses",
    "map_images": "groma.mapping.map",
    "open_sequence": "groma.io.sequences",
    "read_scene": "groma.io",
    "read_trajectory": "groma.io",
    "reliability": "groma.adjustment.survey.reliability",
    "solve": "groma.solver.solve",
    "track": "groma.tracking",
    "uncertainty": "groma.adjustment.uncertainty",
    "warm_up": "groma.compilation.warmup",
    "write_covariances": "groma.adjustment.covariance_files",
    "write_parts": "groma.adjustment.parts",
    "write_report": "groma.viz.report.page",
    "write_scene": "groma.io",
}
_SUBPACKAGES = (
    "adjustment",
    "cameras",
    "compilation",
    "errors",
    "estimators",
    "evaluation",
    "factors",
    "features",
    "geometry",
    "io",
    "localization",
    "mapping",
    "problem",
    "scene",
    "solver",
    "testing",
    "tracking",
    "viz",
)

__all__ = [
    "AbsolutePose",
    "AdjustOptions",
    "AdjustResult",
    "Alignment",
    "FileFormatError",
    "GromaError",
    "InputError",
    "LandmarkMatches",
    "LineBearing",
    "LineOnPlane",
    "LineReprojection",
    "LocalizeOptions",
    "LocalizedImage",
    "Localizer",
    "MapOptions",
    "MapResult",
    "Motion",
    "MotionOptions",
    "OutputError",
    "PlaneObservation",
    "PointOnPlane",
    "PointReprojection",
    "PoseGraphOptions",
    "PoseGraphResult",
    "PoseOptions",
    "PosePrior",
    "Problem",
    "ProblemError",
    "QueryCamera",
    "Ref",
    "Reliability",
    "Scene",
    "ShapeError",
    "Similarity",
    "Solution",
    "SolveReport",
    "SolverOptions",
    "Survey",
    "SurveyedResult",
    "Termination",
    "TrackOptions",
    "TrackResult",
    "Tracker",
    "Variables",
    "adjust",
    "adjust_parts",
    "adjust_pose_graph",
    "adjust_surveyed",
    "adjustment",
    "align",
    "cameras",
    "compilation",
    "contributions",
    "convert",
    "diagnose",
    "errors",
    "estimate_absolute_pose",
    "estimate_motion",
    "estimators",
    "evaluate_lines",
    "evaluate_planes",
    "evaluate_poses",
    "evaluate_trajectory",
    "evaluation",
    "factor",
    "factors",
    "features",
    "geometry",
    "io",
    "localization",
    "loss",
    "map_images",
    "mapping",
    "open_sequence",
    "problem",
    "read_scene",
    "read_trajectory",
    "reliability",
    "scene",
    "solve",
    "solver",
    "testing",
    "track",
    "tracking",
    "uncertainty",
    "viz",
    "warm_up",
    "write_covariances",
    "write_parts",
    "write_report",
    "write_scene",
]


def __getattr__(name: str) -> object:
    if name in _HOME:
        module, _, name_there = _HOME[name].partition(":")
        value = getattr(import_module(module), name_there or name)
    elif name in _SUBPACKAGES:
        value = import_module(f"groma.{name}")
    else:
        raise AttributeError(f"module 'groma' has no attribute {name!r}. Public names: {', '.join(__all__)}.")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
