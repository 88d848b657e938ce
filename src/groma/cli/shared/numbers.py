# SPDX-License-Identifier: BSD-3-Clause
"""The numbers of an adjustment as lines of text."""

from collections.abc import Mapping
from typing import Any

from groma._counted import counted
from groma.cli.shared.compilation import spent

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
        lines.append("  The rms counts wrong matches in full and may grow; the robust cost, which doubts them, fell.")
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
