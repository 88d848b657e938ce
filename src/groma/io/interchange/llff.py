# SPDX-License-Identifier: BSD-3-Clause
r"""Cameras and poses of LLFF, NeRF and mip-NeRF 360: ``poses_bounds.npy``.

A row has 17 numbers: a matrix of 3 x 5, row by row, and the depths of the nearest and farthest point, which are not
read. The matrix is :math:`[R_{wc} \mid c \mid (h, w, f)^\top]`, with columns of the rotation that point down, right
and backwards in the image. Principal points are in the middle. Rows have no names: they are in the order of the
names of the photographs, character by character.

Reference: the README of Fyusion/LLFF, *Using your own poses without running COLMAP*.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from groma._typing import FloatArray
from groma.bounded.arrays import Header, read_array
from groma.errors import FileFormatError
from groma.io.interchange.calibration import Calibration
from groma.io.interchange.poses import rigid
from groma.io.pose_conventions import LLFF

#: What an ``.npy`` file begins with.
MAGIC = b"\x93NUMPY"
#: Largest width and height (derived: what 32 bits hold, as in all formats).
_LARGEST = 2**31 - 1


def read_llff(path: Path) -> tuple[FloatArray, list[Calibration]]:
    """Read poses (N, 7) and the camera of each.

    Raises
    ------
    FileFormatError
        If it holds another array, or its numbers are no cameras.
    """

    def check(header: Header) -> None:
        if len(header.shape) != 2 or header.shape[1] != 17 or header.dtype.kind not in "iuf":
            raise FileFormatError(
                f"{path}: expected an array of N x 17 numbers, as poses_bounds.npy of LLFF and NeRF; got "
                f"{' x '.join(map(str, header.shape)) or 'one number'}. Pass another file of poses."
            )

    rows = read_array(path, check)[:, :15].astype(float).reshape(-1, 3, 5)
    if not np.isfinite(rows).all():
        raise FileFormatError(f"{path}: numbers are missing or infinite. Write it again.")
    sizes, focal = rows[:, :2, 4], rows[:, 2, 4]
    if ((sizes < 1) | (sizes > _LARGEST) | (sizes != np.floor(sizes))).any():
        raise FileFormatError(f"{path}: expected heights and widths in whole pixels. Write it again.")
    calibrations = [
        Calibration("SIMPLE_PINHOLE", (f, w / 2, h / 2), (int(w), int(h)))
        for (h, w), f in zip(sizes.tolist(), focal.tolist(), strict=True)
    ]
    return rigid(rows[:, :, :3], rows[:, :, 3], path, LLFF), calibrations
