# SPDX-License-Identifier: BSD-3-Clause
"""The numbers of an adjustment as lines of text."""

from collections.abc import Mapping
from typing import Any

_KINDS = (("images", "num_images"), ("points", "num_points"), ("lines", "num_lines"), ("planes", "num_planes"))


def describe(numbers: Mapping[str, Any], sentence: str, verbose: bool = False, fresh: bool = False) -> list[str]:
    """Return what a reader wants to know after an adjustment, most important first.

    Parameters
    ----------
    numbers : mapping
        The report as a dictionary (the content of ``--json``).
    sentence : str
        Why the solver stopped.
    verbose : bool
        Add the seconds per stage.
    fresh : bool
        Say that the time includes compilation.
    """
    counts = ", ".join(f"{numbers[key]:,} {name}" for name, key in _KINDS if numbers.get(key))
    lines = [f"{counts}, {numbers['num_observations']:,} observations"]
    for kind, rmse in numbers.get("rmse_px", {}).items():
        if rmse.get("before") is not None and rmse.get("after") is not None:
            lines.append(f"  {kind + ' error':<16}{rmse['before']:>10.3f} px  ->{rmse['after']:>9.3f} px   (rms)")
    lines.append(f"  {'cost':<16}{numbers['initial_cost']:>10.5g}     ->{numbers['final_cost']:>9.5g}")
    grew = any((rmse.get("after") or 0) > (rmse.get("before") or 0) for rmse in numbers.get("rmse_px", {}).values())
    if grew and numbers["final_cost"] < numbers["initial_cost"]:
        lines.append("  The rms counts wrong matches in full and may grow; the robust cost, which doubts them, fell.")
    seconds = numbers["seconds"]
    compiled = " (with compilation)" if fresh else ""
    lines.append(f"  {numbers['iterations']} steps in {seconds['total']:.2f} s{compiled}. {sentence}")
    if verbose:
        stages = ", ".join(f"{name} {value:.3f} s" for name, value in seconds.items() if name != "total")
        lines.append(f"  stages: {stages}")
    return lines
