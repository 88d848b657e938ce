# SPDX-License-Identifier: BSD-3-Clause
"""``groma convert``: from one file format to another."""

from pathlib import Path
from typing import Annotated, Any

import typer

from groma.cli.shared import options as _options
from groma.cli.shared import output as _output
from groma.cli.shared.console import Console
from groma.cli.shared.input import check_inputs
from groma.cli.shared.parts import is_parts
from groma.errors import InputError


def convert(
    console: Console,
    source: _options.Input,
    target: Annotated[
        Path,
        typer.Argument(
            metavar="OUTPUT",
            help="Its name says the format: a folder for a COLMAP model, .npz for a groma archive, .txt, .bz2 or .gz "
            "for BAL, .json for nerfstudio and instant-ngp: cameras, poses and points. To look at: .ply, .obj: points, "
            "lines and pieces of planes; .glb, .gltf, .dxf or .rrd (rerun): these and cameras.",
        ),
    ],
    parts: Annotated[
        bool,
        _options.PLAIN.option(
            "Cut the scene into parts in the folder OUTPUT, which groma adjust adjusts one by one, or by many "
            "processes together.",
            "--parts",
        ),
    ] = False,
    part_size: Annotated[
        int | None, _options.PLAIN.option("With --parts: observations of a part. Default: 1000000.", min=1, metavar="N")
    ] = None,
    force: _options.Force = False,
) -> None:
    """Read a scene and write it in another format, or cut it into parts; a folder of parts is joined to one scene."""
    if part_size is not None and not parts:
        raise InputError("--part-size is the size of parts. Add --parts, or leave it out.")
    _output.check_outputs(force, None if parts and force else target, json_target=console.json_target)
    check_inputs(source)
    numbers = _cut(source, target, console, force, part_size) if parts else _convert(source, target, console, force)
    _output.write_json(console.json_target, {"input": str(source), "output": str(target), **numbers}, force)


def _convert(source: Path, target: Path, console: Console, force: bool) -> dict[str, Any]:
    from groma.scene.counts import counts_of, sentence_of

    if is_parts(source):
        from groma.adjustment.parts import join_parts, parts_of
        from groma.io import write_scene

        scene = join_parts(parts_of(source))
        write_scene(scene, target, force=force)
    else:
        from groma.io.convert import convert as convert_scene

        scene = convert_scene(source, target, force)
    if target.suffix.lower() == ".json":  # cameras, poses and points
        scene = scene.points_only().keep(point_observations=[])
    console.wrote(f"{target}: {sentence_of(scene, geometry=target.suffix.lower() in ('.ply', '.obj', '.dxf'))}")
    return counts_of(scene)


def _cut(source: Path, target: Path, console: Console, force: bool, part_size: int | None) -> dict[str, Any]:
    from groma._counted import counted
    from groma.adjustment.parts import PART_SIZE, num_ties_cut, write_parts
    from groma.io import read_scene
    from groma.scene.counts import counts_of

    if is_parts(source):
        raise InputError(f"{source} is a folder of parts already. Leave --parts out to join them.")
    scene, part_size = read_scene(source), part_size or PART_SIZE
    paths = write_parts(scene, target, part_size, force)
    console.wrote(f"{target}: {counted(len(paths), 'parts')}, {counted(scene.num_observations, 'observations')}")
    if cut := num_ties_cut(scene, part_size):
        console.warn(
            f"{cut:,} of {counted(len(scene.relations.point_on_line), 'points on lines')} are left out: the line is in "
            "another part."
        )
    return {**counts_of(scene), "num_parts": len(paths)}
