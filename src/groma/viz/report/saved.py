# SPDX-License-Identifier: BSD-3-Clause
"""The report of an earlier run, from the ``summary.json`` of its result."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from groma.bounded.text import read_text

#: Entries without which it is another kind of summary.
_NEEDED = ("initial_cost", "final_cost", "iterations", "seconds", "history", "termination_sentence")


_ANY = "*"
#: Sizes of numbers, other than zero, that charts can show; and of counts.
_LEAST, _MOST, _MOST_COUNTED = 1e-100, 1e100, 10**15
_OBSERVED = {"determined": int, "weak": int, "undetermined": int}
#: Entries that the page uses: types by name; ``*`` stands for any name, ``?`` marks optional entries.
_FORM = {
    "initial_cost": float,
    "final_cost": float,
    "iterations": int,
    "seconds": {_ANY: float},
    "history": [{"iteration": int, "cost?": float, "accepted": bool, "stage?": int}],
    "termination_sentence": str,
    "warnings?": [str],
    "stages?": [{"loss": str, "initial_cost": float, "first_step": int}],
    "inliers?": {_ANY: {"limit_px": float, "share": {"before": float, "after": float}}},
    "relations?": {_ANY: {"held": int, "dropped": int}},
    "segments?": {_ANY: int},
    "explanation?": str,
    "diagnosis?": {"findings": [{"severity": str, "sentence": str}], "observability?": {_ANY: _OBSERVED}},
}


@dataclass(frozen=True)
class SavedTermination:
    """Why the solver stopped."""

    sentence: str


@dataclass(frozen=True)
class SavedReport:
    """A report from a file, for :func:`groma.viz.report.page.write_report`."""

    numbers: Mapping[str, Any]

    @property
    def history(self) -> Sequence[Mapping[str, Any]]:
        """Steps, as they were written."""
        return [step for step in self.numbers["history"] if step.get("cost") is not None]

    @property
    def warnings(self) -> Sequence[str]:
        """Sentences for the user."""
        return [str(text) for text in self.numbers.get("warnings", ())]

    @property
    def termination(self) -> SavedTermination:
        """Why the solver stopped."""
        return SavedTermination(str(self.numbers["termination_sentence"]))

    @property
    def outcomes(self) -> Mapping[str, int] | None:
        """Numbers of segments by outcome; None without segments."""
        return self.numbers.get("segments")

    @property
    def explanation(self) -> str:
        """The outcomes of the segments in words."""
        return str(self.numbers.get("explanation") or "")

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers as they were written."""
        return dict(self.numbers)


def saved_report(folder: Path) -> SavedReport | None:
    """Return the report in the ``summary.json`` of a folder; None, if damaged with a warning, if there is none."""
    path = folder / "summary.json"
    try:
        numbers = json.loads(read_text(path))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError):  # other than groma writes it
        numbers = None
    if isinstance(numbers, dict) and any(numbers.get(name) is None for name in _NEEDED):
        return None  # of a track, or of another program
    if not isinstance(numbers, dict) or not _has_form(numbers, _FORM) or "total" not in numbers["seconds"]:
        warnings.warn(f"{path} is damaged; the page is made without it.", stacklevel=2)
        return None
    return SavedReport(numbers)


def _has_form(value: Any, form: Any) -> bool:
    """Whether a value from a file has a form of :data:`_FORM`."""
    if isinstance(form, list):
        return isinstance(value, list) and all(_has_form(one, form[0]) for one in value)
    if isinstance(form, dict):
        if not isinstance(value, dict):
            return False
        if _ANY in form:
            return all(_has_form(one, form[_ANY]) for one in value.values())
        present = {name: inner for name, inner in form.items() if value.get(name.rstrip("?")) is not None}
        missing = [name for name in form if name not in present and not name.endswith("?")]
        return not missing and all(_has_form(value[name.rstrip("?")], inner) for name, inner in present.items())
    if isinstance(value, bool) or form is bool:
        return form is bool and isinstance(value, bool)
    if form is float:
        return isinstance(value, int | float) and (value == 0 or _LEAST <= abs(value) <= _MOST)
    if form is int:
        return isinstance(value, int) and 0 <= value <= _MOST_COUNTED
    return isinstance(value, form)
