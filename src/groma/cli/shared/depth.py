# SPDX-License-Identifier: BSD-3-Clause
"""Options and messages of commands that take depth maps of photographs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from groma._counted import counted
from groma.cli.shared.command import Panel
from groma.cli.shared.input import refuse_idle
from groma.errors import InputError

if TYPE_CHECKING:
    from groma.cli.shared.console import Console
    from groma.io.depth_maps import DepthMaps

PANEL = Panel("Depth maps")
Depth = Annotated[
    Path | None,
    PANEL.option(
        "Depth maps with the names and proportions of the photographs: 16-bit PNG (millimetres), .npy, .npz or TIFF "
        "(metres), or COLMAP's; they define the unit of length.",
        metavar="FOLDER",
    ),
]
DepthScale = Annotated[
    float | None, PANEL.option("Depth values per metre. Default: 1000 for integers, 1 for floating point.", metavar="S")
]
RelativeDepth = Annotated[
    bool,
    PANEL.option(
        "Estimate a scale for each depth map, as for monocular depth networks.", "--relative-depth/--metric-depth"
    ),
]


def depth_maps(folder: Path | None, scale: float | None, relative: bool, images: Path) -> DepthMaps | None:
    """Return the depth maps of the options; None without a folder."""
    from groma.io.depth_maps import DepthMaps

    refuse_idle(
        ("--depth-scale", scale is not None and folder is None, "with --depth"),
        ("--relative-depth", relative and folder is None, "with --depth"),
    )
    if folder is None:
        return None
    if images.absolute() in (folder.absolute(), *folder.absolute().parents):
        raise InputError(f"{folder} lies in {images}: its files would be taken for photographs. Move it elsewhere.")
    return DepthMaps(folder, scale, relative)


def say_depth(console: Console, numbers: dict[str, Any]) -> None:
    """Print the accuracy of depth maps: the entry ``depth`` of ``summary.json``."""
    if not numbers:
        return
    what = f"{counted(numbers['num_point_depths'], 'depths')} of points in {counted(numbers['num_maps'], 'maps')}"
    middle, sigma = numbers["median_depth"], numbers["sigma_at_median"]
    if numbers["unit"] == "relative":
        console.say(
            f"Depth up to scale: {what}, good to {100 * sigma / middle:.1f} %. A scale of each map was estimated."
        )
        return
    unit = "" if numbers["scale"] == 1.0 else f" (1 unit of the model was {numbers['scale']:.4g})"
    console.say(
        f"Depth: {what}, median {middle:.3g}, good to {sigma:.2g} there. The map has their unit of length{unit}."
    )
