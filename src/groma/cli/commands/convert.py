# SPDX-License-Identifier: BSD-3-Clause
"""``groma convert``: from one file format to another."""

from pathlib import Path
from typing import Annotated

import typer

from groma.cli.shared import options as _options
from groma.cli.shared import output as _output
from groma.cli.shared.console import Console
from groma.cli.shared.input import check_inputs


def convert(
    source: _options.Input,
    target: Annotated[
        Path,
        typer.Argument(
            metavar="OUTPUT",
            help="Its name says the format: a folder for a COLMAP model, .npz for a groma archive, .txt, .bz2 or .gz "
            "for BAL, .ply or .obj for geometry only: points, lines and pieces of planes.",
        ),
    ],
    force: _options.Force = False,
    threads: _options.Threads = None,
    json_target: _options.Json = None,
    quiet: _options.Quiet = False,
    verbose: _options.Verbose = False,
) -> None:
    """Read a scene and write it in another format."""
    console = Console(quiet, verbose, json_target, threads)
    _output.check_outputs(force, target, json_target=json_target)
    check_inputs(source)

    from groma.io.convert import convert as convert_scene
    from groma.scene.counts import counts_of, sentence_of

    scene = convert_scene(source, target, force)
    console.say(f"Wrote {target}: {sentence_of(scene, geometry=target.suffix.lower() in ('.ply', '.obj'))}")
    _output.write_json(json_target, {"input": str(source), "output": str(target), **counts_of(scene)}, force)
