# SPDX-License-Identifier: BSD-3-Clause
"""groma: reconstruct and adjust scenes made of points, lines and planes.

The public names below are loaded when they are first used (PEP 562), so that ``import groma`` compiles nothing and
costs next to nothing. Sub-packages are reachable the same way: ``groma.geometry``, ``groma.cameras``,
``groma.factors``.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from groma import cameras, errors, evaluation, factors, geometry, io, pipelines, problem, scene, solver, testing
    from groma.errors import FileFormatError, GromaError, InputError, OutputError, ProblemError, ShapeError
    from groma.io import read_scene, write_scene
    from groma.pipelines.adjust import AdjustOptions, AdjustResult, adjust
    from groma.scene import Scene
    from groma.viz.report import write_report

__version__ = "0.1.0"

#: Where each public name lives; the only list to touch when one is added.
_HOME = {
    "AdjustOptions": "groma.pipelines.adjust",
    "AdjustResult": "groma.pipelines.adjust",
    "FileFormatError": "groma.errors",
    "GromaError": "groma.errors",
    "InputError": "groma.errors",
    "OutputError": "groma.errors",
    "ProblemError": "groma.errors",
    "Scene": "groma.scene",
    "ShapeError": "groma.errors",
    "adjust": "groma.pipelines.adjust",
    "read_scene": "groma.io",
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
)

__all__ = [
    "AdjustOptions",
    "AdjustResult",
    "FileFormatError",
    "GromaError",
    "InputError",
    "OutputError",
    "ProblemError",
    "Scene",
    "ShapeError",
    "adjust",
    "cameras",
    "errors",
    "evaluation",
    "factors",
    "geometry",
    "io",
    "pipelines",
    "problem",
    "read_scene",
    "scene",
    "solver",
    "testing",
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
