# SPDX-License-Identifier: BSD-3-Clause
"""Mapping as a command does it: run the stages, write the folder of results, say what came out.

NumPy, Numba and what needs them are imported inside the function, after everything that can be refused was refused.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from groma._counted import counted
from groma.cli.shared import output as _output
from groma.cli.shared.interrupt import INTERRUPTED
from groma.errors import OutputError

if TYPE_CHECKING:
    from groma.adjustment.adjust import AdjustOptions
    from groma.cli.shared.console import Console
    from groma.factors.losses import Loss
    from groma.features.external import ExternalMatches
    from groma.mapping.map import MapOptions, MapResult
    from groma.scene import Scene
    from groma.solver.observability.diagnosis import Diagnosis


def map_and_write(
    console: Console,
    images: Path,
    output: Path,
    model: Scene | None,
    options: MapOptions,
    force: bool,
    title: str,
    *,
    line_matches: ExternalMatches | None = None,
    judge: Callable[[MapResult], dict[str, Any]] | None = None,
    explain: bool = True,
    diagnose: bool | None = None,
    contributions: bool = False,
    truth: Scene | None = None,
) -> dict[str, Any]:
    """Map a folder of photographs, write all results to ``output``, say what came out, and return the numbers.

    Parameters
    ----------
    console : Console
        Where progress and results are said.
    images, output : Path
        Folder of photographs, and the folder to write.
    model : Scene, optional
        Poses, cameras and points; reconstructed from the images if None.
    options : MapOptions
        Options of the pipeline.
    force : bool
        Replace ``output``.
    title : str
        Heading of the page.
    line_matches : ExternalMatches, optional
        Segments and matches from elsewhere.
    judge : callable, optional
        Given the result, returns further numbers for the summary.
    explain : bool
        Say what became of the segments, and what is not determined; otherwise only with --verbose.
    diagnose : bool, optional
        Say what the data determine; None: unless there are many images.
    contributions : bool
        Adjust by points alone, with lines, with planes, and say what each of them changes.
    truth : Scene, optional
        With ``contributions``: poses to compare with.
    """
    from groma.adjustment import contributions as find_contributions
    from groma.cli.shared.contributions import describe_contributions
    from groma.cli.shared.diagnosis import diagnosis_of, say_diagnosis
    from groma.cli.shared.interrupt import interruptible
    from groma.mapping.checkpoints import check_free, has_stages, remove_stages, system_reason
    from groma.mapping.map import map_images

    work = output.with_name(output.name + ".work")
    check_free(work)
    console.announce_compilation()
    if has_stages(work):
        console.say(f"Going on from the finished stages in {work}, as far as they fit.")
    try:
        with interruptible() as interruption, console.stages() as stages:
            result = map_images(images, work, model, options, interruption.checking(stages), line_matches)
    except KeyboardInterrupt:
        print(
            f"groma: interrupted; finished stages are kept in {work}: the same command goes on from there.",
            file=sys.stderr,
            flush=True,
        )
        raise typer.Exit(INTERRUPTED) from None
    diagnosis = diagnosis_of(result.scene, lambda: _diagnosis(result), console, diagnose)
    numbers: dict[str, Any] = _numbers(result) | {"diagnosis": diagnosis} | (judge(result) if judge is not None else {})
    if contributions:
        entries = find_contributions(result.before, result.adjusted_with, truth)
        numbers["contributions"] = [entry.to_dict() for entry in entries]
    try:
        with _output.atomic_output(output, force, work) as draft:
            _write_results(draft, result, numbers, images, title)
    except OutputError as error:
        raise OutputError(
            f"Cannot write {output}: {system_reason(error)}. Finished stages are kept in {work}: the same command goes "
            "on from there."
        ) from error
    remove_stages(work)
    for line in _sentences(result, console.verbose):
        console.say(line)
    for line in describe_contributions(numbers.get("contributions", [])):
        console.say(line)
    if explain or console.verbose:
        say_diagnosis(diagnosis, console)
    (console.say if explain else console.detail)(result.explanation)
    for sentence in result.warnings:
        console.warn(sentence)
    return numbers


def _write_results(folder: Path, result: MapResult, numbers: dict[str, Any], images: Path, title: str) -> None:
    """Write everything that the folder of a map holds."""
    from groma.io import write_geometry, write_scene
    from groma.viz.report.page import write_report
    from groma.viz.report.tables import contributions_card

    write_scene(result.scene, folder, format="colmap")
    write_scene(result.scene, folder / "scene.npz")
    write_geometry(result.scene, folder)
    write_report(
        folder / "report.html",
        result.before,
        result.scene,
        result.report,
        images,
        title,
        outcomes=result.outcomes,
        explanation=result.explanation,
        warnings=result.warnings,
        diagnosis=numbers["diagnosis"],
        cards=contributions_card(numbers.get("contributions")),
    )
    _output.write_json(str(folder / "summary.json"), numbers)


def _numbers(result: MapResult) -> dict[str, Any]:
    scene = result.scene
    return {
        **result.report.to_dict(),
        "num_images": scene.num_images,
        "num_points": scene.num_points,
        "num_lines": scene.num_lines,
        "num_planes": scene.num_planes,
        "num_directions": scene.num_directions,
        "sigma_px": result.sigma_px,
        "segments": result.outcomes,
        "explanation": result.explanation,
        "warnings": list(result.warnings),
    }


def _diagnosis(result: MapResult) -> Diagnosis:
    """Diagnose a map at the noise and with the loss of its last adjustment."""
    from groma.adjustment.assemble import AssemblyOptions, assemble
    from groma.adjustment.diagnosis import diagnose_scene
    from groma.adjustment.stages import with_loss
    from groma.problem.problem import Problem

    told = result.adjusted_with
    assembly = AssemblyOptions(
        point_sigma_px=told.point_sigma_px,
        line_sigma_px=told.line_sigma_px,
        line_end_correlation=told.line_end_correlation,
        structure_sigma_px=told.structure_sigma_px,
        refine_poses=told.refine_poses,
        refine_intrinsics=bool(told.refine_intrinsics),
    )
    problem, ended_with = assemble(result.scene, assembly).problem, last_loss(told)
    factors = [with_loss(factor, ended_with) for factor in problem.factors]
    return diagnose_scene(result.scene, problem=Problem(problem.variables, factors))


def last_loss(told: AdjustOptions) -> Loss:
    """Return the loss that an adjustment of photographs ends with."""
    from groma.adjustment.adjust import LAST_SCALE_SIGMAS
    from groma.factors.losses import GemanMcClure, loss

    if told.loss == "auto":
        return GemanMcClure(LAST_SCALE_SIGMAS)
    return loss(told.loss, 1.0 if told.loss_scale is None else told.loss_scale)


def _sentences(result: MapResult, verbose: bool = False) -> list[str]:
    from groma.cli.shared.numbers import describe_relations

    scene = result.scene
    kinds = ("images", "points", "lines", "planes", "directions")
    lines = [", ".join(counted(getattr(scene, f"num_{kind}"), kind) for kind in kinds)]
    for kind, rmse in result.report.rmse_px.items():
        lines.append(f"  {kind}: {rmse['before']:.3f} px -> {rmse['after']:.3f} px (rms, outliers included)")
    if any(rmse["after"] > rmse["before"] for rmse in result.report.rmse_px.values()):
        lines.append(
            "  The rms counts wrong matches in full and may grow while the robust cost, which doubts them, falls."
        )
    if verbose:
        lines += describe_relations(result.report.relations)
    return lines
