# SPDX-License-Identifier: BSD-3-Clause
"""Options that every command shares."""

from pathlib import Path
from typing import Annotated

import typer

from groma.cli.shared import command as _complete
from groma.cli.shared.command import GENERAL, PLAIN, Panel

#: Headings of ``--help`` under which the options of the long commands stand.
CAMERAS, LANDMARKS = Panel("Cameras and poses"), Panel("Points, lines and planes")
ADJUSTMENT, RESULTS = Panel("Adjustment"), Panel("Results")

Seed = Annotated[int, GENERAL.option("Seed of the random numbers.", min=0, metavar="N")]
Force = Annotated[bool, PLAIN.option("Replace what is there.", "--force", "-f")]
#: Of commands that write nothing but a report for machines.
ForceReport = Annotated[bool, GENERAL.option("Replace the file of --json.", "--force", "-f")]
Contributions = Annotated[
    bool,
    RESULTS.option(
        "Also adjust with points only, with lines and with planes, and report what each contributes.", "--contributions"
    ),
]
Truth = Annotated[
    Path | None,
    RESULTS.option("With --contributions: a scene to compare the camera poses with, by name.", metavar="SCENE"),
]
LineDetector = Annotated[
    str,
    LANDMARKS.option(
        "Line segment detector: lsd, onnx:FILE (a network like M-LSD), or a detector of an installed package.",
        choices=_complete.DETECTORS,
        metavar="NAME",
    ),
]
RollingShutter = Annotated[
    str | None,
    CAMERAS.option(
        "Model a rolling shutter, read by rows (or columns, for photographs rotated afterwards): estimate the camera "
        "motion during readout.",
        metavar="rows|columns",
    ),
]
Input = Annotated[
    Path,
    typer.Argument(
        metavar="INPUT",
        help="COLMAP model folder, groma archive (.npz), BAL, Bundler, VisualSFM, OpenMVG, Meshroom, Metashape, "
        "OpenSfM or nerfstudio file, cameras.json of Gaussian splats.",
    ),
]
