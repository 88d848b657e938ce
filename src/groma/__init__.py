# SPDX-License-Identifier: BSD-3-Clause
"""groma: reconstruct and adjust scenes made of points, lines and planes.

The public names below are loaded when they are first used (PEP 562), so that ``import groma`` compiles nothing and
costs next to nothing. Sub-packages are reachable the same way: ``groma.geometry``, ``groma.cameras``,
``groma.factors``.
"""

import zlib as _zlib  # noqa: F401  (before pycolmap, whose library hides Python's own deflate and breaks it)

from groma._version import __version__ as __version__

#: Public names by the module that they live in; two have other names there. Type checkers read ``__init__.pyi``.
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
    "mapping.map": "map_images",
    "mapping.options": "MapOptions",
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

#: Sub-packages, and modules, that are loaded in the same way.
_SUBPACKAGES = frozenset(
    (
        "adjustment cameras compilation errors estimators evaluation factors features geometry io localization mapping "
        "problem scene solver testing tracking viz"
    ).split()
)
__all__ = sorted([*_HOME, *_SUBPACKAGES])  # pyright: ignore[reportUnsupportedDunderAll]  (it reads the stub)


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
