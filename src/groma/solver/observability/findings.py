# SPDX-License-Identifier: BSD-3-Clause
"""What a diagnosis consists of, and small words for it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from groma._counted import first_of
from groma.solver.observability.gates import DIAGNOSIS
from groma.solver.observability.messages import listing


@dataclass(frozen=True)
class Finding:
    """One finding of a diagnosis."""

    #: For programs: ``point_no_parallax``, ``line_along_motion``, ``camera_unobservable`` and so on.
    kind: str
    #: ``note``, ``warning`` or ``problem``.
    severity: str
    sentence: str
    #: The group of variables it is about, and which of them; empty if it is about the whole.
    group: str = ""
    indices: tuple[int, ...] = ()
    values: dict[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON; long lists of indices are cut."""
        return {
            "kind": self.kind,
            "severity": self.severity,
            "sentence": self.sentence,
            "group": self.group,
            "count": len(self.indices),
            "indices": list(self.indices[: DIAGNOSIS.listed]),
            "values": {name: float(value) if np.isfinite(value) else None for name, value in self.values.items()},
        }


def few(parts: list[str], most: int = DIAGNOSIS.examples) -> str:
    """Return the first of a list in words, and how many more there are."""
    if len(parts) <= most:
        return listing(parts)
    return first_of(parts, most)


def first_upper(text: str) -> str:
    """Return a text with a capital first letter."""
    return text[:1].upper() + text[1:]
