# SPDX-License-Identifier: BSD-3-Clause
"""Writing files and folders whole or not at all.

The result is built in a hidden folder beside its place and put there by a rename, so that neither a full disk nor
Ctrl-C leaves half a file, and nothing that was there before is lost until the new is complete.
"""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from groma.errors import OutputError


@contextmanager
def atomic_output(
    path: str | os.PathLike[str], force: bool = False, workshop_in: str | os.PathLike[str] | None = None
) -> Iterator[Path]:
    """Yield a path to write a file or folder to; it becomes ``path`` when the block ends well, else it vanishes.

    Parameters
    ----------
    path : path
        The result. Folders above it that are missing are made.
    force : bool
        Replace an existing file or folder, which is refused otherwise.
    workshop_in : path, optional
        Folder, on the same disk, where the draft is built: what a killed process leaves is then found there, and not
        beside ``path``.

    Raises
    ------
    OutputError
        If something is there and ``force`` is False, or if the file system refuses.
    """
    target = Path(os.path.abspath(path))
    if not force and (target.exists() or target.is_symlink()):
        raise OutputError(f"{path} exists already. Pass force=True (--force) to replace it, or choose another name.")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        workshop = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=workshop_in or target.parent))
    except OSError as error:
        raise OutputError(f"Cannot write {path}: {error.strerror or error}. Choose another place.") from error
    try:
        draft = workshop / "draft"
        yield draft
        if not draft.exists():
            raise OutputError(f"Nothing was written for {path}.")
        _sync(draft)
        _put(draft, target, workshop)
    except OSError as error:
        if isinstance(error, OutputError):  # what is inside names the draft
            raise OutputError(str(error).replace(str(workshop / "draft"), str(path))) from error
        raise OutputError(f"Cannot write {path}: {error.strerror or error}.") from error
    finally:
        shutil.rmtree(workshop, ignore_errors=True)


def _put(draft: Path, target: Path, workshop: Path) -> None:
    """Rename the draft to its place.

    A folder cannot replace anything in one step: what was there moves away first, and back if the rename fails.
    """
    previous = None
    if (target.exists() or target.is_symlink()) and (draft.is_dir() or (target.is_dir() and not target.is_symlink())):
        previous = workshop / "previous"
        os.replace(target, previous)
    try:
        os.replace(draft, target)
    except BaseException:
        if previous is not None:
            os.replace(previous, target)
        raise
    with suppress(OSError):
        _sync_one(target.parent)


def _sync(path: Path) -> None:
    """Ask the system to put the content on the disk before the rename makes it visible."""
    for entry in sorted(path.rglob("*")) if path.is_dir() else []:
        if entry.is_file():
            _sync_one(entry)
    with suppress(OSError):
        _sync_one(path)


def _sync_one(path: Path) -> None:
    flags = os.O_RDONLY if path.is_dir() or os.name != "nt" else os.O_RDWR
    handle = os.open(path, flags)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
