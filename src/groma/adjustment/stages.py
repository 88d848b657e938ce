# SPDX-License-Identifier: BSD-3-Clause
"""An adjustment under a sequence of losses: the factors of a stage, and one report of all."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from groma.adjustment.terms.lines import LINE_FACTORS
from groma.adjustment.terms.relations import RELATION_FACTORS
from groma.factors.contract import Factor
from groma.factors.losses import Cauchy, Loss
from groma.factors.losses import loss as make_loss
from groma.gates import gate
from groma.problem.lay_out import Layouts
from groma.problem.problem import Problem
from groma.solver.options import SolverOptions
from groma.solver.report import Iteration, SolveReport
from groma.solver.solve import solve

#: Scales of the losses of matches for relations between landmarks, in standard deviations of those.
RELATION_SCALES = {"cauchy": 2.0, "geman_mcclure": 4.0}
#: The loss of scenes with depths, stereo pairs or planes measured in the cameras, and that of their relations: each
#: measurement has a standard deviation of its own, and what does not belong was left out in tracking.
METRIC_LOSS, METRIC_RELATION_LOSS = Cauchy(2.0), Cauchy(1.0)


@dataclass(frozen=True)
class StageGates:
    """When one stage of an adjustment gives way to the next, and what the last one lets go of."""

    last_scale: float = gate(
        12.0, "sigma", "of the residuals before, the least scale of the last loss: a narrower one doubts good matches",
        "chosen on matches of photographs, whose tails are still right",
    )  # fmt: skip
    tolerance: float = gate(1e-2, "share", "fall of the cost at which a stage that is not the last ends", "cost: steps")
    restart_tolerance: float = gate(0.3, "share", "the same of least squares, before restarts", "cost: steps")
    metric_start: float = gate(1e-3, "share", "that a step promises, or a tracked scene stays", "derived from tracking")
    given_up: float = gate(0.05, "share", "of full weight, below which it was given up", "convention: of M-estimators")


#: The defaults.
STAGES = StageGates()

#: Factors that keep their own loss: measurements of other instruments.
OWN_LOSS = (
    "pose_prior", "position_prior", "vector_prior", "distance", "on_known_plane", "camera_direction", "known_direction",
)  # fmt: skip


def keeps_loss(factor: Factor) -> bool:
    """Tell whether a factor is of what other instruments measured, or of marks that it was measured at."""
    return factor.type_name in OWN_LOSS or any(ref.group == "control_points" for _, ref in factor.references())


def with_loss(
    problem: Problem, loss: Loss, relation_loss: Loss | None = None, line_loss_factor: float = 1.0
) -> Problem:
    """Return a problem under a loss; priors keep theirs.

    Relations between landmarks have a noise of their own, and a given loss or the plain scale. Segments have the same
    loss as points, with this multiple of its scale.
    """
    if relation_loss is None:
        relation_loss = make_loss(loss.name, RELATION_SCALES[loss.name]) if loss.name in RELATION_SCALES else loss
    line_loss = loss.scaled(line_loss_factor)

    def of(factor: Factor) -> Loss:
        if keeps_loss(factor):
            return factor.loss
        if factor.type_name in LINE_FACTORS:
            return line_loss
        return relation_loss if factor.type_name in RELATION_FACTORS else loss

    return problem.with_losses([of(factor) for factor in problem.factors])


def stage_entries(stages: list[Loss], reports: list[SolveReport]) -> tuple[dict[str, Any], ...]:
    """Return the entries of a report about the stages: loss, initial cost, and number of the first step."""
    entries, first_step = [], 1
    for loss, report in zip(stages, reports, strict=False):
        entries.append({"loss": loss.name, "initial_cost": report.initial_cost, "first_step": first_step})
        first_step += report.iterations
    return tuple(entries)


def combined(
    reports: list[SolveReport],
    start: Problem,
    stages: list[Loss],
    line_loss_factor: float = 1.0,
    layouts: Layouts | None = None,
) -> SolveReport:
    """Return one report of all stages: costs under the last loss, times and steps summed."""
    last = reports[-1]
    if len(reports) == 1:
        return last
    loss, first = stages[len(reports) - 1], reports[0]
    if loss != stages[0]:
        at_start = with_loss(start, loss, line_loss_factor=line_loss_factor)
        first = solve(at_start, SolverOptions(max_iterations=0), layouts=layouts).report
    return replace(one_after_another(reports), initial_cost=first.initial_cost, initial_costs=first.initial_costs)


def one_after_another(reports: list[SolveReport]) -> SolveReport:
    """Return the last report with the steps and the times of all."""
    history: list[Iteration] = []
    for report in reports:
        steps, seconds = len(history), history[-1].seconds if history else 0.0
        history += [
            replace(record, iteration=record.iteration + steps, seconds=record.seconds + seconds)
            for record in report.history
        ]
    seconds = {stage: sum(report.seconds.get(stage, 0.0) for report in reports) for stage in reports[-1].seconds}
    steps = sum(report.iterations for report in reports)
    return replace(reports[-1], iterations=steps, history=history, seconds=seconds)


def with_costs_at(report: SolveReport, problem: Problem, layouts: Layouts | None = None) -> SolveReport:
    """Return the report of a solve with the costs of a problem that was changed after it."""
    now = solve(problem, SolverOptions(max_iterations=0), layouts=layouts).report
    return replace(report, final_cost=now.final_cost, final_costs=now.final_costs)
