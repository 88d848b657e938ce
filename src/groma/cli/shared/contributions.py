# SPDX-License-Identifier: BSD-3-Clause
"""What each kind of landmark contributes, as lines of text."""

from collections.abc import Mapping, Sequence
from typing import Any


def describe_contributions(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return one line for each adjustment, points alone first; the entries are those of ``--json``."""
    lines = ["With and without:"] if entries else []
    for number, entry in enumerate(entries):
        parts = [f"{name} {value:.3f} px" for name, value in entry["rmse_px"].items()]
        if number:
            parts.append(f"cameras moved {entry['moved']:.3g}")
        if entry["center_sigma"] is not None:
            parts.append(f"centres known to {entry['center_sigma']:.3g}")
        elif number == 0 or not entries[number - 1]["center_sigma_missing"]:
            parts.append(f"centres not predicted: {entry['center_sigma_missing'].rstrip('.')}")
        if entry["center_error"] is not None:
            parts.append(f"error {entry['center_error']:.4g}, {entry['rotation_error_deg']:.4f}°")
        if entry["num_relations"]:
            parts.append(f"{entry['num_dropped']:,} of {entry['num_relations']:,} relations given up")
        lines.append(f"  {('and ' if number else '') + entry['added']:<26}{', '.join(parts)}")
    return lines
