# SPDX-License-Identifier: BSD-3-Clause
"""Options that every command shares."""

from pathlib import Path
from typing import Annotated

import typer

from groma.cli.shared import command as _complete
from groma.cli.shared.command import GENERAL

#: Headings of ``--help`` under which the options of the long commands stand.
CAMERAS, LANDMARKS, ADJUSTMENT, RESULTS = "Cameras and poses", "Points, lines and planes", "Adjustment", "Results"

Json = Annotated[
    str | None,
    typer.Option(
        "--json",
        metavar="FILE",
        help="Write a machine-readable report to FILE; '-' is standard output.",
        rich_help_panel=GENERAL,
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.", rich_help_panel=GENERAL)]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Say more.", rich_help_panel=GENERAL)]
Threads = Annotated[
    int | None,
    typer.Option(
        "--threads",
        min=1,
        metavar="N",
        help="Use at most N threads. Default: one per core, where that pays.",
        rich_help_panel=GENERAL,
    ),
]
Seed = Annotated[
    int, typer.Option("--seed", min=0, metavar="N", help="Seed of the random numbers.", rich_help_panel=GENERAL)
]
#: Of commands that draw no random numbers: accepted, so that a script can pass it to every command, and not shown.
NoSeed = Annotated[int, typer.Option("--seed", min=0, hidden=True)]
Force = Annotated[bool, typer.Option("--force", "-f", help="Replace what is there.")]
Contributions = Annotated[
    bool,
    typer.Option(
        "--contributions",
        help="Also adjust by points alone, with lines, with planes, and say what each of them changes.",
        rich_help_panel=RESULTS,
    ),
]
Truth = Annotated[
    Path | None,
    typer.Option(
        "--truth",
        metavar="SCENE",
        help="With --contributions: a scene to compare the camera poses with, by name.",
        rich_help_panel=RESULTS,
    ),
]
LineDetector = Annotated[
    str,
    typer.Option(
        "--line-detector",
        autocompletion=_complete.one_of(*_complete.DETECTORS),
        metavar="NAME",
        help="What finds line segments: lsd, onnx:FILE (a network like M-LSD), or a detector of an installed package.",
        rich_help_panel=LANDMARKS,
    ),
]
RollingShutter = Annotated[
    str | None,
    typer.Option(
        "--rolling-shutter",
        metavar="rows|columns",
        help="Images were read row by row (or column by column: photographs turned upright): estimate how the camera "
        "moved meanwhile.",
        rich_help_panel=CAMERAS,
    ),
]
Input = Annotated[
    Path,
    typer.Argument(
        metavar="INPUT",
        help="COLMAP model folder, groma archive (.npz), BAL, Bundler, VisualSFM, OpenMVG, OpenSfM or nerfstudio file.",
    ),
]
