# SPDX-License-Identifier: BSD-3-Clause
"""The diagnosis as commands make and say it: never in the way of the result it is about."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from groma.cli.shared.console import Console
    from groma.solver.observability.diagnosis import Diagnosis

#: The stage as it is said.
DIAGNOSING = "finding what the data determine"


def try_diagnosis(
    make: Callable[[], Diagnosis], num_images: int, console: Console, wanted: bool | None = None
) -> Diagnosis | None:
    """Return what ``make`` finds; None if it is not wanted or not possible, which is said.

    Parameters
    ----------
    make : callable
        Makes the diagnosis.
    num_images : int
        Images of the scene.
    console : Console
        Where reasons are said.
    wanted : bool, optional
        None: unless there are many images.
    """
    from groma.adjustment.diagnosis import MANY_IMAGES

    if wanted is None and num_images > MANY_IMAGES:
        console.detail(f"More than {MANY_IMAGES} images: no diagnosis; --diagnosis asks for it.")
        return None
    if wanted is False:
        return None
    try:
        with console.stages() as say:
            say(DIAGNOSING, 0, 1)
            return make()
    except Exception as error:  # whatever it is, the result of the command is worth more
        console.warn(f"The diagnosis failed: {error}")
        return None


def say_diagnosis(diagnosis: Mapping[str, Any] | None, console: Console) -> None:
    """Say the problems, and with --verbose all findings."""
    if diagnosis is None:
        return
    for finding in diagnosis["findings"]:
        (console.say if finding["severity"] == "problem" else console.detail)(f"  {finding['sentence']}")
