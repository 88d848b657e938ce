# SPDX-License-Identifier: BSD-3-Clause
"""The numbers of an adjustment in one dictionary: report, diagnosis, contributions, warnings. Goes into JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from groma.adjustment.adjust import AdjustReport
    from groma.adjustment.contributions import Contribution
    from groma.solver.observability.diagnosis import Diagnosis

#: An adjustment creeps if, after so many accepted steps, one lowers the cost by less than this share.
CREEPING_STEPS, CREEPING = 10, 0.2


def summarize(
    report: AdjustReport, diagnosis: Diagnosis | None = None, contributions: Sequence[Contribution] = ()
) -> dict[str, Any]:
    """Return the numbers of an adjustment as plain values.

    Parameters
    ----------
    report : AdjustReport
        How it went.
    diagnosis : Diagnosis, optional
        What the data determine, of the adjusted scene.
    contributions : sequence of Contribution
        The same adjustment with fewer kinds of landmarks.
    """
    numbers = report.to_dict()
    if contributions:
        numbers["contributions"] = [entry.to_dict() for entry in contributions]
    numbers["diagnosis"] = None if diagnosis is None else diagnosis.to_dict()
    numbers["warnings"] = [*report.warnings, *why_steps_ran_out(numbers)]
    return numbers


def why_steps_ran_out(numbers: Mapping[str, Any]) -> list[str]:
    """Return a sentence for an adjustment that crept along unobservable directions of the cameras to its last step.

    Along an unobservable direction the cost is nearly flat and bent, so steps follow it for long; neither more of them
    nor a robust loss would make a result that can be relied on.
    """
    diagnosis = numbers.get("diagnosis")
    if numbers["termination"] != "max_iterations" or diagnosis is None or not diagnosis["num_open_directions"]:
        return []
    costs = [step["cost"] for step in numbers["history"] if step["accepted"]]
    if len(costs) < CREEPING_STEPS or costs[-1] < (1.0 - CREEPING) * costs[-2]:
        return []
    return [
        "The steps ran out where the data leave cameras or calibrations open: along these the cost falls slowly, and "
        "wherever more steps end is one result of many. Hold them, or add data."
    ]


__all__ = ["summarize", "why_steps_ran_out"]
