# SPDX-License-Identifier: BSD-3-Clause
"""groma: reconstruct and adjust scenes made of points, lines and planes.

The public names below are loaded when they are first used (PEP 562), so that ``import groma`` compiles nothing and
costs next to nothing. Sub-packages are reachable the same way: ``groma.geometry``, ``groma.cameras``,
``groma.factors``.
"""

import zlib as _zlib  # noqa: F401  (before pycolmap, whose library hides Python's own deflate and breaks it)
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from groma import (
        cameras,
        errors,
        evaluation,
        factors,
        geometry,
        io,
        pipelines,
        problem,
        scene,
        solver,
        testing,
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
    from groma.problem.problem import Problem
    from groma.problem.variables import Variables
    from groma.scene import Scene
    from groma.solver.options import SolverOptions
    from groma.solver.report import SolveReport
    from groma.solver.solve import Solution, solve
    from groma.solver.termination import Termination
    from groma.viz.report import write_report

__version__ = "0.1.0"

#: Where each public name lives; with ``__all__`` and the imports above the only place to touch when one is added.
_HOME = {
    "AdjustOptions": "groma.pipelines.adjust",
    "AdjustResult": "groma.pipelines.adjust",
    "FileFormatError": "groma.errors",
    "GromaError": "groma.errors",
    "InputError": "groma.errors",
    "LineBearing": "groma.factors.line_bearing",
    "LineOnPlane": "groma.factors.line_on_plane",
    "LineReprojection": "groma.factors.line_reprojection",
    "OutputError": "groma.errors",
    "PlaneObservation": "groma.factors.plane_observation",
    "PointOnPlane": "groma.factors.point_on_plane",
    "PointReprojection": "groma.factors.point_reprojection",
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
    "Variables": "groma.problem.variables",
    "adjust": "groma.pipelines.adjust",
    "factor": "groma.factors.user",
    "loss": "groma.factors.losses",
    "read_scene": "groma.io",
    "solve": "groma.solver.solve",
    "write_report": "groma.viz.report",
    "write_scene": "groma.io",
}
_SUBPACKAGES = (
    "cameras",
    "errors",
    "evaluation",
    "factors",
    "geometry",
    "io",
    "pipelines",
    "problem",
    "scene",
    "solver",
    "testing",
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
    "OutputError",
    "PlaneObservation",
    "PointOnPlane",
    "PointReprojection",
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
    "Variables",
    "adjust",
    "cameras",
    "errors",
    "evaluation",
    "factor",
    "factors",
    "geometry",
    "io",
    "loss",
    "pipelines",
    "problem",
    "read_scene",
    "scene",
    "solve",
    "solver",
    "testing",
    "viz",
    "write_report",
    "write_scene",
]


def __getattr__(name: str) -> object:
    if name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
    elif name in _SUBPACKAGES:
        value = import_module(f"groma.{name}")
    else:
        raise AttributeError(f"module 'groma' has no attribute {name!r}. Public names: {', '.join(__all__)}.")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
