# SPDX-License-Identifier: BSD-3-Clause
"""``groma align``: a scene into the frame of another one, or of measurements."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from groma.cli.shared import measurements as _measured
from groma.cli.shared import options as _options
from groma.cli.shared.console import Console
from groma.errors import InputError

if TYPE_CHECKING:
    from groma.adjustment.survey.align import Alignment

#: Rows of the table of largest residuals (convention: what a screen can hold).
_LISTED = 5


def align(
    console: Console,
    source: _options.Input,
    reference: Annotated[
        Path | None, typer.Argument(metavar="REFERENCE", help="A scene with images of the same names, of any format.")
    ] = None,
    output: Annotated[
        Path | None, _options.PLAIN.option("Folder or file for the aligned scene.", "--output", "-o", metavar="OUT")
    ] = None,
    positions: _measured.Positions = None,
    control: _measured.Control = None,
    crs: _measured.Crs = None,
    force: _options.Force = False,
) -> None:
    """Align a scene with a reference by a robust similarity.

    The reference is another scene, measured camera positions or control points. Nothing is adjusted: to use
    measurements in an adjustment, pass them to groma adjust or groma map.
    """
    from groma.cli.shared import output as _output
    from groma.cli.shared.input import check_inputs

    measured = _measured.Measured(
        positions=positions, position_sigma="1" if positions else None,
        control=control, control_sigma="1" if control else None, crs=crs,
    )  # fmt: skip
    measured.validate()
    if (reference is None) == (not measured):
        raise InputError("Pass either a REFERENCE scene, or --positions or --control.")
    _output.check_outputs(force, output, json_target=console.json_target)
    check_inputs(source, reference, *measured.files)

    from groma.adjustment.survey.align import align as aligned
    from groma.io import check_target, read_scene, structures_of, write_scene

    scene = read_scene(source)
    if output is not None:
        check_target(scene, output)
    target = measured.read(None, lambda: scene.images.names) if reference is None else read_scene(reference)
    found = aligned(scene, target)
    if output is not None:
        write_scene(found.scene, output, force=force, like=structures_of(source))
    _say(console, found)
    if output is not None:
        console.wrote(output)
    else:
        console.say("No -o given: the moved scene was not written.")
    _output.write_json(console.json_target, found.to_dict(), force)


def _say(console: Console, found: "Alignment") -> None:
    import numpy as np

    distance = np.linalg.norm(found.residuals, axis=1)
    console.say(
        f"Scale {found.similarity.scale:.8g}; {int(found.inliers.sum())} of {len(found.names)} places used, rmse "
        f"{found.rmse:.4g}, largest {distance[found.inliers].max():.4g}."
    )
    if found.angles is not None:
        console.say(f"Orientations differ by {np.degrees(np.median(found.angles)):.3g} degrees (median).")
    worst = np.argsort(-distance)[:_LISTED]
    rows = [
        [
            found.names[row],
            f"{distance[row]:.4g}",
            *(f"{value:.4g}" for value in found.residuals[row]),
            "used" if found.inliers[row] else "left out",
        ]
        for row in worst
    ]
    console.table(("largest residuals", "off by", "x", "y", "z", ""), rows)
    console.say(*found.notes)
