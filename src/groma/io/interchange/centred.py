# SPDX-License-Identifier: BSD-3-Clause
"""Scenes of text formats with pixels relative to the image centre and without image sizes.

The size is read from the photographs where they lie beside the file. Where it is known, pixels count from the corner as
everywhere here; else the camera has the model BAL or a principal point at (0, 0), and pixels count from the centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from groma._rows import numbered
from groma._typing import FloatArray, IntArray
from groma.errors import FileFormatError
from groma.io.interchange.calibration import Calibration, camera_table
from groma.io.interchange.poses import checked_rows, points_table
from groma.scene import PointObservations, Scene


@dataclass(frozen=True, eq=False)
class PointRows:
    """Points with colours and the views of each, parsed from a list of numbers."""

    #: (P, 3) places, and (P, 3) colours from 0 to 255.
    xyz: FloatArray
    color: FloatArray
    #: (N,) point and image of each view, and (N, 2) its pixel.
    point_idx: IntArray
    image_idx: IntArray
    pixel: FloatArray


def point_rows(numbers: FloatArray, count: int, path: Path) -> PointRows:
    """Read ``count`` points, each ``x y z r g b n`` and n times ``image feature u v``.

    Raises
    ------
    FileFormatError
        If the numbers end too early or late, or a count or an image is no whole number.
    """
    starts = np.zeros(count + 1, np.int64)
    at, size, listed = 0, len(numbers), numbers.tolist() if count else []
    for row in range(count):
        views = listed[at + 6] if at + 6 < size else -1.0
        if not (0 <= views <= size) or views != int(views) or at + 7 + 4 * int(views) > size:
            raise FileFormatError(
                f"{path}: point {row + 1} of {count} should have a place, a colour and a list of views; the file ends "
                "or the list is damaged. Fetch or write it again."
            )
        at += 7 + 4 * int(views)
        starts[row + 1] = at
    if at != size:
        raise FileFormatError(f"{path} has {size - at} numbers too many for its counts.")
    head = starts[:-1, None] + np.arange(6)
    point_idx, within = numbered((np.diff(starts) - 7) // 4)
    views = numbers[(starts[point_idx] + 7 + 4 * within)[:, None] + np.arange(4)]
    if (views[:, 0] != np.floor(views[:, 0])).any() or (np.abs(views[:, 0]) > 2**31).any():
        raise FileFormatError(f"{path}: a view names an image by a number that is not whole. Correct the file.")
    points = numbers[head].reshape(-1, 6)
    return PointRows(points[:, :3], points[:, 3:], point_idx, views[:, 0].astype(np.int64), views[:, 2:])


def centred_scene(
    names: list[str], calibrations: list[Calibration], poses: FloatArray, posed: IntArray, rows: PointRows, path: Path
) -> Scene:
    """Return the scene of images of which those ``posed`` (rows of the file) have a pose and are kept.

    Calibrations and poses are of the images kept; pixels are in our axes, from the centre.
    """
    total = len(names)
    new_row = np.full(total, -1)
    new_row[posed] = np.arange(len(posed))
    image = new_row[checked_rows(rows.image_idx, total, path)] if len(rows.image_idx) else rows.image_idx
    kept = image >= 0
    shift = np.array([one.size for one in calibrations], float).reshape(-1, 2) / 2
    pixel = rows.pixel[kept] + shift[image[kept]]
    return Scene.from_images(
        camera_table(calibrations, path),
        [names[row] for row in posed.tolist()],
        np.arange(len(posed)),
        poses,
        points=points_table(np.arange(len(rows.xyz)) + 1, rows.xyz, rows.color, path),
        point_observations=PointObservations.numbered(image[kept], rows.point_idx[kept], pixel),
    )
