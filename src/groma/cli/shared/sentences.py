# SPDX-License-Identifier: BSD-3-Clause
"""Numbers as lines of text: of an adjustment, its uncertainties, its contributions, and what a scene determines."""

from collections.abc import Mapping, Sequence
from typing import Any

from groma._counted import counted

_SIGMAS = (
    ("centres", "center", ""),
    ("rotations", "rotation_deg", "°"),
    ("points", "point", ""),
    ("segment ends across their line", "segment_end", ""),
    ("line directions", "line_direction_deg", "°"),
    ("plane normals", "plane_normal_deg", "°"),
)
#: Times in reports that are not of one stage.
_NO_STAGES = ("total", "compilation")


def describe(numbers: Mapping[str, Any], sentence: str, verbose: bool = False, compiled: bool = False) -> list[str]:
    """Return what a reader wants to know after an adjustment, most important first.

    Parameters
    ----------
    numbers : mapping
        The report as a dictionary (the content of ``--json``).
    sentence : str
        Why the solver stopped.
    verbose : bool
        Add the relations between landmarks and the seconds per stage.
    compiled : bool
        Whether code was compiled, and not only loaded.
    """
    kinds = ("images", "points", "lines", "planes", "observations")
    lines = [", ".join(counted(numbers[f"num_{kind}"], kind) for kind in kinds if numbers.get(f"num_{kind}"))]
    if others := numbers.get("num_measurements"):
        lines.append("  also measured: " + ", ".join(f"{count:,} {name}" for name, count in others.items()))
    for kind, rmse in numbers.get("rmse_px", {}).items():
        if rmse.get("before") is not None and rmse.get("after") is not None:
            lines.append(f"  {kind + ' error':<16}{rmse['before']:>10.3f} px  -> {rmse['after']:>9.3f} px   (rms)")
    lines.append(f"  {'cost':<16}{numbers['initial_cost']:>10.5g}     -> {numbers['final_cost']:>9.5g}")
    grew = any((rmse.get("after") or 0) > (rmse.get("before") or 0) for rmse in numbers.get("rmse_px", {}).values())
    if grew and numbers["final_cost"] < numbers["initial_cost"]:
        lines.append("  The rms includes outliers, so it may grow although the robust cost fell.")
    seconds = numbers["seconds"]
    time = spent(seconds["total"], seconds.get("compilation", 0.0), compiled)
    lines.append(f"  {counted(numbers['iterations'], 'steps')} in {time}. {sentence}")
    if verbose:
        lines += describe_relations(numbers.get("relations") or {})
        stages = ", ".join(f"{name} {value:.3f} s" for name, value in seconds.items() if name not in _NO_STAGES)
        lines.append(f"  stages: {stages} (compiled code included)")
    return lines


def describe_relations(relations: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Return how many relations between landmarks of each kind hold, and how many the robust loss gave up."""
    return [
        f"  {name.replace('_', ' ')}: {outcome['held']:,} hold, {outcome['dropped']:,} given up"
        for name, outcome in relations.items()
    ]


def describe_uncertainty(numbers: Mapping[str, Any]) -> list[str]:
    """Return the usual standard deviations of each kind; ``numbers`` is that of an uncertainty as a dictionary."""
    gauge = {"inner": "all camera centres together", "held": "the first camera and the scale"}[numbers["gauge"]]
    parts = [
        f"{words} {numbers[key]['median']:.3g}{unit}"
        for words, key, unit in _SIGMAS
        if numbers[key]["median"] is not None
    ]
    lines = [f"  Standard deviations (medians, at sigma0 {numbers['sigma0']:.3g}, relative to {gauge}):"]
    lines += [f"    {', '.join(parts)}" if parts else "    nothing has any"]
    left = sum(numbers[key]["undetermined"] for key in ("point", "segment_end", "plane_normal_deg"))
    if left:
        lines.append(f"    {left:,} points, segment ends and planes are not determined and have none")
    return lines


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


def spent(total: float, compilation: float, compiled: bool) -> str:
    """Return for example ``0.13 s, and 0.98 s to load compiled code``.

    Parameters
    ----------
    total, compilation : float
        Seconds of the work as a whole, and those of them that went into compiled code.
    compiled : bool
        Whether it was compiled, and not only loaded.
    """
    apart = f", and {compilation:.2f} s to {'compile' if compiled else 'load compiled code'}"
    return f"{max(total - compilation, 0.0):.2f} s{apart if compilation >= 0.005 else ''}"
