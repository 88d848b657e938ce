# SPDX-License-Identifier: BSD-3-Clause
"""Bundle adjustment of a scene: cameras, points, lines and planes together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, field, fields, replace
from typing import Any

import numpy as np

from groma._counted import counted
from groma._log import log_warnings, logger_of
from groma._typing import IntArray
from groma.adjustment.assemble import Assembly, assemble, disassemble
from groma.adjustment.assembly_options import SURFACE_SIGMA_PX, AssemblyOptions
from groma.adjustment.fit import noise_of
from groma.adjustment.misfit.calibration import refuse_focal_lengths
from groma.adjustment.misfit.lens import begin_lens_test
from groma.adjustment.misfit.rig import rig_that_does_not_fit
from groma.adjustment.misfit.turning import motion_that_may_be_turning
from groma.adjustment.moved_problem import problem_at
from groma.adjustment.outcome import drop_failed_relations, report_of
from groma.adjustment.pixel_residuals import squared_residuals_px
from groma.adjustment.report import AdjustReport, AdjustResult, Progress
from groma.adjustment.rescue.clusters import renew_clusters
from groma.adjustment.rescue.restart import renew_lines, with_seen_ends
from groma.adjustment.rescue.slips import without_slips
from groma.adjustment.stages import (
    METRIC_LOSS,
    METRIC_RELATION_LOSS,
    STAGES,
    combined,
    stage_entries,
    with_costs_at,
    with_loss,
)
from groma.adjustment.survey.best_fit import best_fitted
from groma.adjustment.terms.contract import Term
from groma.adjustment.terms.objects import with_held_states
from groma.adjustment.terms.principal_points import near_the_middle_if_guessed
from groma.errors import InputError, given_or_default
from groma.factors.losses import GemanMcClure, Loss, Trivial
from groma.factors.losses import loss as make_loss
from groma.problem.lay_out import Layouts
from groma.problem.problem import Problem
from groma.problem.residuals import Residuals
from groma.scene import Scene
from groma.scene.checks import check_scene_given
from groma.scene.local_frame import local_frame
from groma.solver.linear.blas import one_blas_thread
from groma.solver.options import SolverOptions
from groma.solver.report import Iteration, SolveReport
from groma.solver.solve import solve

_Progress = Callable[[Progress], bool | None] | None

#: The default for what comes from matching: first a loss that pulls from afar, then one that ignores what stayed far.
#: Losses by name and scale in pixels; see the page *How to choose* for the measurements behind them.
ROBUST_STAGES = (("cauchy", 1.0), ("geman_mcclure", 2.0))


@dataclass(frozen=True)
class AdjustOptions:
    """Options of :func:`adjust`. The defaults suit scenes from feature matches."""

    #: ``none``, ``huber``, ``soft_l1``, ``cauchy``, ``tukey``, ``geman_mcclure``, ``barron`` or ``truncated``;
    #: ``auto`` is none for BAL problems; Cauchy for scenes with depths, stereo pairs or planes measured in the cameras,
    #: as in tracking; else Cauchy and then Geman-McClure, because matches contain outliers.
    loss: str = "auto"
    #: Residual at which the loss stops being quadratic, in standard deviations (pixels by default); None: 1, and 2 in
    #: the second stage of ``auto``.
    loss_scale: float | None = None
    #: Scale of the loss of segments over that of points, as their residuals may have other tails.
    line_loss_factor: float = 1.0
    #: Estimate the camera poses; False adjusts the landmarks only.
    refine_poses: bool = True
    #: Change the model of all cameras first to a more general one: PINHOLE to OPENCV, for example. New parameters start
    #: at zero.
    camera_model: str | None = None
    #: Estimate focal lengths and distortion; None: of BAL problems, with ``camera_model``, and where none was given.
    refine_intrinsics: bool | None = None
    #: Estimate principal points too, if intrinsics are refined; None: those in the middle, which nobody measured.
    refine_principal_point: bool | None = None
    #: Estimate the poses of the cameras on their rigs.
    refine_rigs: bool = False
    #: Which landmarks are used. Without planes, directions and all relations with them are left out too.
    points: bool = True
    lines: bool = True
    planes: bool = True
    #: Common standard deviation of point observations and of segment end points, pixels; those of single observations
    #: in the scene are relative to it. Losses are scaled in these units.
    point_sigma_px: float = 1.0
    line_sigma_px: float = 1.0
    #: Correlation of the errors of both ends of a segment (:class:`groma.adjustment.assembly_options.AssemblyOptions`).
    line_end_correlation: float = 0.0
    #: How segments and measured planes are compared with landmarks: ``endpoints``, ``bearing`` or ``normal``, and
    #: ``normal_offset`` or ``quaternion``: see :class:`groma.adjustment.assembly_options.AssemblyOptions`.
    line_residual: str = "endpoints"
    plane_residual: str = "normal_offset"
    #: Terms of your own kinds of measurements: see :mod:`groma.adjustment.terms.contract`.
    terms: tuple[Term, ...] = ()
    #: Residual of relations between landmarks: ``metric`` or ``pixels``, and the standard deviation if metric.
    structure_form: str = "metric"
    structure_sigma_px: float = SURFACE_SIGMA_PX
    #: Use the relation of lines that meet: see :class:`groma.adjustment.assembly_options.AssemblyOptions`.
    meeting_lines: bool = False
    #: Maximum number of steps (cost: time; most solves end before).
    max_iterations: int = 50
    #: Stop when the cost falls by less than this fraction in a step.
    function_tolerance: float = 1e-6
    #: Keep the scene as it is if the first step promises to lower the cost by no more than this fraction. None: 1e-3,
    #: where tracking ends, for scenes with depths, stereo pairs or planes measured in the cameras under the loss
    #: ``auto``; else 0.
    start_tolerance: float | None = None
    #: ``auto``, ``dense``, ``sparse``, ``pcg``, or a solver that was registered.
    linear_solver: str = "auto"
    #: ``cartesian``, ``orthonormal_right``, ``orthonormal_left``, ``free_right`` or ``free_left``.
    line_chart: str = "cartesian"
    #: ``auto``, ``free`` or ``first_camera``: see :class:`groma.adjustment.assembly_options.AssemblyOptions`.
    gauge: str = "auto"
    #: Separate steps of each landmark after every joint step; None: 2 under a robust loss or with lines (1 where
    #: points are tied to lines and there is no loss), else 0.
    landmark_steps: int | None = None
    #: Test for unmodelled lens distortion in the residuals of points, and for rigs that do not fit, and warn.
    check_lens: bool = True
    #: Threads; None takes one for small problems and all cores for large ones.
    threads: int | None = None

    def __post_init__(self) -> None:
        for name in ("point_sigma_px", "line_sigma_px", "structure_sigma_px", "line_loss_factor"):
            if not 0.0 < getattr(self, name) < float("inf"):
                unit = " of pixels" if name.endswith("_px") else ""
                raise InputError(f"{name} must be a positive number{unit}; got {getattr(self, name)}.")


def adjust(
    scene: Scene, options: AdjustOptions | None = None, progress: Callable[[Progress], bool | None] | None = None
) -> AdjustResult:
    """Adjust cameras, points, lines and planes of a scene together.

    Parameters
    ----------
    scene
        The scene; not modified.
    options
        See :class:`AdjustOptions`.
    progress
        Called after every step; return False to stop with the best state so far.

    Returns
    -------
    AdjustResult
        A new scene and a report.

    Raises
    ------
    InputError
        If the scene has nothing to adjust, or an option is not known.
    """
    options = given_or_default(options, AdjustOptions)
    check_scene_given(scene)
    refuse_focal_lengths(scene)
    if options.camera_model is not None:
        scene, options = _in_model(scene, options, options.camera_model, progress)
    scene = near_the_middle_if_guessed(scene, options.refine_intrinsics, options.refine_principal_point)
    with one_blas_thread():
        if (near := local_frame(scene)) is None:
            return _adjusted_at_best_fit(scene, options, progress)
        result = _adjusted_at_best_fit(scene.transformed(near), options, progress)
    back = result.scene.transformed(near.inverse())
    return replace(result, scene=back, problem=result.problem and problem_at(result.problem, back))


def _adjusted_at_best_fit(scene: Scene, options: AdjustOptions, progress: _Progress) -> AdjustResult:
    """Adjust a scene that is first and last moved to where measured places and poses known beforehand fit best."""
    if not options.refine_poses:
        return _adjusted(scene, options, progress)
    result = _adjusted(best_fitted(scene), options, progress)
    if (after := best_fitted(result.scene)) is result.scene:
        return result
    return replace(result, scene=after, problem=result.problem and problem_at(result.problem, after, shifted=False))


def _in_model(scene: Scene, options: AdjustOptions, name: str, progress: _Progress) -> tuple[Scene, AdjustOptions]:
    """Return the scene with its cameras in another model, and the options to adjust it with.

    Segments are turned into rays before a solve, so points settle what they need to know of the lens.
    """
    scene = scene.replace(cameras=scene.cameras.with_model(name))
    refine = True if options.refine_intrinsics is None else options.refine_intrinsics
    options = replace(options, camera_model=None, refine_intrinsics=refine)
    if refine and options.points and options.lines and scene.num_line_observations and scene.num_point_observations:
        of_points = replace(options, lines=False, planes=False)
        scene = scene.replace(cameras=adjust(scene, of_points, progress).scene.cameras)
    return scene, options


class _StageProgress:
    """Passes on the steps of one stage, and says after each whether to go on: if ``patient`` also after a refused one.

    Steps are counted from the ``spent`` ones of the stages before.
    """

    def __init__(self, spent: int, most: int, patient: bool, progress: _Progress) -> None:
        self.spent, self.most, self.patient, self.progress = spent, most, patient, progress
        self.is_stopped = False

    def __call__(self, record: Iteration) -> bool:
        event = Progress(self.spent + record.iteration, self.most, record.cost)
        logger_of("adjustment").debug("step %d of at most %d, cost %.6g", *astuple(event))
        if self.progress is not None and self.progress(event) is False:
            self.is_stopped = True
        return not self.is_stopped and (record.accepted or self.patient)


@dataclass
class _Solving:
    """A problem and what its stages did so far."""

    problem: Problem
    losses: list[Loss]
    reports: list[SolveReport] = field(default_factory=list)
    #: Lines that were restarted after a stage.
    restarted: list[IntArray] = field(default_factory=list)
    layouts: Layouts = field(default_factory=Layouts)

    def take(self, problem: Problem, lines: IntArray) -> None:
        """Go on with a problem in which some lines were restarted."""
        self.problem, restarted = with_held_states(self.problem, problem, lines)
        self.restarted.append(restarted)


def _solve_stages(scene: Scene, options: AdjustOptions, assembly: Assembly, progress: _Progress) -> _Solving:
    """Solve with one loss after the other, and restart lines in wrong minima between them."""
    solving, relation_loss = _Solving(assembly.problem, losses_of(scene, options)), relation_loss_of(scene, options)
    reports, layouts = solving.reports, solving.layouts
    for number, loss in enumerate(solving.losses):
        last = number + 1 == len(solving.losses)
        spent = sum(report.iterations for report in reports)
        solver_options = SolverOptions(
            max_iterations=options.max_iterations - spent,
            function_tolerance=options.function_tolerance if last else stage_tolerance(loss),
            start_tolerance=start_tolerance_of(scene, options),
            linear_solver=options.linear_solver,
            landmark_steps=_landmark_steps(options, loss, solving.problem),
            landmark_groups=("lines",) if isinstance(loss, Trivial) and not _is_coupled(solving.problem) else None,
            initial_damping=damping_after(reports, loss),
            threads=options.threads,
        )
        steps = _StageProgress(spent, options.max_iterations, last or not isinstance(loss, Trivial), progress)
        if last and number:
            loss = solving.losses[number] = _wide_enough(loss, replace(assembly, problem=solving.problem))
        under_loss = with_loss(solving.problem, loss, relation_loss, options.line_loss_factor)
        solution = solve(under_loss, solver_options, steps, layouts)
        solving.problem = solution.problem
        reports.append(solution.report)
        if steps.is_stopped:
            break
        if options.max_iterations and not last:
            solving.take(*renew_lines(scene, solving.problem, options.threads))
            solving.take(*renew_clusters(scene, solving.problem, options.threads))
        if not isinstance(loss, Trivial) and solution.report.iterations:
            solving.take(*without_slips(solving.problem, options.threads))
            if last and solving.problem is not solution.problem:
                reports[-1] = with_costs_at(reports[-1], solving.problem, layouts)
    return solving


def _adjusted(scene: Scene, options: AdjustOptions, progress: _Progress) -> AdjustResult:
    """Adjust a scene that is near the origin of its world."""
    last_loss, relation_loss = losses_of(scene, options)[-1], relation_loss_of(scene, options)
    assembly = assemble(scene, assembly_options_of(scene, options, last_loss, relation_loss), options.terms)
    if not assembly.problem.factors:
        raise InputError(_nothing_to_adjust(scene))
    solved = _solve_stages(scene, options, assembly, progress)
    problem, reports, losses = solved.problem, solved.reports, solved.losses
    residuals = Residuals(problem)
    lens = begin_lens_test(problem, options.threads, residuals) if options.check_lens else None
    report = combined(reports, assembly.problem, losses, options.line_loss_factor, solved.layouts)
    adjusted, relations = drop_failed_relations(disassemble(scene, problem), problem)
    if any(map(len, solved.restarted)):
        adjusted = with_seen_ends(adjusted, np.unique(np.concatenate(solved.restarted)))
    outcome = report_of(scene, assembly, problem, report, relations, stage_entries(losses, reports), residuals)
    if lens is not None:
        rig = rig_that_does_not_fit(scene, problem, options.threads)
        free = options.refine_poses and options.refine_intrinsics
        found = (shown := lens()) and shown.sentence, rig, motion_that_may_be_turning(adjusted, free, outcome.inliers)
        outcome = replace(outcome, warnings=(*outcome.warnings, *filter(None, found)))
    _log(outcome)
    return AdjustResult(adjusted, outcome, problem)


def _nothing_to_adjust(scene: Scene) -> str:
    start = f"There is nothing to adjust: the scene has {counted(scene.num_images, 'images')}"
    if not scene.num_point_observations and not scene.num_line_observations:
        return (
            f"{start} and no observations of points or lines. groma map PHOTOGRAPHS --poses FILE finds them at the "
            "poses of a file."
        )
    return (
        f"{start}, {scene.num_point_observations:,} point and {scene.num_line_observations:,} line observations, and "
        "the options leave none of them. Check the input and --no-points / --no-lines."
    )


def _log(outcome: AdjustReport) -> None:
    images, observations = counted(outcome.num_images, "images"), counted(outcome.num_observations, "observations")
    cost, steps = (outcome.solve.initial_cost, outcome.solve.final_cost), counted(outcome.solve.iterations, "steps")
    logger_of("adjustment").info("%s, %s: cost %.5g -> %.5g, %s", images, observations, *cost, steps)
    log_warnings("adjustment", outcome.warnings)


def losses_of(scene: Scene, options: AdjustOptions) -> list[Loss]:
    """Return the sequence of losses to solve with."""
    if options.loss == "none" or (options.loss == "auto" and set(scene.cameras.models) == {"BAL"}):
        with_lines = options.lines and scene.num_line_observations > 0
        return [Trivial(), Trivial()] if with_lines else [Trivial()]
    if options.loss == "auto":
        scale = 1.0 if options.loss_scale is None else options.loss_scale
        if scene.is_metric:
            return [replace(METRIC_LOSS, scale=METRIC_LOSS.scale * scale)]
        return [make_loss(name, scale * factor) for name, factor in ROBUST_STAGES]
    return [make_loss(options.loss, 1.0 if options.loss_scale is None else options.loss_scale)]


def relation_loss_of(scene: Scene, options: AdjustOptions) -> Loss | None:
    """Return the loss of relations between landmarks, if it does not follow from that of the observations."""
    return METRIC_RELATION_LOSS if options.loss == "auto" and scene.is_metric else None


def start_tolerance_of(scene: Scene, options: AdjustOptions) -> float:
    """Return what the first step must promise for it to be taken."""
    if options.start_tolerance is not None:
        return options.start_tolerance
    return STAGES.metric_start if options.loss == "auto" and scene.is_metric else 0.0


def _wide_enough(loss: Loss, assembly: Assembly) -> Loss:
    """Return the loss, widened if the residuals are noisier than its scale suggests."""
    if not isinstance(loss, GemanMcClure):
        return loss
    squares = squared_residuals_px(assembly, weighted=True)
    sigma = np.nan_to_num(noise_of(np.concatenate(list(squares.values())))) if squares else 0.0
    return replace(loss, scale=max(loss.scale, STAGES.last_scale * float(sigma)))


def stage_tolerance(loss: Loss) -> float:
    """Return the relative decrease of the cost at which a stage that is not the last ends.

    The first stage of plain least squares with lines also ends at the first step that is refused: mostly a single line
    in a wrong minimum is to blame.
    """
    return STAGES.restart_tolerance if isinstance(loss, Trivial) else STAGES.tolerance


def damping_after(reports: list[SolveReport], loss: Loss) -> float | None:
    """Plain least squares keeps the last damping; another loss starts with the initial one."""
    if not reports or not reports[-1].history or not isinstance(loss, Trivial):
        return None
    return reports[-1].history[-1].damping


def _landmark_steps(options: AdjustOptions, loss: Loss, problem: Problem) -> int:
    """Lines and robust losses leave a long tail of small joint steps; a few cheap steps of landmarks cut it short."""
    if options.landmark_steps is not None:
        return options.landmark_steps
    if isinstance(loss, Trivial) and "lines" not in problem.variables:
        return 0
    return 1 if isinstance(loss, Trivial) and _is_coupled(problem) else 2


def _is_coupled(problem: Problem) -> bool:
    """Whether points are tied to lines. Lines are then not eliminated, and long steps tear points off their lines and
    planes by the product of two displacements, which is much where ties are tight: points take the steps of their own.
    """
    return any(factor.type_name in ("point_on_line", "lines_meeting") for factor in problem.factors)


def assembly_options_of(
    scene: Scene, options: AdjustOptions, loss: Loss, relation_loss: Loss | None
) -> AssemblyOptions:
    """Return the options of the assembly: those of the same name, and what follows from the scene and the stage."""
    is_bal = set(scene.cameras.models) == {"BAL"}
    shared = {item.name for item in fields(AssemblyOptions)} & {item.name for item in fields(options)}
    chosen: dict[str, Any] = {name: getattr(options, name) for name in shared}
    if is_bal and options.refine_intrinsics is None:
        chosen["refine_intrinsics"] = True
    return AssemblyOptions(**chosen | {"loss": loss, "relation_loss": relation_loss, "drop_behind": not is_bal})
