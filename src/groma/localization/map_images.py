# SPDX-License-Identifier: BSD-3-Clause
"""What the files of a map say besides the map: where its photographs are, and what of it was estimated."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from groma.bounded.documents import read_document
from groma.bounded.names import IMAGES, files_below, stays_inside
from groma.errors import GromaError, InputError

#: How the folder of a map's photographs is passed.
OPTIONS = "--images; to groma merge --images-a and --images-b, to groma map --extend --map-images"


def image_paths(names: Sequence[str], folder: Path) -> list[Path]:
    """Return the files of images of a map: by name in a folder, else by the last part of the name below it.

    Raises
    ------
    InputError
        If a file is missing, or cannot be told from others.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder. Pass the photographs of the map: {OPTIONS}.")
    found = [folder / name if stays_inside(name) else Path() for name in names]
    missing = [row for row, path in enumerate(found) if not path.is_file()]
    below: defaultdict[str, list[Path]] = defaultdict(list)
    for path in files_below(folder) if missing else ():
        if path.suffix.lower() in IMAGES:
            below[path.name].append(path)
    for row in missing:
        alike = below[Path(names[row]).name]
        if len(alike) != 1:
            raise InputError(
                f"{len(missing)} of the {len(names)} images of the map are not in {folder}, for example "
                f"{names[row]!r}. Pass the folder that their names begin in: {OPTIONS}."
            )
        found[row] = alike[0]
    return found


def images_in_summary(map_: Path) -> Path | None:
    """Return the folder of photographs that the summary of a map tells, if it is there."""
    try:
        told = read_document(map_ / "summary.json").get("images")
        return Path(told) if isinstance(told, str) and Path(told).is_dir() else None
    except (OSError, ValueError, AttributeError, GromaError):
        return None


def files_in_summary(map_: Path) -> dict[str, Path]:
    """Return the files of the images of a map by name, where its summary tells the sequences that they are from: more
    than one, where it was tracked in the map of another. Empty where it does not, or where a file is missing.
    """
    found: dict[str, Path] = {}
    try:
        for source in read_document(map_ / "summary.json")["sources"]:
            names, frames = list(source["images"]), list(source["images"].values())
            found |= zip(names, image_paths(frames, Path(source["path"])), strict=True)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, GromaError):
        return {}
    return found


def estimated_in_summary(map_: Path) -> tuple[bool, bool]:
    """Return whether the poses and the calibrations of a map were estimated, as its summary says; else both were.

    Tracking is given its calibration.
    """
    try:
        told = read_document(map_ / "summary.json")
        said = told.get("estimated")
        if isinstance(said, dict):
            return bool(said.get("poses", True)), bool(said.get("intrinsics", True))
        return True, "sources" not in told
    except (OSError, ValueError, AttributeError, GromaError):
        return True, True
