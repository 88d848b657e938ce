# SPDX-License-Identifier: BSD-3-Clause
"""Columns of points in the right image of a rectified pair.

Where nothing is known, a dense comparison of blocks (OpenCV's StereoBM) gives the column to about a pixel;
Lucas-Kanade then refines it, and the point must stay in its row. Where the depth is known, only the refinement runs.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray
from groma.features.images import GrayImage
from groma.features.point_tracks import follow

#: Standard deviation of a disparity, pixels.
DISPARITY_SIGMA = 0.5
#: Blocks of this width are compared, pixels.
BLOCK = 13
#: Largest disparity, as a share of the width of the image.
MAX_SHARE = 0.12
#: A refined column may be this far from where it was expected, pixels; and this far out of its row.
MAX_SHIFT, MAX_ROW = 2.5, 1.5
#: Where to ask for a disparity beside a pixel that has none, nearest first (n, 2), pixels.
_AROUND = np.array(
    sorted(((v, u) for v in (-6, -3, 0, 3, 6) for u in (-6, -3, 0, 3, 6)), key=lambda at: at[0] ** 2 + at[1] ** 2)
)

Disparities = npt.NDArray[np.float32]


def dense_disparities(left: GrayImage, right: GrayImage) -> Disparities:
    """Disparities (H, W) in pixels by comparison of blocks; 0 where unknown."""
    count = 16 * max(1, round(MAX_SHARE * left.shape[1] / 16))
    if min(left.shape) <= BLOCK or left.shape[1] <= count + BLOCK:
        return np.zeros(left.shape, np.float32)
    matcher = cv2.StereoBM.create(numDisparities=count, blockSize=BLOCK)
    matcher.setUniquenessRatio(15)
    matcher.setTextureThreshold(8)
    # OpenCV leaves out the columns at the left whose counterpart could be outside, and rounds sixteenths of a pixel up.
    wide = [cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    found = (matcher.compute(wide[0], wide[1])[:, count:].astype(np.float32) - 0.5) / 16.0
    column = np.arange(left.shape[1], dtype=np.float32)
    return np.where((found > 0.5) & (found < column - BLOCK // 2), found, np.float32(0.0))


def match_columns(
    left: GrayImage, right: GrayImage, pixels: FloatArray, expected: FloatArray, coarse: Disparities | None
) -> FloatArray:
    """Columns (N,) of points of the left image in the right one, pixels; NaN where not found.

    ``expected`` (N,) are columns known beforehand; where they are NaN, the disparities ``coarse`` tell where to look.
    """
    columns = np.full(len(pixels), np.nan)
    if not len(pixels):
        return columns
    guess = np.asarray(expected, float).copy()
    unknown = ~np.isfinite(guess)
    if coarse is not None and unknown.any():
        height, width = left.shape
        # Beside a corner often one side alone is told apart: the nearest of the surroundings then.
        row = np.clip(pixels[unknown, 1].astype(np.int64) + _AROUND[:, :1], 0, height - 1)
        column = np.clip(pixels[unknown, 0].astype(np.int64) + _AROUND[:, 1:], 0, width - 1)
        near = coarse[row, column]
        found = near[(near > 0).argmax(axis=0), np.arange(near.shape[1])]
        guess[unknown] = np.where(found > 0, pixels[unknown, 0] - found, np.nan)
    rows = np.flatnonzero(np.isfinite(guess))
    start = np.column_stack([guess[rows], pixels[rows, 1]])
    there, good = follow(left, right, pixels[rows], start, levels=0, window=17, round_trip=None)
    good &= (np.abs(there[:, 1] - pixels[rows, 1]) < MAX_ROW) & (np.abs(there[:, 0] - guess[rows]) < MAX_SHIFT)
    good &= there[:, 0] < pixels[rows, 0] - 0.1
    columns[rows[good]] = there[good, 0]
    return columns


__all__ = ["DISPARITY_SIGMA", "Disparities", "dense_disparities", "match_columns"]
