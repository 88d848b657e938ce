# SPDX-License-Identifier: BSD-3-Clause
"""Which compiled functions a command calls, so that they can be compiled before it gets there.

``needed.json`` lists, for each kind of work, module, name and argument types of every function that Python calls, in
the order of first use; types are written as Numba writes them, each once. ``packaging/needed_functions.py`` makes the
file anew, by doing the work and asking the cache what was called. An entry too many costs time on a second core, one
too few is compiled when it is called.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from numba.core import types

PLACE = Path(__file__).with_name("needed.json")
#: What each kind of work imports: parts that compiled functions choose by number are registered there.
IMPORTS = {
    "adjust": "groma.adjustment.adjust",
    "adjust points": "groma.adjustment.adjust",
    "map": "groma.mapping.map",
    "track": "groma.tracking",
    "selfcheck": "groma.factors",
    "localize": "groma.localization.run",
    "pose graph": "groma.adjustment.graphs.pose_graph",
}
#: Adjustments of points alone have lists of their own, one for each camera model: half as long.
_POINTS = "adjust points"
#: Module, name, argument types.
Entry = tuple[str, str, tuple[Any, ...]]


def works() -> tuple[str, ...]:
    """Return the kinds of work that are listed."""
    return tuple(json.loads(PLACE.read_text(encoding="utf-8"))["work"])


def points_of(model: str, is_estimated: bool) -> str:
    """Return the name of the work of adjusting points alone, seen by cameras of one model."""
    return f"{_POINTS}, {model}{', calibration estimated' if is_estimated else ''}"


def adjusting(models: Iterable[str], is_estimated: bool, has_points_alone: bool) -> str:
    """Return the name of the list that suits an adjustment best."""
    names = [points_of(model, is_estimated) for model in set(models)]
    return names[0] if has_points_alone and len(names) == 1 and names[0] in works() else "adjust"


def imported(work: str) -> str | None:
    """Return the module that some work imports."""
    return IMPORTS.get(work.partition(",")[0])


def needed(work: str) -> list[Entry]:
    """Return what some work calls, as far as it is known; nothing for work that is not listed."""
    said = json.loads(PLACE.read_text(encoding="utf-8"))
    kinds = [read_type(text) for text in said["types"]]
    return [
        (said["modules"][module], name, tuple(kinds[number] for number in numbers))
        for module, name, numbers in said["work"].get(work, [])
    ]


def function(module: str, name: str) -> Any:
    """Return a compiled function; None if there is none of this name any more."""
    try:
        return getattr(import_module(module), name, None)
    except ImportError:
        return None


@cache
def read_type(text: str) -> Any:
    """Return the Numba type that is written like this."""
    return eval(text, {"__builtins__": {}, **vars(types), "bool": types.boolean, "True": True, "False": False})
