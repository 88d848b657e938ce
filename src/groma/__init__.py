# SPDX-License-Identifier: BSD-3-Clause
"""groma: reconstruct and adjust scenes made of points, lines and planes.

The public names below are loaded when they are first used (PEP 562), so that ``import groma`` compiles nothing and
costs next to nothing. Sub-packages are reachable the same way: ``groma.geometry``, ``groma.cameras``,
``groma.factors``.
"""

import zlib as _zlib  # noqa: F401  (before pycolmap, whose library hides Python's own deflate and breaks it)
from importlib import import_module
from typing import TYPE_CHECKING

from groma._version import __version__ as __version__

if TYPE_CHECKING:
    from groma import (
        cameras,
        errors,
        estimators,
        evaluation,
        factors,
        frontend,
        geometry,
        io,
        pipelines,
        problem,
        scene,
        solver,
        testing,
        tracking,
        viz,
    )
    from groma.errors import FileFormatError, GromaError, InputError, OutputError, ProblemError, ShapeError
    from groma.factors._factor import Ref
    from groma.factors.line_bearing import LineBearing
    from groma.factors.line_on_plane import LineOnPlane
    from groma.factors.line_reprojection import LineReprojection
    from groma.factors.losses import loss
    from groma.factors.plane_observation import PlaneObservation
    from groma.factors.point_on_plane import PointOnPlane
    from groma.factors.point_reprojection import PointReprojection
    from groma.factors.pose_prior import PosePrior
    from groma.factors.user import factor
    from groma.io import read_scene, write_scene
    from groma.pipelines.adjust import AdjustOptions, AdjustResult, adjust
    from groma.pipelines.adjust_parts import adjust_parts, write_parts
    from groma.pipelines.diagnosis import diagnose_scene as diagnose
    from groma.pipelines.map import MapOptions, map_images
    from groma.pipelines.pose_graph import PoseGraphOptions, adjust_pose_graph
    from groma.pipelines.uncertainty import uncertainty
    from groma.problem.problem import Problem
    from groma.problem.variables import Variables
    from groma.scene import Scene
    from groma.solver.options import SolverOptions
    from groma.solver.report import SolveReport
    from groma.solver.solve import Solution, solve
    from groma.solver.termination import Termination
    from groma.tracking import Tracker, TrackOptions
    from groma.viz.report import write_report

#: Where each public name lives, and after a colon its name there if that is another; with ``__all__`` and the imports
#: above the only place to touch when one is added.
_HOME = {
    "AdjustOptions": "groma.pipelines.adjust",
    "AdjustResult": "groma.pipelines.adjust",
    "FileFormatError": "groma.errors",
    "GromaError": "groma.errors",
    "InputError": "groma.errors",
    "LineBearing": "groma.factors.line_bearing",
    "LineOnPlane": "groma.factors.line_on_plane",
    "LineReprojection": "groma.factors.line_reprojection",
    "MapOptions": "groma.pipelines.map",
    "OutputError": "groma.errors",
    "PlaneObservation": "groma.factors.plane_observation",
    "PointOnPlane": "groma.factors.point_on_plane",
    "PointReprojection": "groma.factors.point_reprojection",
    "PoseGraphOptions": "groma.pipelines.pose_graph",
    "PosePrior": "groma.factors.pose_prior",
    "Problem": "groma.problem.problem",
    "ProblemError": "groma.errors",
    "Ref": "groma.factors._factor",
    "Scene": "groma.scene",
    "ShapeError": "groma.errors",
    "Solution": "groma.solver.solve",
    "SolveReport": "groma.solver.report",
    "SolverOptions": "groma.solver.options",
    "Termination": "groma.solver.termination",
    "TrackOptions": "groma.tracking",
    "Tracker": "groma.tracking",
    "Variables": "groma.problem.variables",
    "adjust": "groma.pipelines.adjust",
    "adjust_parts": "groma.pipelines.adjust_parts",
    "adjust_pose_graph": "groma.pipelines.pose_graph",
    "diagnose": "groma.pipelines.diagnosis:diagnose_scene",
    "factor": "groma.factors.user",
    "loss": "groma.factors.losses",
    "map_images": "groma.pipelines.map",
    "read_scene": "groma.io",
    "solve": "groma.solver.solve",
    "uncertainty": "groma.pipelines.uncertainty",
    "write_parts": "groma.pipelines.adjust_parts",
    "write_report": "groma.viz.report",
    "write_scene": "groma.io",
}
_SUBPACKAGES = (
    "cameras",
    "errors",
    "estimators",
    "evaluation",
    "factors",
    "frontend",
    "geometry",
    "io",
    "pipelines",
    "problem",
    "scene",
    "solver",
    "testing",
    "tracking",
    "viz",
)

__all__ = [
    "AdjustOptions",
    "AdjustResult",
    "FileFormatError",
    "GromaError",
    "InputError",
    "LineBearing",
    "LineOnPlane",
    "LineReprojection",
    "MapOptions",
    "OutputError",
    "PlaneObservation",
    "PointOnPlane",
    "PointReprojection",
    "PoseGraphOptions",
    "PosePrior",
    "Problem",
    "ProblemError",
    "Ref",
    "Scene",
    "ShapeError",
    "Solution",
    "SolveReport",
    "SolverOptions",
    "Termination",
    "TrackOptions",
    "Tracker",
    "Variables",
    "adjust",
    "adjust_parts",
    "adjust_pose_graph",
    "cameras",
    "diagnose",
    "errors",
    "estimators",
    "evaluation",
    "factor",
    "factors",
    "frontend",
    "geometry",
    "io",
    "loss",
    "map_images",
    "pipelines",
    "problem",
    "read_scene",
    "scene",
    "solve",
    "solver",
    "testing",
    "tracking",
    "uncertainty",
    "viz",
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
