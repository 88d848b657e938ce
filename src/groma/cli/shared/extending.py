# SPDX-License-Identifier: BSD-3-Clause
"""Extending a map by photographs, and merging two maps, with progress."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from groma.cli.shared.interrupt import stages_that_are_kept
from groma.cli.shared.output import work_folder
from groma.errors import InputError, OutputError

if TYPE_CHECKING:
    from groma.cli.shared.console import Console
    from groma.io.colmap.masks import Masks
    from groma.localization.extension import ExtendedModel
    from groma.localization.joining.merging import MergedModel
    from groma.localization.localizer import Localizer

_Made = TypeVar("_Made")
Names = tuple[str, ...]
#: Names of stages: of the index of a map, of photographs, of two maps.
DESCRIBING: Names = (
    *("describing the images of the map", "placing the points of the map"),
    "comparing images of the map with the rest",
)
LOCALIZING, COMPARING = "localising photographs", "looking for photographs of the second map in the first"
_WITH_POINTS: Names = ("finding points in images", "placing points")


def extend_map(
    console: Console,
    map_: Path,
    new: Path,
    map_images: Path | None,
    output: Path,
    force: bool,
    following: Names,
    seed: int,
    masks: Masks | None,
) -> ExtendedModel:
    """Localise photographs in a map and return the joint model. ``following`` are the later stages."""
    from groma.localization.calibration import CalibrationChoice
    from groma.localization.extension import extended_model
    from groma.localization.run import query_files

    files = query_files([new])
    folder, work = photograph_folder(output, force), work_folder(output, ".queries")
    warnings: list[str] = []

    def made(say: Callable[[str, int, int], None]) -> ExtendedModel:
        map_of_photographs = _localizer(map_, map_images, seed, say, warnings)
        return extended_model(map_of_photographs, files, work, folder, CalibrationChoice(), say, masks)

    console.expect_stages(*DESCRIBING, LOCALIZING, *_WITH_POINTS, *following)
    extended = _with_progress(console, made, f"finished photographs are kept in {work}")
    console.warn(*warnings, *extended.warnings())
    return extended


def merge_maps(
    console: Console,
    maps: tuple[Path, Path],
    images: tuple[Path | None, Path | None],
    scale: bool,
    output: Path,
    force: bool,
    following: Names,
    seed: int,
) -> MergedModel:
    """Estimate the transformation between two maps and return their joint model. ``following`` are the later stages."""
    from groma.localization.joining.merging import merged_model
    from groma.localization.localizer import check_photographs

    for one, where in zip(maps, images, strict=True):
        check_photographs(one, where)  # before minutes are spent on the other
    folder = photograph_folder(output, force)
    warnings: list[str] = []

    def made(say: Callable[[str, int, int], None]) -> MergedModel:
        first, second = (_localizer(one, where, seed, say, warnings) for one, where in zip(maps, images, strict=True))
        return merged_model(first, second, folder, "similarity" if scale else "rigid", say)

    console.expect_stages(*DESCRIBING, *DESCRIBING, COMPARING, *_WITH_POINTS, *following)
    merged = _with_progress(console, made, "the descriptions of the maps are kept beside them")
    console.warn(*warnings, *filter(None, [merged.left_out]))
    console.say(merged.sentence())
    return merged


def photograph_folder(output: Path, force: bool) -> Path:
    """Return the folder for links to the photographs; refuse one with other files."""
    folder = output.with_name(f"{output.name}.images")
    if force and folder.is_dir():
        if any(path.is_file() and not path.is_symlink() for path in folder.rglob("*")):
            raise OutputError(f"{folder} holds files that are no links to photographs. Move it away.")
        shutil.rmtree(folder)
    return folder


def end_queries(output: Path) -> None:
    """Remove the checkpoints of localised photographs."""
    shutil.rmtree(output.with_name(f"{output.name}.queries"), ignore_errors=True)


def check_extension(extend: Path | None, map_images: Path | None, others: Mapping[str, object]) -> None:
    """Refuse options that exclude --extend, or that need it."""
    if extend is None and map_images is not None:
        raise InputError("--map-images tells where the photographs of --extend MAP are. Add --extend, or leave it out.")
    given = [name for name, value in others.items() if value is not None]
    if extend is not None and given:
        raise InputError(f"--extend and {given[0]} exclude each other. Leave one of them out.")


def _localizer(
    map_: Path, images: Path | None, seed: int, say: Callable[[str, int, int], None], warnings: list[str]
) -> Localizer:
    """Return the localiser of a map; add its warning, if any, to the list."""
    from groma.localization.localizer import LocalizeOptions, Localizer
    from groma.localization.pose.absolute_pose import PoseOptions

    localizer = Localizer(map_, images, options=LocalizeOptions(pose=PoseOptions(seed=seed)), progress=say)
    warnings += [localizer.warning] if localizer.warning else []
    return localizer


def _with_progress(console: Console, made: Callable[[Callable[[str, int, int], None]], _Made], kept: str) -> _Made:
    from groma.execution import work_with
    from groma.features.images import one_opencv_thread

    if console.threads is not None:  # each photograph has one of them
        one_opencv_thread()
    console.expect_compilation("map")
    with stages_that_are_kept(console, kept) as say, work_with(console.threads):
        return made(say)
