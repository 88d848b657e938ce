# SPDX-License-Identifier: BSD-3-Clause
"""``groma adjust``: bundle adjustment of a COLMAP model, a BAL file or a groma archive; of a pose graph, too."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from groma.cli import _options
from groma.errors import InputError, ProblemError

if TYPE_CHECKING:
    from groma.pipelines.adjust import AdjustResult
    from groma.scene import Scene

LinearSolver = Literal["auto", "dense", "sparse", "pcg"]
CovarianceGauge = Literal["auto", "inner", "held"]


def adjust(
    source: _options.Input,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="OUT",
            help="Result: a folder (COLMAP model and structures), a groma archive (.npz) or a BAL file (.txt, .bz2, "
            ".gz). Without it nothing but the report is written.",
        ),
    ] = None,
    loss: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="auto, none, huber, soft_l1, cauchy, tukey, geman_mcclure, barron or truncated. auto: robust "
            "(Cauchy) for what comes from matching, none for BAL files.",
        ),
    ] = "auto",
    loss_scale: Annotated[
        float | None, typer.Option(metavar="S", help="Scale of the loss, in units of the noise (pixels for images).")
    ] = None,
    refine_intrinsics: Annotated[
        bool | None,
        typer.Option(
            "--refine-intrinsics/--fix-intrinsics",
            help="Estimate the calibration too. Default: yes for BAL files, no otherwise.",
        ),
    ] = None,
    refine_principal_point: Annotated[
        bool, typer.Option("--refine-principal-point", help="With the intrinsics: principal points too.")
    ] = False,
    refine_rigs: Annotated[
        bool, typer.Option("--refine-rigs", help="Estimate where the cameras sit on their rig.")
    ] = False,
    points: Annotated[bool, typer.Option("--points/--no-points", help="Use points.")] = True,
    lines: Annotated[bool, typer.Option("--lines/--no-lines", help="Use lines.")] = True,
    planes: Annotated[bool, typer.Option("--planes/--no-planes", help="Use planes.")] = True,
    max_iterations: Annotated[int | None, typer.Option(min=0, metavar="N", help="Stop after N steps.")] = None,
    linear_solver: Annotated[LinearSolver, typer.Option(help="How each step is solved.")] = "auto",
    line_chart: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="cartesian, orthonormal_left, orthonormal_right, free_left, free_right."),
    ] = None,
    gauge: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="auto, free, or first_camera to hold the first camera and the scale."),
    ] = None,
    page: Annotated[
        Path | None, typer.Option("--report", metavar="FILE", help="Also write an HTML page: before and after.")
    ] = None,
    covariance: Annotated[
        Path | None,
        typer.Option(
            "--covariance",
            metavar="FILE",
            help="Also write how certain the result is: covariances (.npz) or standard deviations (.json) of images, "
            "points, lines, planes and directions.",
        ),
    ] = None,
    covariance_gauge: Annotated[
        CovarianceGauge,
        typer.Option(
            "--covariance-gauge",
            help="What it refers to: inner, all camera centres together; held, the first camera and the scale.",
        ),
    ] = "auto",
    sigma0: Annotated[
        float,
        typer.Option(
            "--sigma0",
            metavar="S",
            help="With --covariance: the noise of the measurements in units of that stated (1 pixel unless the scene "
            "says otherwise).",
        ),
    ] = 1.0,
    diagnosis: Annotated[
        bool | None,
        typer.Option(
            "--diagnosis/--no-diagnosis",
            help="Say what the data do not determine. Default: yes up to 300 images.",
        ),
    ] = None,
    contributions: _options.Contributions = False,
    truth: _options.Truth = None,
    force: _options.Force = False,
    threads: _options.Threads = None,
    seed: _options.Seed = 0,
    json_target: _options.Json = None,
    quiet: _options.Quiet = False,
    verbose: _options.Verbose = False,
) -> None:
    """Adjust cameras, points, lines and planes together (bundle adjustment).

    Reads a scene, minimises the robust reprojection error over everything in it and writes the scene back. The input
    is never changed. LIMAP's structures beside a COLMAP model are read and written too, with what they hold besides.
    What the data do not determine is said in words at the end. A pose graph (.g2o, .g2o.gz) is adjusted, too.
    Chance plays no part here: --seed is accepted so that scripts can pass it everywhere.
    """
    from groma.cli import _output
    from groma.cli._console import Console
    from groma.cli._input import check_inputs
    from groma.cli._pose_graph import adjust_pose_graph_file, is_pose_graph

    console = Console(quiet, verbose, json_target, threads)
    _output.check_outputs(force, output, page, covariance, json_target=json_target)
    if covariance is not None and covariance.suffix not in (".npz", ".json"):
        raise InputError(f"--covariance must end in .npz or .json; got {covariance}.")
    if not 0.0 < sigma0 < float("inf"):
        raise InputError(f"--sigma0 must be positive; got {sigma0}.")
    if truth is not None and not contributions:
        raise InputError("--truth is what --contributions compares with. Add --contributions, or leave it out.")
    check_inputs(source, truth)
    if is_pose_graph(source):
        refused = {
            "--report": page, "--covariance": covariance, "--contributions": contributions, "--gauge": gauge,
            "--line-chart": line_chart, "--refine-intrinsics": refine_intrinsics, "--refine-rigs": refine_rigs,
        }  # fmt: skip
        given = {
            "loss": "none" if loss == "auto" else loss, "loss_scale": loss_scale, "linear_solver": linear_solver,
            "max_iterations": max_iterations, "threads": threads,
        }  # fmt: skip
        options_of_graph = {name: value for name, value in given.items() if value is not None}
        numbers_of_graph = adjust_pose_graph_file(source, output, console, force, options_of_graph, refused)
        _output.write_json(json_target, numbers_of_graph, force)
        return

    from groma.cli._contributions import describe_contributions
    from groma.cli._diagnosis import diagnosis_of, say_diagnosis
    from groma.cli._numbers import describe, describe_uncertainty
    from groma.io import check_target, read_scene, structures_of, write_scene
    from groma.pipelines.adjust import AdjustOptions
    from groma.pipelines.adjust import adjust as run_adjust
    from groma.pipelines.diagnosis import diagnose_scene

    chosen = {
        "loss_scale": loss_scale,
        "refine_intrinsics": refine_intrinsics,
        "max_iterations": max_iterations,
        "line_chart": line_chart,
        "gauge": gauge,
        "threads": threads,
    }
    options = AdjustOptions(
        loss=loss,
        refine_principal_point=refine_principal_point,
        refine_rigs=refine_rigs,
        points=points,
        lines=lines,
        planes=planes,
        linear_solver=linear_solver,
        **{name: value for name, value in chosen.items() if value is not None},  # type: ignore[arg-type]
    )
    before = read_scene(source)
    if output is not None:
        check_target(before, output)
    true = None if truth is None else read_scene(truth)
    fresh = console.announce_compilation()
    with console.progress() as progress:
        result = run_adjust(before, options, progress)
    numbers: dict[str, Any] = result.report.to_dict()
    if contributions:
        from groma.pipelines.contributions import contributions as find_contributions

        numbers["contributions"] = [entry.to_dict() for entry in find_contributions(before, options, true)]
    numbers["diagnosis"] = diagnosis_of(
        result.scene, lambda: diagnose_scene(result.scene, problem=result.problem), console, diagnosis
    )

    if output is not None:
        write_scene(result.scene, output, force=force, like=structures_of(source))
    if page is not None:
        _write_page(page, before, result, numbers, f"Adjustment of {source.absolute().name}", force)
    failure = None
    if covariance is not None:
        try:
            numbers["uncertainty"] = _write_covariances(covariance, result, covariance_gauge, sigma0, force)
        except ProblemError as error:  # raised at the end, when all else is written and said
            failure = error
    said = describe(numbers, result.report.termination.sentence, verbose=console.verbose, fresh=fresh)
    said += describe_uncertainty(numbers["uncertainty"]) if "uncertainty" in numbers else []
    said += describe_contributions(numbers.get("contributions", []))
    for line in said:
        console.say(line)
    say_diagnosis(numbers["diagnosis"], console)
    for sentence in result.report.warnings:
        console.warn(sentence)
    for path in (output, page, covariance if failure is None else None):
        if path is not None:
            console.say(f"Wrote {path}")
    if output is None and page is None and covariance is None and json_target is None:
        console.say("No -o given: the adjusted scene was not written.")
    _output.write_json(json_target, {**numbers, "warnings": list(result.report.warnings)}, force)
    if failure is not None:
        raise failure


def _write_page(
    page: Path, before: "Scene", result: "AdjustResult", numbers: dict[str, Any], title: str, force: bool
) -> None:
    """Write the HTML page of an adjustment."""
    from groma.cli import _output
    from groma.viz._page_tables import contributions_card
    from groma.viz.report import write_report

    with _output.atomic_output(page, force) as draft:
        write_report(
            draft,
            before,
            result.scene,
            result.report,
            title=title,
            diagnosis=numbers["diagnosis"],
            cards=contributions_card(numbers.get("contributions")),
        )


def _write_covariances(
    path: Path, result: "AdjustResult", gauge: CovarianceGauge, sigma0: float, force: bool
) -> dict[str, Any]:
    """Write the covariances of an adjusted scene and return their summary."""
    from groma.cli._covariance import write_covariances
    from groma.pipelines.uncertainty import uncertainty

    found = uncertainty(result.scene, gauge=gauge, sigma0=sigma0, problem=result.problem)
    write_covariances(path, result.scene, found, force)
    return found.to_dict()
