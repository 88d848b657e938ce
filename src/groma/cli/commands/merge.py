# SPDX-License-Identifier: BSD-3-Clause
"""``groma merge``: two maps of one place become one."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from groma._counted import counted
from groma.cli.shared import options as _options
from groma.cli.shared.console import Console
from groma.errors import InputError


def merge(
    console: Console,
    first: Annotated[Path, typer.Argument(metavar="A", help="OUT of groma map or groma track, or a COLMAP model.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="A second map, of an overlapping place.")],
    output: Annotated[Path, _options.PLAIN.option("Folder for the results.", "--output", "-o", metavar="OUT")],
    first_images: Annotated[
        Path | None,
        _options.PLAIN.option("Folder of the photographs of A, if unknown.", "--images-a", metavar="FOLDER"),
    ] = None,
    second_images: Annotated[
        Path | None,
        _options.PLAIN.option("Folder of the photographs of B, if unknown.", "--images-b", metavar="FOLDER"),
    ] = None,
    scale: Annotated[bool, _options.PLAIN.option("Estimate the scale of B, or assume that of A.")] = True,
    diagnosis: Annotated[
        bool | None, _options.PLAIN.option("Report what the data do not determine. Default: up to 300 images.")
    ] = None,
    force: _options.Force = False,
    seed: _options.Seed = 0,
) -> None:
    """Join two maps of one place.

    Photographs of B are localised in A, which matches points and lines of both; from these the transformation between
    the two world frames is estimated. All photographs are then mapped together, in the world of A; lines of either map
    that are not found again are kept. OUT is as with groma map; OUT.images holds links to the photographs of both.
    """
    from groma.cli.shared import output as _output
    from groma.cli.shared.input import check_inputs

    _output.check_outputs(force, output, json_target=console.json_target)
    check_inputs(first, second, first_images, second_images)
    if first.samefile(second):
        raise InputError(f"A and B are the same map, {first}. Give two maps.")

    from groma.cli.shared.diagnosis import try_diagnosis
    from groma.cli.shared.extending import merge_maps
    from groma.cli.shared.mapping import run_map, say_map, stages_of_map, write_map
    from groma.localization.extension import in_world_of
    from groma.mapping.options import MapOptions

    options = MapOptions(threads=console.threads, seed=seed)
    stages = stages_of_map(options)
    work = _output.work_folder(output)
    images = (first_images, second_images)
    merged = merge_maps(console, (first, second), images, scale, output, force, stages, seed)
    result = run_map(console, merged.folder, work, merged.scene, options)
    result = in_world_of(result, merged.map)
    anew = result.scene.num_lines
    result = replace(result, **{name: merged.with_lines(getattr(result, name)) for name in ("scene", "before")})
    kept = result.scene.num_lines - anew
    found = try_diagnosis(result.diagnose, result.scene.num_images, console, diagnosis)
    numbers = {**result.summary(found), "merged": merged.sentence(), "num_kept_lines": kept}
    title = f"Map of {_output.subject(first)} and {_output.subject(second)}"
    write_map(console, result, output, work, force, images=merged.folder, title=title, summary=numbers)
    say_map(console, result, numbers, explain=False)
    if kept:
        console.say(f"{counted(kept, 'lines')} of the two maps, not found anew, are kept as their images show them.")
    console.wrote_page(output)
    _output.write_json(console.json_target, numbers, force)
