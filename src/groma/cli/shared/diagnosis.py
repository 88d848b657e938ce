# SPDX-License-Identifier: BSD-3-Clause
"""The diagnosis as commands make and say it: never in the way of the result it is about."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from groma.cli.shared.console import Console
    from groma.scene import Scene
    from groma.solver.observability.diagnosis import Diagnosis

#: Scenes of more images are diagnosed only when asked for.
MANY_IMAGES = 300
#: An adjustment creeps if, after so many accepted steps, one lowers the cost by less than this share.
CREEPING_STEPS, CREEPING = 10, 0.2


def diagnosis_of(
    scene: Scene, make: Callable[[], Diagnosis], console: Console, wanted: bool | None = None
) -> dict[str, Any] | None:
    """Return what ``make`` finds as plain values; None if it is not wanted or not possible, which is said.

    Parameters
    ----------
    scene : Scene
        What is diagnosed.
    make : callable
        Makes the diagnosis.
    console : Console
        Where reasons are said.
    wanted : bool, optional
        None: unless there are many images.
    """
    if wanted is None and scene.num_images > MANY_IMAGES:
        console.detail(f"More than {MANY_IMAGES} images: no diagnosis; --diagnosis asks for it.")
        return None
    if wanted is False:
        return None
    try:
        return make().to_dict()
    except Exception as error:  # whatever it is, the result of the command is worth more
        console.warn(f"What the data determine could not be found out: {error}")
        return None


def why_steps_ran_out(numbers: Mapping[str, Any]) -> list[str]:
    """Return a sentence for an adjustment that crept along what is open of cameras and calibrations to its last step.

    Along what the data leave open the cost is nearly flat and bent, so steps follow it for long; neither more of them
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


def say_diagnosis(diagnosis: Mapping[str, Any] | None, console: Console) -> None:
    """Say the problems, and with --verbose all findings."""
    if diagnosis is None:
        return
    for finding in diagnosis["findings"]:
        (console.say if finding["severity"] == "problem" else console.detail)(f"  {finding['sentence']}")
