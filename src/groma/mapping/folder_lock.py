# SPDX-License-Identifier: BSD-3-Clause
"""One process at a time in a folder: the lock is released when the process ends in any way."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import IO

from groma.errors import OutputError

#: Name of the file that is locked.
LOCK = "lock"


def lock_folder(folder: Path) -> IO[str]:
    """Return the open lock file of a folder, which is made where it is missing; closing it gives the lock back.

    Raises
    ------
    OutputError
        If another process holds the lock, or the folder cannot be made or written.
    """
    try:
        while True:
            folder.mkdir(parents=True, exist_ok=True)
            file = (folder / LOCK).open("a+", encoding="utf-8")
            if not _take(file):
                file.seek(0)
                owner = file.read().strip()
                file.close()
                raise OutputError(
                    f"Another run{f' (process {owner})' if owner else ''} works in {folder}. Wait until it has "
                    "finished, or choose another output."
                )
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), (folder / LOCK).stat()):
                    break
            file.close()  # the folder was removed between opening and locking
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        return file
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(
            f"Cannot keep finished stages in {folder}: {error.strerror or error}. Choose an output where there is room "
            "and you may write."
        ) from error


def _take(file: IO[str]) -> bool:
    """Lock an open file; False if another process has."""
    try:
        if os.name == "nt":
            import msvcrt

            file.seek(1 << 20)  # beyond the text, which stays readable
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True
