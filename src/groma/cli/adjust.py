# SPDX-License-Identifier: BSD-3-Clause
"""``groma adjust``: bundle adjustment of a COLMAP model, a BAL file or a groma archive."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from groma.cli import _options

LinearSolver = Literal["auto", "dense", "sparse", "pcg"]


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
    Chance plays no part here: --seed is accepted so that scripts can pass it everywhere.
    """
    from groma.cli import _output
    from groma.cli._console import Console

    console = Console(quiet, verbose, json_target, threads)
    for path in (output, page):
        if path is not None:
            _output.check_output(path, force)
    _output.check_json(json_target, force)

    from groma.cli._numbers import describe
    from groma.io import read_scene, structures_of, write_scene
    from groma.pipelines.adjust import AdjustOptions
    from groma.pipelines.adjust import adjust as run_adjust

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
    fresh = console.announce_compilation()
    with console.progress() as progress:
        result = run_adjust(before, options, progress)
    numbers = result.report.to_dict()

    if output is not None:
        write_scene(result.scene, output, force=force, like=structures_of(source))
    if page is not None:
        from groma.viz.report import write_report

        with _output.atomic_output(page, force) as draft:
            write_report(draft, before, result.scene, result.report)
    for line in describe(numbers, result.report.termination.sentence, verbose=console.verbose, fresh=fresh):
        console.say(line)
    for sentence in result.report.warnings:
        console.warn(sentence)
    for path in (output, page):
        if path is not None:
            console.say(f"Wrote {path}")
    if output is None and page is None and json_target is None:
        console.say("No -o given: the adjusted scene was not written.")
    _output.write_json(json_target, {**numbers, "warnings": list(result.report.warnings)}, force)
