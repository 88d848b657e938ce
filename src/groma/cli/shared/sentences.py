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
_GAUGES = {
    "inner": "all camera centres together",
    "held": "the first camera and the scale",
    "measured": "the measurements",
}
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
    lines += describe_inliers(numbers.get("inliers") or {})
    lines.append(f"  {'cost':<16}{numbers['initial_cost']:>10.5g}     -> {numbers['final_cost']:>9.5g}")
    lines += describe_pose_uncertainty(numbers.get("pose_uncertainty"))
    seconds = numbers["seconds"]
    time = spent(seconds["total"], seconds.get("compilation", 0.0), compiled)
    lines.append(f"  {counted(numbers['iterations'], 'steps')} in {time}. {sentence}")
    if verbose:
        lines += describe_relations(numbers.get("relations") or {})
        for kind, rmse in numbers.get("rmse_px", {}).items():
            lines.append(f"  rms of all {kind}, outliers included: {rmse['before']:.3f} px -> {rmse['after']:.3f} px")
        stages = ", ".join(f"{name} {value:.3f} s" for name, value in seconds.items() if name not in _NO_STAGES)
        lines.append(f"  stages: {stages} (compiled code included)")
    return lines


def describe_inliers(found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a line for each kind of landmark, such as ``points  5.201 px -> 0.331 px, rms of 97.4 % inliers ...``."""
    return [
        f"  {kind + ' error':<16}{numbers['rmse_px']['before']:>10.3f} px  -> {numbers['rmse_px']['after']:>9.3f} px   "
        f"(rms of the inliers: {100 * numbers['share']['after']:.1f} % within {numbers['limit_px']:.2g} px, before "
        f"{100 * numbers['share']['before']:.1f} %)"
        for kind, numbers in found.items()
    ]


def describe_pose_uncertainty(numbers: Mapping[str, Any] | None) -> list[str]:
    """Return how well the cameras are known; ``numbers`` is ``pose_uncertainty`` of a report."""
    if numbers is None or numbers["center"]["median"] is None:
        return []
    center, turn = numbers["center"], numbers["rotation_deg"]
    return [
        f"  cameras: centres known to {center['median']:.2g} (largest {center['largest']:.2g}), rotations to "
        f"{turn['median']:.2g}° (largest {turn['largest']:.2g}°): standard deviations relative to "
        f"{_GAUGES[numbers['gauge']]}"
    ]


def describe_relations(relations: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Return how many relations between landmarks of each kind hold, and how many the robust loss gave up."""
    return [
        f"  {name.replace('_', ' ')}: {outcome['held']:,} hold, {outcome['dropped']:,} given up"
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
