# SPDX-License-Identifier: BSD-3-Clause
"""How much memory parts may take that stay from one step to the next."""

from __future__ import annotations

import os
from pathlib import Path

from groma.errors import InputError
from groma.solver.reduce.contract import Reducer

KEEP = ("auto", "always", "never")
#: Share of the memory that is free at the start; the rest is for the part at work, the cameras, and others.
SHARE = 0.5


def room_for_parts(keep: str, reducer: Reducer) -> float:
    """Return the bytes that kept parts of this process may take.

    Raises
    ------
    InputError
        If ``keep`` is not one of :data:`KEEP`.
    """
    if keep not in KEEP:
        raise InputError(f"keep must be one of {', '.join(KEEP)}; got {keep!r}.")
    if keep == "auto":
        return SHARE * free_memory() / reducer.num_neighbours
    return float("inf") if keep == "always" else 0.0


def free_memory() -> float:
    """Return the bytes that this process could take: of the machine, or of the control group it runs in."""
    free = [_limit_of_group(), _free_of_machine()]
    return min(value for value in free if value is not None) if any(value is not None for value in free) else 0.0


def _free_of_machine() -> float | None:
    try:
        rows = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return 1024.0 * next(int(row.split()[1]) for row in rows if row.startswith("MemAvailable:"))
    except (OSError, ValueError, StopIteration):
        pass
    try:  # where there is no such file, half of all memory
        return 0.5 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def _limit_of_group(folder: Path = Path("/sys/fs/cgroup")) -> float | None:
    """What is left of the limit of this process's control group, as Slurm and containers set it; version 2."""
    try:
        group = Path("/proc/self/cgroup").read_text(encoding="ascii").strip().rpartition(":")[2]
        place = folder / group.lstrip("/")
        place = place if (place / "memory.max").exists() else folder
        return float(int((place / "memory.max").read_text()) - int((place / "memory.current").read_text()))
    except (OSError, ValueError):  # no group, or no limit ("max")
        return None
