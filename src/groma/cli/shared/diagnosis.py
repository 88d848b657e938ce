# SPDX-License-Identifier: BSD-3-Clause
"""The diagnosis of commands; if it fails, the result is written all the same."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from groma.cli.shared.console import Console
    from groma.solver.observability.diagnosis import Diagnosis

#: Name of the stage.
DIAGNOSING = "finding what the data determine"


def try_diagnosis(
    make: Callable[[], Diagnosis], num_images: int, console: Console, wanted: bool | None = None
) -> Diagnosis | None:
    """Return the diagnosis; None, with a message, if it is not requested or fails.

    Parameters
    ----------
    make : callable
        Makes the diagnosis.
    num_images : int
        Images of the scene.
    console : Console
        Prints the reason.
    wanted : bool, optional
        None: up to a number of images.
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
    except Exception as error:  # of any kind: the result must not be lost for it
        console.warn(f"The diagnosis failed: {error}")
        return None


def say_diagnosis(diagnosis: Mapping[str, Any] | None, console: Console) -> None:
    """Print the problems, with --verbose all findings."""
    if diagnosis is None:
        return
    for finding in diagnosis["findings"]:
        (console.say if finding["severity"] == "problem" else console.detail)(f"  {finding['sentence']}")
