# SPDX-License-Identifier: BSD-3-Clause
"""Depth of points and segments from a depth image.

Noise is stated in inverse depth, where it is nearly the same near and far: a depth camera measures a disparity.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from groma._numba import loop
from groma._typing import FloatArray
from groma.features.depth.lines import DepthLineGates, fit_depth_lines
from groma.features.depth.noise import DepthNoise
from groma.tracking.gates import DEFAULT, DepthGates

DepthImage = npt.NDArray[np.float32]


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


def depth_sigma(depth: FloatArray, gates: DepthGates = DEFAULT.depth) -> FloatArray:
    """Standard deviation of measured depths, scene units."""
    return np.hypot(gates.min_sigma, gates.inverse_sigma * depth**2)


def depth_at(image: DepthImage, pixels: FloatArray, max_depth: float, gates: DepthGates = DEFAULT.depth) -> FloatArray:
    """Depths (N,) at pixels; NaN where unknown, too far, or at a jump of depth."""
    out = np.full(len(pixels), np.nan)
    limits = float(gates.min_known), float(gates.jump), float(gates.jump_share), float(max_depth)
    _depth_all(np.ascontiguousarray(image), np.ascontiguousarray(pixels, np.float64), limits, out)
    return out


def segment_inverse_depths(
    image: DepthImage,
    ends: FloatArray,
    pinhole: FloatArray,
    noise: DepthNoise,
    gates: DepthGates = DEFAULT.depth,
) -> tuple[FloatArray, FloatArray]:
    """Inverse depths (L, 2) at the ends of segments and their standard deviations; NaN where unknown."""
    own = DepthLineGates(near=gates.near, far=gates.far, max_relative_sigma=1.0)
    found = fit_depth_lines(ends, image, pinhole, noise, gates=own)
    sigma = np.sqrt(np.diagonal(found.inverse_depth_covariances, axis1=1, axis2=2))
    good = found.good[:, None]
    return np.where(good, found.inverse_depth, np.nan), np.where(good, sigma, np.nan)


__all__ = ["DepthImage", "depth_at", "depth_sigma", "segment_inverse_depths"]
