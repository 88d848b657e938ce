# SPDX-License-Identifier: BSD-3-Clause
"""Who compiles what, when several processes need the same function at the same moment: one does, the others wait.

In come the folder and the name of a compiled function; a turn is a lock on one byte of a file in that folder, the byte
that the name stands for. The system takes it back when a process ends in any way, so nothing is left behind. Where
locks are not possible every process compiles for itself, as if there were no others.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

#: Longest wait for a function that another process compiles, seconds, then it is compiled here, too; and between two
#: looks (cost: time).
_PATIENCE, _PAUSE = 120.0, 0.01
#: One open file a folder, for as long as the process lives: to close it would give up all its locks.
_files: dict[str, int] = {}


def take(folder: Path, name: str) -> bool:
    """Take the turn to compile a function; False if another process has it."""
    try:
        return _lock(_file(folder), _byte(name))
    except (OSError, ValueError):
        return True  # no locks here


def wait(folder: Path, name: str, is_there: Callable[[], bool]) -> None:
    """Take the turn, or wait until another process has compiled the function."""
    end = time.monotonic() + _PATIENCE
    while not take(folder, name) and not is_there() and time.monotonic() < end:
        time.sleep(_PAUSE)


def give_back(folder: Path, name: str) -> None:
    """Let other processes have the turn; without effect if this one does not have it."""
    try:
        _unlock(_file(folder), _byte(name))
    except (OSError, ValueError):
        pass


def _file(folder: Path) -> int:
    place = str(folder)
    if place not in _files:
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOINHERIT", 0)
        _files[place] = os.open(folder / "turns.lock", flags, 0o666)
    return _files[place]


def _byte(name: str) -> int:
    return int(name[:15], 16)


def _lock(file: int, byte: int) -> bool:
    try:
        if fcntl is not None:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, byte)
        else:
            _lock_on_windows(file, byte, "LK_NBLCK")
    except (BlockingIOError, PermissionError):
        return False
    return True


def _unlock(file: int, byte: int) -> None:
    if fcntl is not None:
        fcntl.lockf(file, fcntl.LOCK_UN, 1, byte)
    else:
        _lock_on_windows(file, byte, "LK_UNLCK")


def _lock_on_windows(file: int, byte: int, kind: str) -> None:
    import msvcrt

    os.lseek(file, byte, os.SEEK_SET)
    getattr(msvcrt, "locking")(file, getattr(msvcrt, kind), 1)  # noqa: B009  (other systems do not know it)
