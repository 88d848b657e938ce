# SPDX-License-Identifier: BSD-3-Clause
"""``groma localize``: where photographs were taken, in a map that is there already."""

from pathlib import Path
from typing import Annotated

import typer

from groma.cli.shared import options as _options


def localize(
    map_: Annotated[
        Path,
        typer.Argument(metavar="MAP", help="OUT of groma map or groma track, a COLMAP model, or an archive (.npz)."),
    ],
    queries: Annotated[list[Path], typer.Argument(metavar="QUERIES", help="Photographs, and folders of them.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT", help="Folder for the results.")],
    images: Annotated[
        Path | None,
        typer.Option(
            "--images",
            metavar="FOLDER",
            help="The photographs of the map. Needed unless an earlier run described the map.",
        ),
    ] = None,
    calibration: Annotated[
        str,
        typer.Option(
            "--calibration",
            metavar="SOURCE",
            help="Of the queries: map, exif, unknown; or auto, the first of these that fits.",
        ),
    ] = "auto",
    camera_model: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Lens model of the queries, by COLMAP's name; with its parameters."),
    ] = None,
    camera_params: Annotated[
        str | None, typer.Option(metavar="F,CX,CY,...", help="The parameters, if they are known; they are then kept.")
    ] = None,
    lines: Annotated[bool, typer.Option("--lines/--no-lines", help="Use lines besides points.")] = True,
    min_length: Annotated[float, typer.Option(min=5.0, metavar="PX", help="Shortest line segment, pixels.")] = 15.0,
    force: _options.Force = False,
    threads: _options.Threads = None,
    seed: _options.Seed = 0,
    json_target: _options.Json = None,
    quiet: _options.Quiet = False,
    verbose: _options.Verbose = False,
) -> None:
    """Localise photographs in a map.

    OUT then holds poses.txt (name qw qx qy qz tx ty tz of what was localised), localized.json (status, pose,
    uncertainty and a sentence for every query), a COLMAP model of the map with the queries in it, the lines in
    structures/, and report.html. The map is described once; the descriptions are kept beside it (MAP.index.npz).
    Finished queries are kept in OUT.work until the end: after an interruption the same command goes on from there.
    """
    from groma.cli.shared import output as _output
    from groma.cli.shared.console import Console
    from groma.cli.shared.input import check_inputs

    console = Console(quiet, verbose, json_target, threads)
    _output.check_outputs(force, output, json_target=json_target)
    check_inputs(map_, *queries, images)

    import shutil

    from groma._counted import counted
    from groma.cli.shared.interrupt import PROCESS, interruptible
    from groma.localization.calibration import CalibrationChoice, parameters
    from groma.localization.localizer import LocalizeOptions, Localizer
    from groma.localization.pose.absolute_pose import PoseOptions
    from groma.localization.result import LocalizeResult
    from groma.localization.run import localize_images, query_files

    choice = CalibrationChoice(calibration, camera_model, parameters(camera_params))
    files = query_files(queries)
    options = LocalizeOptions(lines=lines, min_segment_length=min_length, pose=PoseOptions(seed=seed))
    console.expect_compilation("localize")
    work = output.with_name(output.name + ".work")
    try:
        with interruptible() as interruption, console.stages() as stages:
            say = interruption.checking(stages)
            localizer = Localizer(map_, images, options=options, progress=say)
            found = localize_images(localizer, files, work, choice, say)
    except KeyboardInterrupt:
        words = f"finished queries are kept in {work}: the same command goes on from there."
        raise typer.Exit(PROCESS.tell(words)) from None
    if localizer.warning:
        console.warn(localizer.warning)
    result = LocalizeResult(localizer.scene, localizer.index, tuple(found))
    _output.check_output(output, force)
    result.write(output, files, f"Photographs in {map_.absolute().name}", force=force)
    shutil.rmtree(work, ignore_errors=True)
    for one in found:
        (console.detail if one.status == "localized" else console.say)(f"{one.name}: {one.status}. {one.sentence}")
    numbers = ", ".join(f"{result.count(status)} {status}" for status in ("localized", "uncertain", "failed"))
    console.say(f"{counted(len(found), 'photographs')}: {numbers}.")
    console.say(f"Wrote {output}. Open {(output / 'report.html').absolute()} in a browser.")
    _output.write_json(json_target, result.to_dict(), force)
