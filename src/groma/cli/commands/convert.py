# SPDX-License-Identifier: BSD-3-Clause
"""``groma convert``: from one file format to another."""

from pathlib import Path
from typing import Annotated, Any

import typer

from groma.cli.shared import options as _options
from groma.cli.shared import output as _output
from groma.cli.shared.console import Console
from groma.cli.shared.input import check_inputs
from groma.errors import InputError


def convert(
    source: _options.Input,
    target: Annotated[
        Path,
        typer.Argument(
            metavar="OUTPUT",
            help="Its name says the format: a folder for a COLMAP model, .npz for a groma archive, .txt, .bz2 or .gz "
            "for BAL, .json for nerfstudio and instant-ngp: cameras, poses and points, .ply or .obj for geometry only: "
            "points, lines and pieces of planes.",
        ),
    ],
    parts: Annotated[
        bool,
        typer.Option(
            "--parts",
            help="Cut the scene into parts in the folder OUTPUT, which groma adjust adjusts one by one, or by many "
            "processes together.",
        ),
    ] = False,
    part_size: Annotated[
        int | None,
        typer.Option("--part-size", min=1, metavar="N", help="With --parts: observations of a part. Default: 1000000."),
    ] = None,
    force: _options.Force = False,
    threads: _options.Threads = None,
    json_target: _options.Json = None,
    quiet: _options.Quiet = False,
    verbose: _options.Verbose = False,
) -> None:
    """Read a scene and write it in another format, or cut it into parts."""
    console = Console(quiet, verbose, json_target, threads)
    if part_size is not None and not parts:
        raise InputError("--part-size is the size of parts. Add --parts, or leave it out.")
    _output.check_outputs(force, None if parts and force else target, json_target=json_target)
    check_inputs(source)
    numbers = _cut(source, target, console, force, part_size) if parts else _convert(source, target, console, force)
    _output.write_json(json_target, {"input": str(source), "output": str(target), **numbers}, force)


def _convert(source: Path, target: Path, console: Console, force: bool) -> dict[str, Any]:
    from groma.io.convert import convert as convert_scene
    from groma.scene.counts import counts_of, sentence_of

    scene = convert_scene(source, target, force)
    if target.suffix.lower() == ".json":  # cameras, poses and points
        scene = scene.points_only().keep(point_observations=[])
    console.say(f"Wrote {target}: {sentence_of(scene, geometry=target.suffix.lower() in ('.ply', '.obj'))}")
    return counts_of(scene)


def _cut(source: Path, target: Path, console: Console, force: bool, part_size: int | None) -> dict[str, Any]:
    from groma._counted import counted
    from groma.adjustment.parts import PART_SIZE, write_parts
    from groma.io import read_scene
    from groma.scene.counts import counts_of

    scene = read_scene(source)
    paths = write_parts(scene, target, part_size or PART_SIZE, force)
    console.say(f"Wrote {target}: {counted(len(paths), 'parts')}, {counted(scene.num_observations, 'observations')}")
    if scene.num_planes or len(scene.relations):
        console.warn("Planes and relations between landmarks are not adjusted in parts: relations are left out.")
    return {**counts_of(scene), "num_parts": len(paths)}
