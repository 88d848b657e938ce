# SPDX-License-Identifier: BSD-3-Clause
"""``adjustment.txt``: what was measured and how well it fits, as surveyors write it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from groma._version import __version__

_TITLES = {
    "camera position": "Positions of cameras",
    "camera pose": "Poses of cameras (shift along and turn about their axes; degrees)",
    "control point": "Coordinates of control points",
    "mark": "Marks of control points in the images (pixels)",
    "distance": "Distances",
    "known plane": "Distances from known planes",
    "known direction": "Turn from known directions, in two axes across them (degrees)",
}
#: What is written behind a measurement that is rejected, or suspect.
_MARKS = {(True, True): "<- taken out", (True, False): "<- taken out", (False, True): "<- suspect", (False, False): ""}
_EXPLAINED = """
residual    measured less computed
r           redundancy number: how far the others check the measurement (1 fully, 0 not at all)
w           normalised residual, residual / (sigma sqrt r); standard normal without gross errors
MDE         smallest error that the test finds
effect      most that an error of that size moves the result, in standard deviations of the result
weight      what a robust loss left of the weight; 0 of what was taken out, which is tested against the others
"""


def protocol(summary: Mapping[str, Any]) -> str:
    """Return the protocol of an adjustment as text.

    Parameters
    ----------
    summary : mapping
        The content of ``summary.json``, with its entry ``survey``.
    """
    survey = summary["survey"]
    parts = [_head(summary, survey)]
    if "measurements" in survey:
        parts += [_components(summary, survey), _tests(survey)]
        for kind, title in _TITLES.items():
            rows = [one for one in survey["measurements"] if one["kind"] == kind]
            if rows:
                parts.append(_section(title, _table(rows) + "\n" + _EXPLAINED))
    if survey.get("given_poses"):
        parts.append(_section("Given poses", _given_poses(survey["given_poses"])))
    if survey.get("held"):
        parts.append(_section("Held as they are", ", ".join(survey["held"])))
    if survey.get("check_points"):
        parts.append(_section("Check points: computed less measured", _check_table(survey["check_points"])))
    return "\n".join(parts)


def _head(summary: Mapping[str, Any], survey: Mapping[str, Any]) -> str:
    lines = [f"Adjustment by groma {__version__}", ""]
    if "frame" in survey:
        lines += [f"Frame: {survey['frame']['description']}.", *survey["notes"], ""]
    counts = ((name, summary.get(f"num_{name}")) for name in ("images", "points", "lines", "planes"))
    lines.append("Scene: " + ", ".join(f"{count} {name}" for name, count in counts if count) + ".")
    lines.append(f"Unknowns {summary['num_unknowns']}, observations {summary['num_residuals']}.")
    lines.append(f"{summary['termination_sentence']} Steps: {summary['iterations']}.")
    return "\n".join(lines) + "\n"


def _components(summary: Mapping[str, Any], survey: Mapping[str, Any]) -> str:
    sigma0 = summary.get("sigma0")
    rows = [("kind", "number", "redundancy", "sigma shown / stated")]
    rows.append(("images", str(summary["num_observations"]), "", "-" if sigma0 is None else f"{sigma0:.2f}"))
    for kind, component in survey["variance_components"].items():
        number = sum(one["kind"] == kind for one in survey["measurements"])
        shown = "-" if component is None else f"{component:.2f}"
        rows.append((f"{kind}s", str(number), f"{survey['redundancy'][kind]:.1f}", shown))
    return _section("Variance components", aligned(rows))


def _tests(survey: Mapping[str, Any]) -> str:
    level, power = 100 * survey["level"], 100 * survey["power"]
    lines = [f"Level {level:g} %, power {power:g} %: a measurement with |w| > {survey['limit']:.2f} is suspect."]
    suspects = [one for one in survey["measurements"] if one["is_suspect"]]
    for one in sorted(suspects, key=lambda one: -abs(one["normalized"])):
        name = f"{one['kind']} {one['name']} {one['coordinate']}".rstrip()
        verdict = "Taken out" if one["is_rejected"] else "Suspect"
        lines.append(f"{verdict}: {name}, residual {one['residual']:.4g}, w {one['normalized']:.1f}")
    return _section("Test for gross errors", "\n".join(lines if suspects else [*lines, "No measurement is suspect."]))


def _given_poses(told: Mapping[str, Any]) -> str:
    """Return the estimated noise of poses without a stated one."""
    rows = [("", "sigma, estimated", "rms residual")]
    rows += [("shift along an axis", f"{told['sigma']:.4g}", f"{told['rms']:.4g}")]
    rows += [("turn about an axis (degrees)", f"{told['sigma_deg']:.4g}", f"{told['rms_deg']:.4g}")]
    without = f"\nWithout a given pose, or with a wrong one: {', '.join(told['without'])}." if told["without"] else ""
    return f"{told['number']} images, with the noise that the photographs show.\n{aligned(rows)}{without}"


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    cells: list[tuple[str, ...]] = [("name", "", "sigma", "residual", "r", "w", "MDE", "effect", "weight", "")]
    for one in rows:
        checked = one["normalized"] is not None
        tests = [f"{one['normalized']:.2f}", f"{one['detectable']:.4f}", f"{one['external']:.1f}"] if checked else "---"
        cells.append((
            one["name"], one["coordinate"], f"{one['sigma']:.4f}", f"{one['residual']:.4f}", f"{one['redundancy']:.3f}",
            *tests, f"{one['weight']:.2f}", _MARKS[one["is_rejected"], one["is_suspect"]],
        ))  # fmt: skip
    return aligned(cells)


def _check_table(points: Sequence[Mapping[str, Any]]) -> str:
    cells: list[tuple[str, ...]] = [("name", "dx", "dy", "dz", "sigma x", "sigma y", "sigma z", "chi-square (3)")]
    for one in points:
        numbers = [f"{value:.4f}" for value in (*one["difference"], *one["sigma"])]
        cells.append((one["name"], *numbers, f"{one['normalized_square']:.2f}"))
    return aligned(cells)


def _section(title: str, text: str) -> str:
    return f"{title}\n{'-' * len(title)}\n{text}\n"


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Return rows of cells with their columns aligned: the first to the left, others to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for first, *rest in rows:
        cells = [cell.rjust(width) for cell, width in zip(rest, widths[1:], strict=True)]
        lines.append("  ".join([first.ljust(widths[0]), *cells]).rstrip())
    return "\n".join(lines)
