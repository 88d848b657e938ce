# SPDX-License-Identifier: BSD-3-Clause
"""``groma demo``: the whole job on a real problem that is shipped with the package."""

from pathlib import Path
from typing import Annotated

import typer

from groma.cli import _options


def demo(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the results.")] = Path(
        "groma_demo"
    ),
    force: _options.Force = False,
    threads: _options.Threads = None,
    json_target: _options.Json = None,
    quiet: _options.Quiet = False,
    verbose: _options.Verbose = False,
) -> None:
    """Adjust 16 real photographs of Dubrovnik and show what changed.

    Cameras, calibration and 22 106 points are estimated together. The folder then holds report.html (open it in a
    browser), adjusted.npz (the scene) and report.json (the numbers).
    """
    from groma.cli import _output
    from groma.cli._console import Console

    console = Console(quiet, verbose, json_target, threads)
    _output.check_output(output, force)
    _output.check_json(json_target, force)

    from importlib.resources import as_file, files

    from groma.cli._numbers import describe
    from groma.io import read_scene, write_scene
    from groma.pipelines.adjust import AdjustOptions
    from groma.pipelines.adjust import adjust as run_adjust
    from groma.viz.report import write_report

    console.say("Bundle adjustment of a real scene: Dubrovnik, from the data set Bundle Adjustment in the Large.")
    fresh = console.announce_compilation()
    with as_file(files("groma") / "data" / "problem-16-22106-pre.txt.bz2") as path:
        before = read_scene(path)
    with console.progress() as progress:
        result = run_adjust(before, AdjustOptions(threads=threads), progress)
    numbers = {**result.report.to_dict(), "warnings": list(result.report.warnings)}
    with _output.atomic_output(output, force) as draft:
        draft.mkdir()
        write_report(draft / "report.html", before, result.scene, result.report, title="Dubrovnik, 16 photographs")
        write_scene(result.scene, draft / "adjusted.npz")
        _output.write_json(str(draft / "report.json"), numbers)
    for line in describe(numbers, result.report.termination.sentence, verbose=console.verbose, fresh=fresh):
        console.say(line)
    for sentence in result.report.warnings:
        console.warn(sentence)
    console.say(f"Open {(output / 'report.html').absolute()} in a browser to look at the scene before and after.")
    _output.write_json(json_target, numbers, force)
