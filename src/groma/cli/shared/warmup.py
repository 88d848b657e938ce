# SPDX-License-Identifier: BSD-3-Clause
"""How ``groma warmup`` knows what was compiled.

After a part has run, a list of the files it used is left in the folder of compiled functions, named after what these
depend on. The part is ready while all of them are there.
"""

from __future__ import annotations

import json
import os
import uuid
import warnings
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from groma import _numba_cache

PARTS = ("adjust", "map", "track")


def _list_of(part: str) -> Path | None:
    folder = _numba_cache.folder()
    return None if folder is None else folder / f"warm-{part}-{_numba_cache.environment_digest()[:16]}.json"


def is_ready(part: str) -> bool:
    """Whether a part was compiled for this version, processor and Python, and nothing of it was removed."""
    path = _list_of(part)
    if path is None:
        return False
    try:
        return all(os.path.exists(name) for name in json.loads(path.read_text()))
    except (OSError, ValueError):
        return False


def run(parts: tuple[str, ...], progress: Callable[[str, int, int], None]) -> dict[str, Any]:
    """Run parts and return how many functions were compiled, loaded and could not be kept."""
    from groma.cli.shared import warmup_runs as _warmup_runs

    before = asdict(_numba_cache.counts)
    for part in parts:
        steps = list(_warmup_runs.RUNS[part]())
        for number, (name, step) in enumerate(steps):
            progress(f"{part}: {name}", number, len(steps))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what tiny scenes lack is not the user's business
                step()
        path = _list_of(part)
        if path is not None and _numba_cache.counts.unsaved == before["unsaved"]:
            draft = path.with_suffix(f".{uuid.uuid4().hex[:16]}.tmp")
            draft.write_text(json.dumps([str(file) for file in _numba_cache.used_files()]))
            os.replace(draft, path)
    return {name: count - before[name] for name, count in asdict(_numba_cache.counts).items()}


def place() -> str:
    """Return the folder with what is compiled, for the user; empty where there is none."""
    folder = _numba_cache.folder()
    return "" if folder is None else str(folder.parent)
