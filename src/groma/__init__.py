# SPDX-License-Identifier: BSD-3-Clause
"""groma: reconstruct and adjust scenes made of points, lines and planes.

The public names below are loaded when they are first used (PEP 562), so that ``import groma`` compiles nothing and
costs next to nothing. Sub-packages are reachable the same way: ``groma.geometry``, ``groma.cameras``,
``groma.factors``.
"""

import zlib as _zlib  # noqa: F401  (before pycolmap, whose library hides Python's own deflate and breaks it)

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

#: Public names by the module that they live in, and the names of two there; with ``__all__`` and the imports above the
#: only place to touch when one is added.
_NAMES = {
    "adjustment.adjust": "AdjustOptions adjust",
    "adjustment.contributions": "contributions",
    "adjustment.covariance_files": "write_covariances",
    "adjustment.diagnosis": "diagnose",
    "adjustment.graphs.pose_graph": "PoseGraphOptions PoseGraphResult adjust_pose_graph",
    "adjustment.parts": "adjust_parts write_parts",
    "adjustment.report": "AdjustResult",
    "adjustment.survey.align": "Alignment align",
    "adjustment.survey.given": "Survey",
    "adjustment.survey.records": "Reliability",
    "adjustment.survey.reliability": "reliability",
    "adjustment.uncertainty": "uncertainty",
    "compilation.warmup": "warm_up",
    "errors": "FileFormatError GromaError InputError OutputError ProblemError ShapeError",
    "estimators.motion.estimation": "Motion MotionOptions estimate_motion",
    "estimators.motion.matches": "LandmarkMatches",
    "evaluation.lines": "evaluate_lines",
    "evaluation.planes": "evaluate_planes",
    "evaluation.poses": "evaluate_poses",
    "evaluation.trajectory": "evaluate_trajectory",
    "factors.contract": "Ref",
    "factors.losses": "loss",
    "factors.observations.line_bearing": "LineBearing",
    "factors.observations.line_reprojection": "LineReprojection",
    "factors.observations.plane_observation": "PlaneObservation",
    "factors.observations.point_reprojection": "PointReprojection",
    "factors.priors.pose_prior": "PosePrior",
    "factors.relations.line_on_plane": "LineOnPlane",
    "factors.relations.point_on_plane": "PointOnPlane",
    "factors.user": "factor",
    "io": "read_scene read_trajectory write_scene",
    "io.convert": "convert",
    "io.sequences": "open_sequence",
    "localization.localizer": "LocalizeOptions LocalizedImage Localizer",
    "localization.pose.absolute_pose": "AbsolutePose PoseOptions estimate_absolute_pose",
    "localization.pose.camera": "QueryCamera",
    "mapping.map": "MapOptions map_images",
    "mapping.result": "MapResult",
    "mapping.surveyed": "SurveyedResult adjust_surveyed",
    "problem.problem": "Problem",
    "problem.variables": "Variables",
    "scene": "Scene Similarity",
    "solver.options": "SolverOptions",
    "solver.report": "SolveReport",
    "solver.solve": "Solution solve",
    "solver.termination": "Termination",
    "tracking": "TrackOptions TrackResult Tracker track",
    "viz.report.page": "write_report",
}
_HOME = {name: f"groma.{module}" for module, names in _NAMES.items() for name in names.split()}
_RENAMED = {"diagnose": "diagnose_scene", "evaluate_trajectory": "score_trajectory"}

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
_SUBPACKAGES = set(__all__) - _HOME.keys()


def __getattr__(name: str) -> object:
    from importlib import import_module  # not before: a command answers Ctrl-C once this file is loaded

    if name in _HOME:
        value = getattr(import_module(_HOME[name]), _RENAMED.get(name, name))
    elif name in _SUBPACKAGES:
        value = import_module(f"groma.{name}")
    else:
        raise AttributeError(f"module 'groma' has no attribute {name!r}. Public names: {', '.join(__all__)}.")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
