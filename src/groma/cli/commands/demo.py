# SPDX-License-Identifier: BSD-3-Clause
"""``groma demo``: what ``groma map`` does, on real photographs that are shipped with the package."""

from pathlib import Path
from typing import Annotated

import typer

from groma.cli.shared import options as _options
from groma.cli.shared import output as _output
from groma.cli.shared.console import Console


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
    """Map 58 real photographs of a filing cabinet: points, lines and planes, adjusted together.

    The start is a COLMAP model with points alone. The folder then holds report.html (open it in a browser), a COLMAP
    model with the lines and planes beside it (structures/), scene.npz, lines.obj and summary.json, as after groma map.
    The result is compared with poses by motion capture and with the size of the cabinet.
    """
    console = Console(quiet, verbose, json_target, threads)
    _output.check_outputs(force, output, json_target=json_target)

    from groma.cli.shared import cabinet as _cabinet
    from groma.cli.shared.mapping import map_and_write
    from groma.io import read_scene
    from groma.mapping.map import MapOptions

    cabinet = _cabinet.folder()
    console.say("58 photographs of a filing cabinet, nearly without texture (TUM RGB-D benchmark), about a minute.")
    reference = read_scene(cabinet / "motion_capture")
    numbers = map_and_write(
        console,
        cabinet / "images",
        output,
        read_scene(cabinet / "model"),
        MapOptions(threads=threads),
        force,
        "A filing cabinet in 58 photographs",
        judge=lambda result: _cabinet.judge(result, reference),
        explain=False,
    )
    for sentence in _cabinet.sentences(numbers):
        console.say(sentence)
    console.say(f"Open {(output / 'report.html').absolute()} in a browser to walk around it, before and after.")
    console.say("With photographs of your own: groma map IMAGES -o OUT")
    _output.write_json(json_target, numbers, force)
