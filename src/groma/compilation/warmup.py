# SPDX-License-Identifier: BSD-3-Clause
"""Compile everything once, so that nothing waits for the compiler later, and know what was compiled.

After a part has run, a list of the files it used is left in the folder of compiled functions, named after what these
depend on. The part is ready while all of them are there.
"""

from __future__ import annotations

import json
import os
import time
import uuid
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from groma._kernels import cache as kernel_cache
from groma.errors import InputError, OutputError, did_you_mean

PARTS = ("adjust", "map", "track")


def _list_of(part: str) -> Path | None:
    folder = kernel_cache.folder()
    return None if folder is None else folder / f"warm-{part}-{kernel_cache.environment_digest()[:16]}.json"


def is_ready(part: str) -> bool:
    """Whether a part was compiled for this version, processor and Python, and nothing of it was removed."""
    path = _list_of(part)
    if path is None:
        return False
    try:
        return all(os.path.exists(name) for name in json.loads(path.read_text()))
    except (OSError, ValueError):
        return False


def warm_up(
    parts: Sequence[str] = PARTS, progress: Callable[[str, int, int], None] | None = None, again: bool = False
) -> dict[str, Any]:
    """Compile the kernels of adjustment, mapping and tracking for this machine, as ``groma warmup`` does.

    Parameters
    ----------
    parts : sequence of str
        Some of ``adjust``, ``map`` and ``track``.
    progress : callable, optional
        Called with what is run, what is done and what there is to do.
    again : bool
        Run what is ready, too.

    Returns
    -------
    dict
        ``parts`` that are ready now, those that were ``run``, how many functions were ``compiled``, ``loaded`` and
        could not be kept (``unsaved``), ``seconds``, and the ``folder``.

    Raises
    ------
    InputError
        If a part is not known.
    OutputError
        If compiled functions can be kept nowhere.
    """
    began, before = time.perf_counter(), asdict(kernel_cache.counts)
    if unknown := sorted({*parts} - {*PARTS}):
        raise InputError(
            f"There is no part named {unknown[0]!r}; choose of {', '.join(PARTS)}.{did_you_mean(unknown[0], PARTS)}"
        )
    if not place():
        raise OutputError(
            "No folder for compiled functions can be written, so nothing would be kept. Set NUMBA_CACHE_DIR to one."
        )
    wanted = [part for part in PARTS if part in parts]
    missing = [part for part in wanted if again or not is_ready(part)]
    for part in missing:
        _run(part, progress or (lambda name, done, total: None), before["unsaved"])
    counts = {name: count - before[name] for name, count in asdict(kernel_cache.counts).items()}
    seconds = time.perf_counter() - began
    return {"parts": wanted, "run": missing, **counts, "seconds": seconds, "folder": place()}


def _run(part: str, progress: Callable[[str, int, int], None], unsaved: int) -> None:
    """Run a part, and note which files it used if all of them could be kept."""
    from groma.compilation import runs  # what is to be run, and all that it imports

    steps = list(runs.RUNS[part]())
    for number, (name, step) in enumerate(steps):
        progress(f"{part}: {name}", number, len(steps))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what tiny scenes lack is not the user's business
            step()
    path = _list_of(part)
    if path is not None and kernel_cache.counts.unsaved == unsaved:
        draft = path.with_suffix(f".{uuid.uuid4().hex[:16]}.tmp")
        draft.write_text(json.dumps([str(file) for file in kernel_cache.used_files()]))
        os.replace(draft, path)


def place() -> str:
    """Return the folder with what is compiled, for the user; empty where there is none."""
    folder = kernel_cache.folder()
    return "" if folder is None else str(folder.parent)
