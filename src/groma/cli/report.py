# SPDX-License-Identifier: BSD-3-Clause
"""``groma report``: a scene as one HTML file that opens anywhere."""

from pathlib import Path
from typing import Annotated

import typer

from groma.cli import _options


def report(
    source: _options.Input,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The HTML file.")] = Path(
        "report.html"
    ),
    before: Annotated[
        Path | None, typer.Option(metavar="SCENE", help="The same scene before adjustment, to compare with.")
    ] = None,
    force: _options.Force = False,
    threads: _options.Threads = None,
    json_target: _options.Json = None,
    quiet: _options.Quiet = False,
    verbose: _options.Verbose = False,
) -> None:
    """Write a self-contained HTML page of a scene: 3D view, residuals, numbers. It needs no network."""
    from groma.cli import _output
    from groma.cli._console import Console

    console = Console(quiet, verbose, json_target, threads)
    _output.check_output(output, force)
    _output.check_json(json_target, force)

    from groma.cli._counts import counts_of
    from groma.io import read_scene
    from groma.viz.report import write_report

    scene = read_scene(source)
    earlier = read_scene(before) if before is not None else None
    with _output.atomic_output(output, force) as draft:
        write_report(draft, earlier, scene, title=source.name)
    console.say(f"Wrote {output}")
    _output.write_json(json_target, {"output": str(output), **counts_of(scene)}, force)
