# SPDX-License-Identifier: BSD-3-Clause
"""Numbers as tables and sentences: of an adjustment, its uncertainties, and what each kind of landmark contributes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from groma._counted import counted

if TYPE_CHECKING:
    from groma.cli.shared.console import Console
    from groma.compilation.time import Compilation

#: Content of a scene, in the order of the table.
KINDS = ("images", "points", "lines", "planes", "directions")
#: Header and rows.
Table = tuple[tuple[str, ...], list[list[str]]]

_SIGMAS = (
    ("centres", "center", ""),
    ("rotations", "rotation_deg", "°"),
    ("points", "point", ""),
    ("segment ends across their line", "segment_end", ""),
    ("line directions", "line_direction_deg", "°"),
    ("plane normals", "plane_normal_deg", "°"),
)
_GAUGES = {
    "inner": "all camera centres together",
    "held": "the first camera and the scale",
    "measured": "the measurements",
}
#: How much of the calibration the standard deviations take as exact.
_EXACT = {
    "all": "; the calibration counts as exact",
    "part": "; what is held of the calibration counts as exact",
    "none": "; errors of the estimated calibration are in them",
}
#: Times in reports that are not of one stage.
_NO_STAGES = ("total", "compilation")


def say_adjustment(
    console: Console, numbers: Mapping[str, Any], sentence: str, compilation: Compilation | None = None
) -> None:
    """Print the summary of an adjustment, most important first.

    Parameters
    ----------
    console : Console
        With --verbose also relations between landmarks and seconds per stage.
    numbers : mapping
        The report as a dictionary (the content of ``--json``).
    sentence : str
        Why the solver stopped.
    compilation : Compilation, optional
        Whether code was compiled, and not only loaded, and how long that took.
    """
    kinds = (*KINDS[:4], "observations")
    counts = {kind: numbers[f"num_{kind}"] for kind in kinds if numbers.get(f"num_{kind}")}
    console.table(*fit_table(counts | (numbers.get("num_measurements") or {}), numbers.get("inliers") or {}))
    seconds = numbers["seconds"]
    time = spent(seconds["total"], seconds.get("compilation", 0.0), compilation is not None and compilation.compiled)
    steps = counted(numbers["iterations"], "steps")
    console.say(f"Cost {numbers['initial_cost']:.5g} -> {numbers['final_cost']:.5g}, {steps} in {time}. {sentence}")
    console.say(*describe_pose_uncertainty(numbers.get("pose_uncertainty")))
    if not console.verbose:
        return
    console.say(*describe_relations(numbers.get("relations") or {}))
    for kind, rmse in numbers.get("rmse_px", {}).items():
        console.say(f"  rms of all {kind}, outliers included: {rmse['before']:.3f} px -> {rmse['after']:.3f} px")
    stages = ", ".join(f"{name} {value:.3f} s" for name, value in seconds.items() if name not in _NO_STAGES)
    console.say(f"  stages: {stages} (compiled code included)")


def fit_table(counts: Mapping[str, int], found: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return header and rows: the number of each kind, and the fit of landmarks, before and after.

    Parameters
    ----------
    counts : mapping
        Number of each kind.
    found : mapping
        Of landmarks: ``limit_px`` within which one is an inlier, and ``share`` and ``rmse_px`` of inliers before and
        after.
    """
    rows = []
    for kind in dict.fromkeys((*counts, *found)):
        row = [kind, f"{counts[kind]:,}" if kind in counts else ""]
        if (fit := found.get(kind)) is None:
            rows.append([*row, "", "", ""])
            continue
        error, share = fit["rmse_px"], fit["share"]
        row.append(f"{error['before']:.3f} -> {error['after']:>5.3f} px")
        row.append(f"{100 * share['before']:.1f} -> {100 * share['after']:>4.1f} %")
        rows.append([*row, f"{fit['limit_px']:.2g} px"])
    return ("", "number", "rms of inliers", "inliers", "within"), rows


def describe_pose_uncertainty(numbers: Mapping[str, Any] | None) -> list[str]:
    """Return how well the cameras are known; ``numbers`` is ``pose_uncertainty`` of a report."""
    if numbers is None:
        return []
    if numbers["center"]["median"] is None:
        why = numbers.get("why_not") or "The data determine none of them."
        return [f"Cameras: how well they are known cannot be told. {why}"]
    center, turn = numbers["center"], numbers["rotation_deg"]
    return [
        f"Cameras: centres known to {center['median']:.2g} (largest {center['largest']:.2g}), rotations to "
        f"{turn['median']:.2g}° (largest {turn['largest']:.2g}°): standard deviations relative to "
        f"{_GAUGES[numbers['gauge']]}{_EXACT[numbers['calibration']]}"
    ]


def describe_structure(relations: Mapping[str, int]) -> list[str]:
    """Return the numbers of parallel and right angles and of meeting lines; ``relations`` is ``num_relations``."""
    parallel = ("parallel_planes", "parallel_directions", "plane_across_direction")
    right = ("perpendicular_planes", "perpendicular_directions", "plane_along_direction")
    parts = [
        (sum(relations.get(kind, 0) for kind in kinds), words)
        for kinds, words in (
            (parallel, "parallel"),
            (right, "at right angles (pairs of planes and directions)"),
            (("lines_meeting",), "where lines meet"),
        )
    ]
    said = ", ".join(f"{count:,} {words}" for count, words in parts if count)
    return [f"Structure: {said}"] if said else []


def describe_relations(relations: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Return how many relations of each kind were kept, and how many the robust loss rejected."""
    return [
        f"  {name.replace('_', ' ')}: {outcome['held']:,} kept, {outcome['dropped']:,} rejected"
        for name, outcome in relations.items()
    ]


def describe_uncertainty(numbers: Mapping[str, Any]) -> list[str]:
    """Return the usual standard deviations of each kind; ``numbers`` is that of an uncertainty as a dictionary."""
    gauge = _GAUGES[numbers["gauge"]]
    parts = [
        f"{words} {numbers[key]['median']:.3g}{unit}"
        for words, key, unit in _SIGMAS
        if numbers[key]["median"] is not None
    ]
    lines = [f"Standard deviations (medians, at sigma0 {numbers['sigma0']:.3g}, relative to {gauge}):"]
    lines += [f"  {', '.join(parts)}" if parts else "  nothing has any"]
    left = sum(numbers[key]["undetermined"] for key in ("point", "segment_end", "plane_normal_deg"))
    if left:
        lines.append(f"  {left:,} points, segment ends and planes are not determined and have none")
    return lines


def say_contributions(console: Console, entries: Sequence[Mapping[str, Any]]) -> None:
    """Print what each kind of landmark changes, points alone first; the entries are those of ``--json``."""
    if not entries:
        return
    kinds = list(dict.fromkeys(kind for entry in entries for kind in entry["rmse_px"]))
    header = ["with", *(f"rms {kind}" for kind in kinds), "moved", "known to", "off"]
    console.say(
        "By kind of landmark: rms in pixels; how far camera centres moved, how well they are known, and how far off."
    )
    rows = []
    for number, entry in enumerate(entries):
        known, off = entry["center_sigma"], entry["center_error"]
        rows.append([
            ("and " if number else "") + entry["added"].replace(" and ", ", "),
            *(f"{entry['rmse_px'][kind]:.3f}" if kind in entry["rmse_px"] else "" for kind in kinds),
            f"{entry['moved']:.3g}" if number else "",
            "" if known is None else f"{known:.3g}",
            "" if off is None else f"{off:.3g}, {entry['rotation_error_deg']:.4f}°",
        ])  # fmt: skip
    console.table(header, rows)
    for number, entry in enumerate(entries):
        if entry["center_sigma"] is None and (number == 0 or not entries[number - 1]["center_sigma_missing"]):
            console.say(f"Centres not predicted with {entry['added']}: {entry['center_sigma_missing'].rstrip('.')}.")
        if entry["num_relations"]:
            given_up = f"{entry['num_dropped']:,} of {entry['num_relations']:,} relations rejected"
            console.say(f"With {entry['added']}: {given_up}.")


def spent(total: float, compilation: float, compiled: bool) -> str:
    """Return for example ``0.13 s, and 0.98 s to load compiled code``.

    Parameters
    ----------
    total, compilation : float
        Seconds in total, and those of compiling or loading code.
    compiled : bool
        Whether it was compiled, and not only loaded.
    """
    why = "compile" if compiled else "load compiled code"
    if compilation >= max(total, 0.005):  # reading counts, too: the time of the work itself is unknown
        return f"{compilation:.2f} s, nearly all to {why}"
    return f"{max(total - compilation, 0.0):.2f} s" + (
        f", and {compilation:.2f} s to {why}" if compilation >= 0.005 else ""
    )
