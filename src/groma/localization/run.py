# SPDX-License-Identifier: BSD-3-Clause
"""Many photographs in one map: shared by the workers, each kept when it is finished, none stopping the others."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from groma._log import logged_stages, logger_of
from groma._version import __version__
from groma.bounded.names import IMAGES
from groma.errors import GromaError, InputError
from groma.execution import map_work
from groma.io.colmap.masks import Masks
from groma.localization.calibration import CalibrationChoice, calibration_of
from groma.localization.localizer import Localizer
from groma.localization.map_index import digest_of
from groma.localization.stored import StoredImage, read_stored, stored, unreadable
from groma.mapping.folder_lock import lock_folder
from groma.mapping.photographs import image_files, read_gray
from groma.solver.linear.blas import one_blas_thread


def query_files(queries: list[Path]) -> dict[str, Path]:
    """Return the files of photographs by name: those in folders by their place there, single files by their own.

    Raises
    ------
    InputError
        If there are none, a folder holds none, or two have one name.
    """
    found: dict[str, Path] = {}
    for path in queries:
        files = image_files(path) if path.is_dir() else [path]
        for file in files:
            name = file.relative_to(path).as_posix() if path.is_dir() else file.name
            if name in found and found[name].absolute() != file.absolute():
                raise InputError(f"Two queries are named {name!r}: {found[name]} and {file}. Pass a folder above them.")
            found[name] = file
    if not found:
        raise InputError(f"There are no queries. Pass photographs ({', '.join(IMAGES)}) or folders of them.")
    return found


def localize_images(
    localizer: Localizer,
    files: Mapping[str, Path],
    work: Path,
    choice: CalibrationChoice | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    masks: Masks | None = None,
) -> list[StoredImage]:
    """Localise photographs.

    Parameters
    ----------
    localizer
        The map.
    files
        Photographs by name.
    work
        Folder where finished ones are kept; the same call goes on from there.
    choice
        Where calibrations come from.
    progress
        Called with the name of a stage, what is done and what there is to do.
    masks
        What may be used of the photographs.
    """
    say, choice = logged_stages("localization", progress), choice or CalibrationChoice()
    told = f"{__version__} {digest_of(localizer.scene, localizer.files)} {localizer.options} {choice}"
    with lock_folder(work), one_blas_thread():
        one = partial(_kept, localizer, choice, masks, work, told)
        return map_work(one, list(files.items()), partial(say, "localising photographs"))


def _kept(
    localizer: Localizer, choice: CalibrationChoice, masks: Masks | None, work: Path, told: str, query: tuple[str, Path]
) -> StoredImage:
    """Localise a photograph, unless that is done already, and keep the result."""
    name, path = query
    file = work / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}.npz"
    mask = None if masks is None else masks.file_of.get(name)
    digest = hashlib.sha256(f"{told} {_state_of(path)} {mask and _state_of(mask)}".encode()).hexdigest()
    one = read_stored(file, digest)
    if one is None:
        one = _localize(localizer, name, path, choice, masks)
        one.write(file, digest)
    logger_of("localization").info("%s: %s. %s", name, one.status, one.sentence)
    return one


def _localize(
    localizer: Localizer, name: str, path: Path, choice: CalibrationChoice, masks: Masks | None
) -> StoredImage:
    try:
        image = read_gray(path)
        size = image.shape[1], image.shape[0]
        calibration = calibration_of(
            path, size, localizer.camera_of_map(*size), choice, localizer.photograph_of_map(*size)
        )
        used = None if masks is None else masks.read(name, size)
        return stored(name, localizer.localize(image, calibration.camera, calibration.refine, used))
    except GromaError as error:
        return unreadable(name, str(error))


def _state_of(path: Path) -> str:
    try:
        state = path.stat()
    except OSError:
        return str(path)
    return f"{path.absolute()} {state.st_size} {state.st_mtime_ns}"
