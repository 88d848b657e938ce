# SPDX-License-Identifier: BSD-3-Clause
"""Names of files that stand in files: they mean something inside a folder, never outside of it.

Only names are checked. A symbolic link inside the folder is followed: the owner of the folder made it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from groma.bounded.text import shown
from groma.errors import FileFormatError, InputError

#: Endings of the names of images and videos, in lower case.
IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm")
#: The same of photographs that are not read.
UNREAD = (".heic", ".heif", ".avif", ".jxl", ".gif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")


def stays_inside(name: str) -> bool:
    """Whether a name, taken as a path in some folder, can only mean something in that folder."""
    if not name or "\0" in name or os.path.isabs(name) or os.path.splitdrive(name)[0]:
        return False
    return os.path.normpath(name).replace(os.sep, "/").split("/")[0] not in ("..", "")


def is_text(name: str) -> bool:
    """Whether a name can stand in any file: it is Unicode, without line breaks and other control characters."""
    return not any(character < " " or "\ud800" <= character <= "\udfff" for character in name)


def listed_file(folder: Path, name: str, place: object) -> Path:
    """Return the path that a list means by a name.

    Raises
    ------
    FileFormatError
        If the name leaves the folder, or cannot be one; ``place`` says where it stands.
    """
    if not stays_inside(name):
        raise FileFormatError(
            f"{place}: expected the name of a file in {folder}; got {shown(name)}, which is none or lies outside. "
            "Move the file into the folder, or link to it from there."
        )
    return folder / name


def existing(path: str | os.PathLike[str]) -> Path:
    """Return ``path`` as a Path, or raise when there is nothing."""
    place = Path(path)
    try:
        place.stat()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"Cannot read {place}: {reason}. Check the path.") from error
    return place


def files_below(folder: Path) -> list[Path]:
    """Return the files in a folder and its sub-folders, sorted; hidden ones are skipped.

    Links to folders are followed, unless what they lead to is found without them, or contains the folder.
    """
    files: list[Path] = []
    seen, starts = {os.path.realpath(above) for above in folder.resolve().parents}, [folder]
    for start in starts:
        for place, folders, names in os.walk(start):
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            if (real := os.path.realpath(place)) in seen:
                folders.clear()
                continue
            seen.add(real)
            starts += [path for name in folders if (path := Path(place, name)).is_symlink()]
            files += [path for name in names if not name.startswith(".") and (path := Path(place, name)).is_file()]
    return sorted(files)


def masks_among(names: Iterable[str]) -> set[str]:
    """Return those of some names of images that are masks of others: ``a_mask.png`` or ``a.jpg.png`` of ``a.jpg``."""
    stems = {name: os.path.splitext(name)[0] for name in names}
    plain = set(stems.values())
    return {n for n, s in stems.items() if s in stems or (s.endswith("_mask") and s.removesuffix("_mask") in plain)}


def outside(names: Iterable[str]) -> list[str]:
    """Return the names that leave their folder."""
    return [name for name in names if not stays_inside(name)]
