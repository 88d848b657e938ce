# SPDX-License-Identifier: BSD-3-Clause
"""``groma localize``: the poses of photographs in an existing map."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from groma._counted import counted
from groma.cli.shared import command as _complete
from groma.cli.shared import options as _options
from groma.cli.shared.console import Console

if TYPE_CHECKING:
    from groma.localization.result import LocalizeResult

#: Localised photographs in the table; the others are always listed (convention: what a screen can hold).
_SHOWN = 12
_MIN_LENGTH = 15.0  # derived from LocalizeOptions, whose import would load NumPy


def localize(
    console: Console,
    map_: Annotated[
        Path,
        typer.Argument(metavar="MAP", help="OUT of groma map or groma track, a COLMAP model, or an archive (.npz)."),
    ],
    queries: Annotated[list[Path], typer.Argument(metavar="QUERIES", help="Photographs, and folders of them.")],
    output: Annotated[Path, _options.PLAIN.option("Folder for the results.", "--output", "-o", metavar="OUT")],
    images: Annotated[
        Path | None,
        _options.PLAIN.option(
            "Folder of the photographs of the map. Default: the one recorded by groma map.", metavar="FOLDER"
        ),
    ] = None,
    calibration: Annotated[
        str,
        _options.PLAIN.option(
            "Calibration of the queries: map, exif, unknown; or auto, the first of these that applies.",
            choices=_complete.CALIBRATIONS,
            metavar="SOURCE",
        ),
    ] = "auto",
    camera_model: Annotated[
        str | None,
        _options.PLAIN.option(
            "Camera model of the queries, COLMAP's name; with --camera-params.",
            choices=_complete.CAMERA_MODELS,
            metavar="NAME",
        ),
    ] = None,
    camera_params: Annotated[
        str | None,
        _options.PLAIN.option("Known camera parameters of the queries, which are held.", metavar="F,CX,CY,..."),
    ] = None,
    masks: Annotated[
        Path | None,
        _options.PLAIN.option("Masks of the queries, as for groma map --masks: black is not used.", metavar="PATH"),
    ] = None,
    lines: Annotated[bool, _options.PLAIN.option("Use lines in addition to points.")] = True,
    min_length: Annotated[
        float, _options.PLAIN.option("Minimum length of line segments, pixels.", min=5.0, metavar="PX")
    ] = _MIN_LENGTH,
    force: _options.Force = False,
    seed: _options.Seed = 0,
) -> None:
    """Localise photographs in a map.

    OUT will hold poses.txt (name qw qx qy qz tx ty tz of localised queries), localized.json (status, pose, uncertainty
    and a sentence for every query), a COLMAP model of the map with the queries in it, the lines in structures/, and
    report.html. The map is indexed once; the index is kept beside it (MAP.index.npz). Finished queries are kept in
    OUT.work until the end: after an interruption the same command resumes there.
    """
    from groma.cli.shared import output as _output
    from groma.cli.shared.input import camera_parameters, check_inputs, refuse_idle

    _output.check_outputs(force, output, json_target=console.json_target)
    check_inputs(map_, *queries, images, masks)
    refuse_idle(
        ("--min-length", min_length != _MIN_LENGTH and not lines, "with lines"),
        ("--calibration", calibration != "auto" and camera_model is not None, "without --camera-model"),
    )

    import shutil

    from groma.cli.shared.extending import DESCRIBING, LOCALIZING
    from groma.cli.shared.interrupt import stages_that_are_kept
    from groma.cli.shared.mapping import WRITING
    from groma.errors import InputError
    from groma.execution import work_with
    from groma.features.images import one_opencv_thread
    from groma.io.colmap.files import is_model
    from groma.io.colmap.masks import Masks
    from groma.localization.calibration import CalibrationChoice
    from groma.localization.localizer import LocalizeOptions, Localizer
    from groma.localization.pose.absolute_pose import PoseOptions
    from groma.localization.result import LocalizeResult
    from groma.localization.run import localize_images, query_files

    first = queries[0]
    if not is_model(map_) and map_.suffix != ".npz" and (is_model(first) or first.suffix == ".npz"):
        raise InputError(
            f"{first} is a map and {map_} is none: groma localize {first} {map_} -o {output}, the map first."
        )
    choice = CalibrationChoice(calibration, camera_model, camera_parameters(camera_params))
    files = query_files(queries)
    of_queries = None if masks is None else Masks.of(masks, list(files))
    options = LocalizeOptions(lines=lines, min_segment_length=min_length, pose=PoseOptions(seed=seed))
    if console.threads is not None:  # each photograph has one of them
        one_opencv_thread()
    console.expect_compilation("localize")
    console.expect_stages(*DESCRIBING, LOCALIZING, WRITING)
    work = _output.work_folder(output)
    with stages_that_are_kept(console, f"finished queries are kept in {work}") as say, work_with(console.threads):
        localizer = Localizer(map_, images, options=options, progress=say)
        found = localize_images(localizer, files, work, choice, say, of_queries)
    if localizer.warning:
        console.warn(localizer.warning)
    result = LocalizeResult(localizer.scene, localizer.index, tuple(found))
    _output.check_output(output, force)
    with console.stages() as say:
        say(WRITING, 0, 1)
        result.write(output, files, f"Photographs in {_output.subject(map_)}", force=force)
    shutil.rmtree(work, ignore_errors=True)
    _say(console, result)
    console.wrote_page(output)
    _output.write_json(console.json_target, result.to_dict(), force)


def _say(console: Console, result: "LocalizeResult") -> None:
    """Print a table with at most a dozen of the localised photographs, the reasons of the others, and the counts."""
    from groma.localization.result import COLUMNS, row_of

    found = result.queries
    localized = [one for one in found if one.status == "localized"]
    hidden = 0 if console.verbose else max(len(localized) - _SHOWN, 0)
    left_out = {one.name for one in localized[len(localized) - hidden :]}
    console.table(COLUMNS, [row_of(one) for one in found if one.name not in left_out])
    if hidden:
        console.say(f"  and {hidden:,} more that are localised; --verbose shows them.")
    for one in found:
        (console.detail if one.status == "localized" else console.say)(f"{one.name}: {one.sentence}")
    numbers = ", ".join(f"{result.count(status)} {status}" for status in ("localized", "uncertain", "failed"))
    console.say(f"{counted(len(found), 'photographs')}: {numbers}.")
