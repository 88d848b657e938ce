# SPDX-License-Identifier: BSD-3-Clause
"""Depths at pixels of a depth image: medians of nine pixels, none where depth jumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._numba import loop
from groma._typing import FloatArray
from groma.gates import SEQUENCES, gate


@dataclass(frozen=True)
class DepthPointGates:
    """Where a depth can be read."""

    min_known: int = gate(4, "pixels", "known depths among a pixel and its eight neighbours", SEQUENCES)
    jump: float = gate(0.01, "scene units", "depths around a pixel differ by less, plus a share", SEQUENCES)
    jump_share: float = gate(0.04, "share", "share of the depth by which they may differ", SEQUENCES)
    correlation: float = gate(6.0, "samples", "pixels that err alike count as one", SEQUENCES)


#: The defaults.
DEPTH_POINTS = DepthPointGates()


# ------------------------------------------------------------------------------------------------------------ Kernels


@loop
def _depth_all(image, pixels, limits, out):
    """Write the median of the known depths of 3 x 3 pixels where they are many and alike."""
    height, width = image.shape
    min_known, jump, jump_share, max_depth = limits
    near = np.empty(9)
    for i in range(pixels.shape[0]):
        column = min(max(np.int64(pixels[i, 0]), 1), width - 2)
        row = min(max(np.int64(pixels[i, 1]), 1), height - 2)
        known = 0
        for v in range(row - 1, row + 2):
            for u in range(column - 1, column + 2):
                depth = np.float64(image[v, u])
                if depth > 0.0:  # put in order
                    k = known
                    while k > 0 and near[k - 1] > depth:
                        near[k] = near[k - 1]
                        k -= 1
                    near[k] = depth
                    known += 1
        if known == 0 or known < min_known:
            continue
        middle = 0.5 * (near[(known - 1) // 2] + near[known // 2])
        if near[known - 1] - near[0] < jump + jump_share * near[0] and middle <= max_depth:
            out[i] = middle


# ------------------------------------------------------------------------------------------------------------- Public


def depth_at(image: npt.NDArray[np.float32], pixels: FloatArray, max_depth: float) -> FloatArray:
    """Depths (N,) at pixels (N, 2) of an image of 3 x 3 pixels at least; NaN where unknown, too far, or at a jump."""
    out = np.full(len(pixels), np.nan)
    limits = float(DEPTH_POINTS.min_known), float(DEPTH_POINTS.jump), float(DEPTH_POINTS.jump_share), float(max_depth)
    _depth_all(np.ascontiguousarray(image), np.ascontiguousarray(pixels, np.float64), limits, out)
    return out
