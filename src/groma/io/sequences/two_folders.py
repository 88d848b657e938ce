# SPDX-License-Identifier: BSD-3-Clause
"""Colour and depth in two folders without lists, as Open3D, ScanNet and recorders of depth cameras write them.

Colour lies in ``rgb``, ``color``, ``image`` or ``images``, depth in ``depth``; or both in one folder, or ``results`` in
it, where the names of depth images contain "depth" (Replica). Images whose names are seconds (as those
of TUM RGB-D) are paired by time, others by the last number in their names.
Numbers in files of integers are millimetres, or 1/5000 of a metre where names are seconds; floats are metres.
"""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np

from groma._counted import counted
from groma.bounded.images import decoded
from groma.errors import FileFormatError, InputError
from groma.io.sequences import tum_rgbd
from groma.io.sequences._reader import Entry, FileSequence, Preparation, simple_sequence
from groma.io.sequences.images import camera_for, images_in, reference_of, times_of
from groma.io.sequences.layouts import Wishes

#: Folders of colour, those that others are named after first (belongs to the format).
COLOR = ("rgb", "color", "image", "images")
#: Folder of depth (belongs to the format).
DEPTH = "depth"
#: Numbers in files of integers per metre (convention: millimetres).
DEPTH_SCALE = 1000.0


def is_two_folders(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return all(_images(folder))


def number_of(path: Path) -> int | str:
    """Return the last number in the name of an image, else the name."""
    digits = re.findall(r"\d+", path.stem)
    return int(digits[-1][-18:]) if digits else path.stem


def _images(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the images of colour and of depth; none of either where a folder has another layout."""
    depths = images_in(folder / DEPTH)
    if depths and (colors := next((found for name in COLOR if (found := images_in(folder / name))), None)):
        return colors, depths
    for place in (folder, folder / "results"):
        images = images_in(place)
        depths = [path for path in images if DEPTH in path.stem.lower()]
        colors = [path for path in images if DEPTH not in path.stem.lower()]
        if depths and {number_of(path) for path in depths} <= {number_of(path) for path in colors}:
            return colors, depths
    return [], []


def open_two_folders(folder: Path, wishes: Wishes) -> FileSequence:
    """Open a folder; see :func:`groma.io.sequences.open_sequence`."""
    colors, depths = _images(folder)
    calibration = camera_for(folder, wishes, folder, colors[0].parent)
    warnings: list[str] = []
    kind = wishes.selection.kind_of("rgbd")
    pairs = _pairs(colors, depths)
    entries = [
        Entry(time, path, depths[pairs[row]] if row in pairs else None)
        for row, (time, path) in enumerate(zip(times_of(folder, colors), colors, strict=True))
    ]
    depth_scale = wishes.depth_scale or calibration.depth_scale
    if depth_scale is None:
        depth_scale = _scale(depths)
        if kind == "rgbd" and depth_scale != 1.0:
            warnings.append(
                f"Nothing in {folder} says the unit of the depth images; {depth_scale:g} is taken for a metre. Pass "
                "--depth-scale (depth_scale=) if it is another."
            )
    preparation = Preparation(depth_scale=depth_scale)
    return simple_sequence(
        kind, wishes.selection.of(entries, warnings), calibration, reference_of(folder), warnings, preparation
    )


def _are_seconds(images: list[Path]) -> bool:
    return all(re.fullmatch(r"\d+\.\d+", path.stem) for path in images)


def _pairs(colors: list[Path], depths: list[Path]) -> dict[int, int]:
    """Return the row of the depth image of each row of colour images."""
    if _are_seconds(colors) and _are_seconds(depths):
        first, second = (np.array([float(path.stem) for path in images]) for images in (colors, depths))
        pairs = dict(tum_rgbd.pair_by_time(first, second))
    else:
        row_of = {number_of(path): row for row, path in enumerate(depths)}
        pairs = {row: row_of[number_of(path)] for row, path in enumerate(colors) if number_of(path) in row_of}
    if not pairs:
        raise InputError(
            f"None of {counted(len(colors), 'colour images')}, such as {colors[0].name}, has the number or time of a "
            f"depth image, such as {depths[0].name}. Name them alike, or list them in associations.txt."
        )
    return pairs


def _scale(depths: list[Path]) -> float:
    try:
        first = decoded(depths[0].read_bytes(), cv2.IMREAD_UNCHANGED)
    except (OSError, FileFormatError):
        first = None
    if first is not None and first.dtype.kind == "f":
        return 1.0
    return tum_rgbd.DEPTH_SCALE if _are_seconds(depths) else DEPTH_SCALE
