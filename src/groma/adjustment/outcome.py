# SPDX-License-Identifier: BSD-3-Clause
"""What an adjustment did: its report, and the relations that it found to be wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.adjustment.assemble import Assembly
from groma.adjustment.fit import inliers, noise_of
from groma.adjustment.misfit.calibration import doubtful_cameras
from groma.adjustment.pixel_residuals import redundancy_of, squared_residuals_px
from groma.adjustment.report import AdjustReport, not_converged
from groma.adjustment.stages import STAGES
from groma.adjustment.terms.relations import RELATION_FACTORS
from groma.factors.losses import Trivial
from groma.problem.problem import Problem
from groma.problem.residuals import Residuals, squared_norms
from groma.scene import Scene
from groma.solver.report import SolveReport

#: Terms that a report counts among the observations, and among the relations; and what was not measured.
COUNTED_OTHERWISE = (
    "point observations", "line observations", "relations", "relations in pixels", "principal points", "held scale",
)  # fmt: skip


def drop_failed_relations(scene: Scene, problem: Problem) -> tuple[Scene, dict[str, dict[str, int]]]:
    """Return the scene without the relations that a robust loss gave up, and how many of each kind held and failed.

    Parameters
    ----------
    scene : Scene
        The adjusted scene.
    problem : Problem
        The problem at its solution; relations as distances, in the order of the scene.
    """
    relations, outcome = scene.relations, {}
    for factor in problem.factors:
        name = RELATION_FACTORS.get(factor.type_name)
        if name is None or len(factor) != len(getattr(relations, name)):
            continue
        failed: BoolArray = np.zeros(len(factor), dtype=bool)
        if not isinstance(factor.loss, Trivial):
            squared = squared_norms(factor, problem.variables)
            failed = np.asarray(factor.loss.evaluate(squared)[1] < STAGES.given_up)
        outcome[name] = {"held": int((~failed).sum()), "dropped": int(failed.sum())}
        if failed.any():
            relations = relations.take(**{name: ~failed})
    return (scene.replace(relations=relations) if relations is not scene.relations else scene), outcome


def report_of(
    scene: Scene,
    assembly: Assembly,
    problem: Problem,
    report: SolveReport,
    relations: dict[str, dict[str, int]],
    stages: tuple[dict[str, Any], ...],
    residuals: Residuals,
) -> AdjustReport:
    """Say in numbers what an adjustment did: from the problem of the assembly to the one that was solved."""
    now, redundancy = replace(assembly, problem=problem), redundancy_of(assembly)
    before, after = squared_residuals_px(assembly), squared_residuals_px(now, residuals=residuals)
    counts, start = assembly.num_measurements, assembly.problem.variables
    return AdjustReport(
        num_images=scene.num_images,
        num_points=scene.num_points if "points" in start else 0,
        num_lines=scene.num_lines if "lines" in start else 0,
        num_planes=scene.num_planes if "planes" in start else 0,
        num_observations=sum(len(group.factor) for group in assembly.groups if group.observes),
        num_measurements={name: count for name, count in counts.items() if name not in COUNTED_OTHERWISE},
        rmse_px={kind: {"before": _rms(before[kind]), "after": _rms(after[kind])} for kind in before},
        inliers=inliers(before, after, redundancy),
        sigma0=_sigma0(squared_residuals_px(now, weighted=True, residuals=residuals), redundancy),
        solve=report,
        relations=relations,
        stages=stages,
        warnings=(*doubtful_cameras(scene), *assembly.notes, *not_converged(report), *report.warnings),
    )


def _rms(squares: FloatArray) -> float:
    return float(np.sqrt(np.mean(squares)))


def _sigma0(squares: dict[str, FloatArray], redundancy: dict[str, FloatArray]) -> float | None:
    """Return the noise that the observations show, in units of the noise that was stated."""
    joined = [np.concatenate([np.zeros(0), *(part[kind] for kind in squares)]) for part in (squares, redundancy)]
    sigma = noise_of(*joined)
    return sigma if np.isfinite(sigma) else None
