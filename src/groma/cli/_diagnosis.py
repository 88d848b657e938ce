# SPDX-License-Identifier: BSD-3-Clause
"""The diagnosis as commands make and say it: never in the way of the result it is about."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from groma.cli._console import Console
    from groma.scene import Scene
    from groma.solver.diagnosis import Diagnosis

#: Scenes of more images are diagnosed only when asked for.
MANY_IMAGES = 300


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


def say_diagnosis(diagnosis: Mapping[str, Any] | None, console: Console) -> None:
    """Say the problems, and with --verbose all findings."""
    if diagnosis is None:
        return
    for finding in diagnosis["findings"]:
        (console.say if finding["severity"] == "problem" else console.detail)(f"  {finding['sentence']}")
