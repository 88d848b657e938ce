# SPDX-License-Identifier: BSD-3-Clause
"""Noise of depths, and depth of segments, from a depth image.

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


def segment_inverse_depths(
    image: DepthImage, ends: FloatArray, pinhole: FloatArray, noise: DepthNoise, gates: DepthGates = DEFAULT.depth
) -> tuple[FloatArray, FloatArray]:
    """Inverse depths (L, 2) at the ends of segments and their standard deviations; NaN where unknown."""
    own = DepthLineGates(near=gates.near, far=gates.far, max_relative_sigma=1.0)
    found = fit_depth_lines(ends, image, pinhole, noise, gates=own)
    sigma = np.sqrt(np.diagonal(found.inverse_depth_covariances, axis1=1, axis2=2))
    good = found.good[:, None]
    return np.where(good, found.inverse_depth, np.nan), np.where(good, sigma, np.nan)
