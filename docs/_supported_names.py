# SPDX-License-Identifier: BSD-3-Clause
"""The page of supported names: ``python docs/_supported_names.py`` writes it anew from the lists here and the code."""

import importlib
import inspect
from functools import cache
from pathlib import Path
from types import ModuleType

PAGE = Path(__file__).with_name("supported-names.md")
#: Title, modules and what is supported of each: all that is public in it, or some names.
Rooms = tuple[tuple[str, dict[str, tuple[str, ...] | None]], ...]
ROOMS: Rooms = (
    ("What most users need", {"groma": None}),
    (
        "Geometry",
        {
            "groma.geometry": None,
            "groma.geometry.line3": None,
            "groma.geometry.plane3": None,
            "groma.geometry.segment2": None,
            "groma.geometry.segment3": None,
            "groma.geometry.transform": None,
            "groma.geometry.projection": None,
            "groma.geometry.incidence": None,
            "groma.geometry.line_orders": None,
            "groma.geometry.quaternion": None,
            "groma.geometry.so3": None,
            "groma.geometry.se3": None,
            "groma.geometry.sim3": None,
            "groma.geometry.conversions": None,
            "groma.geometry.charts.line_charts": None,
            "groma.geometry.charts.plane_charts": None,
            "groma.geometry.charts.pose_charts": None,
            "groma.geometry.charts.similarity": None,
            "groma.geometry.charts.unit3": ("DIRECTION_CHARTS", "Unit3"),
            "groma.geometry.charts.point3": ("POINT_CHARTS", "from_homogeneous", "to_homogeneous"),
        },
    ),
    ("Cameras", {"groma.cameras": None}),
    ("Factors and losses", {"groma.factors": None}),
    (
        "Problem and solver",
        {
            "groma.problem.problem": ("Problem",),
            "groma.problem.variables": ("Variables",),
            "groma.problem.residuals": None,
            "groma.solver.solve": ("Solution", "solve"),
            "groma.solver.options": ("SolverOptions",),
            "groma.solver.report": ("Iteration", "SolveReport"),
            "groma.solver.termination": ("Termination",),
            "groma.solver.reduce.mpi": ("Ranks",),
            "groma.solver.covariance.marginals": ("Covariances", "Derived"),
            "groma.solver.covariance.quantities": None,
            "groma.solver.observability.diagnosis": None,
        },
    ),
    (
        "Scenes",
        {
            "groma.scene": None,
            "groma.scene.pose_graph": None,
            "groma.scene.synthetic": None,
            "groma.scene.counts": None,
        },
    ),
    (
        "Files",
        {
            "groma.io": None,
            "groma.io.sequences": None,
            "groma.io.reference": None,
            "groma.io.geometry": None,
            "groma.io.survey": None,
        },
    ),
    ("Features", {"groma.features": None, "groma.features.contract": None}),
    (
        "Estimates",
        {
            "groma.estimators.line_triangulation": None,
            "groma.estimators.directions": None,
            "groma.estimators.plane_fit": None,
            "groma.estimators.plane_search": ("PlaneOptions", "PlaneSearch", "PlaneSet", "find_planes"),
            "groma.estimators.motion.matches": ("LandmarkMatches",),
            "groma.estimators.motion.estimation": ("Motion", "MotionOptions", "estimate_motion"),
        },
    ),
    (
        "Adjustment",
        {
            "groma.adjustment.report": ("AdjustReport", "AdjustResult", "Progress"),
            "groma.adjustment.assemble": ("AssemblyOptions", "assemble", "disassemble"),
            "groma.adjustment.contributions": ("Contribution", "contributions"),
            "groma.adjustment.uncertainty": ("SceneUncertainty", "uncertainty"),
            "groma.adjustment.covariance_files": None,
            "groma.adjustment.consistency": None,
            "groma.adjustment.graphs.similarity_graph": None,
            "groma.adjustment.parts": ("PartsResult", "adjust_parts", "join_parts", "write_parts"),
        },
    ),
    (
        "Mapping and tracking",
        {
            "groma.mapping.map": ("map_images",),
            "groma.mapping.options": ("MapOptions",),
            "groma.mapping.result": ("MapResult",),
            "groma.mapping.lines.build": ("LineMap", "MapLinesOptions", "map_lines"),
            "groma.mapping.structure.find": ("StructureOptions", "find_structure"),
            "groma.tracking": None,
        },
    ),
    (
        "Localisation",
        {
            "groma.localization.pose.absolute_pose": ("AbsolutePose", "PoseOptions", "estimate_absolute_pose"),
            "groma.localization.pose.camera": ("QueryCamera",),
            "groma.localization.localizer": ("LocalizeOptions", "LocalizedImage", "Localizer"),
        },
    ),
    (
        "Evaluation",
        {
            "groma.evaluation": None,
            "groma.evaluation.cabinet": ("evaluate_cabinet", "folder"),
            "groma.evaluation.trajectory": ("Spread", "TrajectoryScores", "associate", "score_trajectory"),
        },
    ),
    (
        "Pages and viewer",
        {
            "groma.viz.report.page": ("PageContents", "write_report"),
            "groma.viz.report.trajectory": ("write_track_report",),
            "groma.viz.viewer.scene": ("open_viewer",),
        },
    ),
    ("Checks for parts of your own", {"groma.testing": None}),
)

HEAD = """# Supported names

These names keep their meaning; a rename leaves a message with the new name. What is not on this page, public or
not, may change without notice. The page is written from the code (`python docs/_supported_names.py`), and a test
compares them.
"""


def public_names(module: ModuleType) -> tuple[str, ...]:
    """Return ``__all__``, or the public functions and classes that a module defines."""
    if hasattr(module, "__all__"):
        return tuple(name for name in module.__all__ if not inspect.ismodule(getattr(module, name)))
    return tuple(
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and (inspect.isfunction(value) or inspect.isclass(value))
        and value.__module__ == module.__name__
    )


@cache
def supported() -> dict[str, tuple[str, ...]]:
    """Return the supported names of each module."""
    found = {}
    for _, modules in ROOMS:
        for name, chosen in modules.items():
            found[name] = tuple(sorted(public_names(importlib.import_module(name)) if chosen is None else chosen))
    return found


def page() -> str:
    """Return the page."""
    names, text = supported(), HEAD
    for title, modules in ROOMS:
        text += f"\n## {title}\n"
        text += "".join(
            f"\n{{mod}}`{name}`\n: {', '.join(f'`{found}`' for found in names[name])}\n" for name in modules
        )
    return text


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
