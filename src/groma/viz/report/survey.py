# SPDX-License-Identifier: BSD-3-Clause
"""HTML tables of the fit and the gross errors of measurements of other instruments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from groma.viz.report.tables import table

#: Measurements in the table, the worst first.
MAX_LISTED = 30


def survey_card(numbers: Mapping[str, Any] | None) -> str:
    """Return the cards of the entry ``survey`` of a summary; empty without it."""
    if not numbers or not numbers.get("measurements"):
        return ""
    return _components(numbers) + _measurements(numbers) + _check_points(numbers.get("check_points") or ())


def _components(numbers: Mapping[str, Any]) -> str:
    rows = []
    for kind, component in numbers["variance_components"].items():
        count = sum(one["kind"] == kind for one in numbers["measurements"])
        shown = "-" if component is None else f"{component:.2f}"
        rows.append([f"{kind}s", f"{count:,}", f"{numbers['redundancy'][kind]:.1f}", shown])
    caption = "Measured coordinates, how many of them are redundant, and the noise that their residuals show over that "
    caption += "stated: 1 where standard deviations are right."
    return table("Measurements", caption, ["", "number", "redundancy", "shown / stated"], rows)


def _measurements(numbers: Mapping[str, Any]) -> str:
    order = sorted(numbers["measurements"], key=lambda one: -abs(one["normalized"] or 0.0))
    rows = []
    for one in order[:MAX_LISTED]:
        cells = [f"{one['kind']} {one['name']} {one['coordinate']}".rstrip(), f"{one['sigma']:.4g}"]
        cells += [f"{one['residual']:.4f}", f"{one['redundancy']:.2f}"]
        cells += ["-" if one[name] is None else f"{one[name]:.3g}" for name in ("normalized", "detectable")]
        suspect = "suspect" if one["is_suspect"] else ""
        rows.append([*cells, "taken out" if one["is_rejected"] else suspect])
    left = len(order) - len(rows)
    caption = (
        "Residuals (measured less computed), worst first. r: how far the others check a measurement, from 0 to 1; "
    )
    caption += (
        f"w: normalised residual, suspect beyond {numbers['limit']:.2f}; detectable: the smallest error that this "
    )
    caption += f"test finds.{f' {left:,} more are in adjustment.txt.' if left else ''}"
    head = ["measurement", "sigma", "residual", "r", "w", "detectable", ""]
    marks = ["var(--bad, #d64b36)" if one["is_suspect"] else "transparent" for one in order[:MAX_LISTED]]
    return table("Residuals of measurements", caption, head, rows, marks)


def _check_points(points: Sequence[Mapping[str, Any]]) -> str:
    if not points:
        return ""
    rows = []
    for one in points:
        off = [f"{value:.4f} \u00b1 {sigma:.4f}" for value, sigma in zip(one["difference"], one["sigma"], strict=True)]
        rows.append([one["name"], *off, f"{one['normalized_square']:.1f}"])
    caption = "Points whose coordinates were not used: computed less measured, with the standard deviation of that. "
    caption += "Chi-square is 3 on average."
    return table("Check points", caption, ["point", "x", "y", "z", "chi-square"], rows)
