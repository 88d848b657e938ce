# SPDX-License-Identifier: BSD-3-Clause
"""Depth of points and segments from a depth image.

Noise is stated in inverse depth, where it is nearly the same near and far: a depth camera measures a disparity.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from groma._typing import BoolArray, FloatArray

DepthImage = npt.NDArray[np.float32]
#: Standard deviation of an inverse depth, 1 / scene unit: 3 mm at 1 m, 12 mm at 2 m.
INVERSE_DEPTH_SIGMA = 0.003
#: A depth is not known better than this, scene units.
DEPTH_FLOOR = 0.003
#: Samples along a segment.
SAMPLES = 24


def depth_sigma(depth: FloatArray) -> FloatArray:
    """Standard deviation of measured depths, scene units."""
    return np.hypot(DEPTH_FLOOR, INVERSE_DEPTH_SIGMA * depth**2)


def depth_at(image: DepthImage, pixels: FloatArray, max_depth: float) -> FloatArray:
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
    good = ~lone & (known >= 4) & (high - low < 0.01 + 0.04 * low) & (middle <= max_depth)
    return np.where(good, middle, np.nan)


def sample_inverse_depth(image: DepthImage, ends: FloatArray, max_depth: float, beside: float = 2.5) -> FloatArray:
    """Inverse depths (L, SAMPLES) along segments; NaN where unknown.

    An edge between two surfaces belongs to the nearer one: where the depth ``beside`` pixels to the left or right is
    smaller by more than its noise, it is taken. Zero looks at the segment itself only.
    """
    height, width = image.shape
    t = (np.arange(SAMPLES) + 0.5) / SAMPLES
    first, second = ends[:, None, :2], ends[:, None, 2:]
    way = ends[:, 2:] - ends[:, :2]
    across = np.stack([-way[:, 1], way[:, 0]], axis=1) / np.maximum(np.linalg.norm(way, axis=1), 1e-9)[:, None]
    places = (1 - t[:, None]) * first + t[:, None] * second
    best = np.zeros(places.shape[:2])
    for offset in (0.0, -beside, beside) if beside > 0 else (0.0,):
        at = places + offset * across[:, None]
        column, row = (np.clip(at[..., k].astype(np.int64), 0, size - 1) for k, size in ((0, width), (1, height)))
        depth = image[row, column].astype(np.float64)
        known = (depth > 0) & (depth <= max_depth)
        inverse = np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0)
        nearer = inverse > best + 4.0 * INVERSE_DEPTH_SIGMA
        best = np.where(nearer, inverse, best)
    return np.where(best > 0, best, np.nan)


def fit_inverse_depth(samples: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Fit straight lines to inverse depths along segments, robustly.

    Parameters
    ----------
    samples : (L, S)
        Inverse depths at evenly spaced places; NaN where unknown.
    sigma : float
        Standard deviation of one sample.

    Returns
    -------
    (L, 2), (L, 2), (L,) bool
        Inverse depths at both ends, their standard deviations, and which fits hold.
    """
    count = samples.shape[1]
    t = (np.arange(count) + 0.5) / count
    known = np.isfinite(samples)
    w = np.where(known, samples, 0.0)
    # Start from the line through the medians of the two halves: a half of the samples may be wrong there.
    value = np.where(known, samples, np.nan)
    some = known[:, : count // 2].any(axis=1) & known[:, count // 2 :].any(axis=1)
    value[~some] = 0.0
    left, right = np.nanmedian(value[:, : count // 2], axis=1), np.nanmedian(value[:, count // 2 :], axis=1)
    slope = 2.0 * (right - left)
    offset = left - 0.25 * slope
    weight = known.astype(float)
    total = np.ones(len(samples))
    variance = np.zeros((len(samples), 3))
    for gate in (8.0, 5.0, 4.0, 4.0):
        residual = (w - offset[:, None] - slope[:, None] * t) / (gate * sigma)
        weight = np.where(known & (np.abs(residual) < 1), (1 - residual**2) ** 2, 0.0)
        s0, s1, s2 = weight.sum(axis=1), (weight * t).sum(axis=1), (weight * t * t).sum(axis=1)
        r0, r1 = (weight * w).sum(axis=1), (weight * t * w).sum(axis=1)
        total = s0 * s2 - s1 * s1
        safe = np.where(total > 1e-6, total, 1.0)
        offset, slope = (s2 * r0 - s1 * r1) / safe, (s0 * r1 - s1 * r0) / safe
        variance = np.stack([s2, -s1, s0], axis=1) / safe[:, None]
    ends = np.stack([offset, offset + slope], axis=1)
    spread = np.stack([variance[:, 0], variance[:, 0] + 2 * variance[:, 1] + variance[:, 2]], axis=1)
    # Neighbouring samples share their noise: half of them count.
    sigmas = sigma * np.sqrt(np.maximum(2.0 * spread, 0.05))
    good = some & (total > 1e-3) & (weight.sum(axis=1) >= 0.4 * count) & (ends > 0.01).all(axis=1)
    return np.where(good[:, None], ends, np.nan), np.where(good[:, None], sigmas, np.nan), good


__all__ = [
    "DEPTH_FLOOR",
    "INVERSE_DEPTH_SIGMA",
    "DepthImage",
    "depth_at",
    "depth_sigma",
    "fit_inverse_depth",
    "sample_inverse_depth",
]
