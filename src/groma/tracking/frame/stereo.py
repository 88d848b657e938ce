# SPDX-License-Identifier: BSD-3-Clause
"""Points in the right image of a rectified pair.

Where nothing is known, a dense comparison of blocks (OpenCV's StereoBM) gives the column to about a pixel;
Lucas-Kanade then refines it, and the point must stay near its row. Where the depth is known, only the refinement runs.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.features.images import GrayImage
from groma.features.point_tracks import POINT_TRACKS, follow
from groma.tracking.gates import DEFAULT, StereoGates

Disparities = npt.NDArray[np.float32]


def dense_disparities(left: GrayImage, right: GrayImage, gates: StereoGates = DEFAULT.stereo) -> Disparities:
    """Disparities (H, W) in pixels by comparison of blocks; 0 where unknown."""
    count = 16 * max(1, round(gates.max_disparity * left.shape[1] / 16))
    if min(left.shape) <= gates.block or left.shape[1] <= count + gates.block:
        return np.zeros(left.shape, np.float32)
    matcher = cv2.StereoBM.create(numDisparities=count, blockSize=gates.block)
    matcher.setUniquenessRatio(gates.uniqueness)
    matcher.setTextureThreshold(gates.texture)
    # OpenCV leaves out the columns at the left whose counterpart could be outside, and rounds sixteenths of a pixel up.
    wide = [cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    found = (matcher.compute(wide[0], wide[1])[:, count:].astype(np.float32) - 0.5) / 16.0  # derived from those
    column = np.arange(left.shape[1], dtype=np.float32)
    return np.where((found > 0.5) & (found < column - gates.block // 2), found, np.float32(0.0))


def match_right(
    left: GrayImage,
    right: GrayImage,
    pixels: FloatArray,
    expected: FloatArray,
    coarse: Disparities | None,
    gates: StereoGates = DEFAULT.stereo,
    into_image: Callable[[FloatArray], FloatArray] = lambda pixels: pixels,
    out_of_image: Callable[[FloatArray], FloatArray] = lambda pixels: pixels,
) -> FloatArray:
    """Pixels (N, 2) of points of the left image in the rectified right one; NaN where not found.

    ``expected`` (N,) are predicted columns; where they are NaN, the search starts at the disparities ``coarse``.
    The right image may be one that is not rectified: ``into_image`` moves rectified pixels there, and
    ``out_of_image`` back. Nothing is resampled, which would shift columns by hundredths of a pixel.
    """
    out = np.full((len(pixels), 2), np.nan)
    if not len(pixels):
        return out
    guess = np.asarray(expected, float).copy()
    unknown = ~np.isfinite(guess)
    if coarse is not None and unknown.any():
        height, width = left.shape
        around = _places_around(gates.around)
        # Beside a corner often only one side has a disparity: take the nearest one.
        row = np.clip(pixels[unknown, 1].astype(np.int64) + around[:, :1], 0, height - 1)
        column = np.clip(pixels[unknown, 0].astype(np.int64) + around[:, 1:], 0, width - 1)
        near = coarse[row, column]
        found = near[(near > 0).argmax(axis=0), np.arange(near.shape[1])]
        guess[unknown] = np.where(found > 0, pixels[unknown, 0] - found, np.nan)
    rows = np.flatnonzero(np.isfinite(guess))
    start = np.column_stack([guess[rows], pixels[rows, 1]])
    guess_there = into_image(start)
    there, good = follow(left, right, pixels[rows], guess_there, levels=0, window=gates.window, round_trip=None)
    there = out_of_image(there)
    good &= (np.abs(there[:, 1] - pixels[rows, 1]) < gates.max_row) & (
        np.abs(there[:, 0] - guess[rows]) < POINT_TRACKS.max_shift
    )
    good &= there[:, 0] < pixels[rows, 0] - 0.1
    out[rows[good]] = there[good]
    return out


def _places_around(reach: int) -> IntArray:
    """Offsets (25, 2) in pixels at which a disparity is searched near a pixel without one, nearest first."""
    steps = (-reach, -(reach // 2), 0, reach // 2, reach)
    return np.array(sorted(((v, u) for v in steps for u in steps), key=lambda at: at[0] ** 2 + at[1] ** 2))
