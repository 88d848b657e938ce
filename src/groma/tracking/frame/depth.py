# SPDX-License-Identifier: BSD-3-Clause
"""Depth of points and segments from a depth image.

Noise is stated in inverse depth, where it is nearly the same near and far: a depth camera measures a disparity.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray
from groma.features.depth.lines import DepthLineGates, fit_depth_lines
from groma.features.depth.noise import DepthNoise
from groma.tracking.gates import DEFAULT, DepthGates

DepthImage = npt.NDArray[np.float32]


def depth_sigma(depth: FloatArray, gates: DepthGates = DEFAULT.depth) -> FloatArray:
    """Standard deviation of measured depths, scene units."""
    return np.hypot(gates.min_sigma, gates.inverse_sigma * depth**2)


def depth_at(image: DepthImage, pixels: FloatArray, max_depth: float, gates: DepthGates = DEFAULT.depth) -> FloatArray:
    """Depths (N,) at pixels; NaN where unknown, too far, or at a jump of depth."""
    height, width = image.shape
    column = np.clip(pixels[:, 0].astype(np.int64), 1, width - 2)
    row = np.clip(pixels[:, 1].astype(np.int64), 1, height - 2)
    near = np.stack([image[row + j, column + i] for j in (-1, 0, 1) for i in (-1, 0, 1)], axis=1).astype(np.float64)
    near[near <= 0] = np.nan
    known = np.isfinite(near).sum(axis=1)
    lone = known == 0
    near[lone] = 0.0
    low, high, middle = np.nanmin(near, axis=1), np.nanmax(near, axis=1), np.nanmedian(near, axis=1)
    good = (
        ~lone & (known >= gates.min_known) & (high - low < gates.jump + gates.jump_share * low) & (middle <= max_depth)
    )
    return np.where(good, middle, np.nan)


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
