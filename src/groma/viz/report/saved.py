# SPDX-License-Identifier: BSD-3-Clause
"""The report of an earlier run, from the summary that stands beside its result."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

#: Without these it is the summary of something else.
_NEEDED = ("initial_cost", "final_cost", "iterations", "seconds", "history", "termination_sentence")


@dataclass(frozen=True)
class SavedTermination:
    """Why the solver stopped."""

    sentence: str


@dataclass(frozen=True)
class SavedReport:
    """What :func:`groma.viz.report.page.write_report` reads of a report, from a file."""

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
        """Numbers of segments by what became of them; None where there were none."""
        return self.numbers.get("segments")

    @property
    def explanation(self) -> str:
        """What became of the segments, in words."""
        return str(self.numbers.get("explanation") or "")

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers as they were written."""
        return dict(self.numbers)


def saved_report(folder: Path) -> SavedReport | None:
    """Return the report that ``summary.json`` in a folder holds; None where there is none that can be used."""
    try:
        numbers = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(numbers, dict) or any(numbers.get(name) is None for name in _NEEDED):
        return None
    return SavedReport(numbers)
