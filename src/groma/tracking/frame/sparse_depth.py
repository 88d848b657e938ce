# SPDX-License-Identifier: BSD-3-Clause
r"""Depth between samples, where a depth image is mostly holes.

The inverse depth of a plane is linear in the pixel. Around each cell of a few pixels such a plane is fitted to the
samples of a window, and read at the pixels without depth, if the samples lie on it and the window's samples surround
the cell: the variance of the reading, with n samples of mean :math:`\bar p` and scatter S, is

.. math:: \sigma^2 \Big(\frac{1}{n} + (p - \bar p)^\top S^{-1} (p - \bar p)\Big) .
"""

from __future__ import annotations

import cv2
import numpy as np

from groma.features.depth.points import DEPTH_POINTS
from groma.tracking.frame.depth import DepthImage
from groma.tracking.gates import DEFAULT, TrackingGates


def fill_sparse(depth: DepthImage, max_depth: float, gates: TrackingGates = DEFAULT) -> DepthImage:
    """Return the depth image with holes filled where samples around them lie on a plane; dense images as they are."""
    sparse, cell, window = gates.sparse_depth, gates.sparse_depth.cell, gates.sparse_depth.window
    known = (depth > 0) & (depth <= max_depth)
    if np.count_nonzero(known) >= sparse.dense * known.size or min(depth.shape) < cell * window:
        return depth
    rows, columns = (size // cell for size in depth.shape)
    rho = np.zeros((rows * cell, columns * cell))
    inside = known[: rows * cell, : columns * cell]
    np.divide(1.0, depth[: rows * cell, : columns * cell], out=rho, where=inside)
    y, x = (np.arange(size, dtype=np.float64) / cell for size in rho.shape)
    terms = np.stack([inside.astype(np.float64), rho, rho * rho, inside * x, inside * y[:, None], rho * x,
                      rho * y[:, None], inside * x * x, inside * y[:, None] ** 2, inside * x * y[:, None]])  # fmt: skip
    cells = terms.reshape(10, rows, cell, columns, cell).sum(axis=(2, 4))
    sums = np.stack([
        cv2.boxFilter(term, -1, (window, window), normalize=False, borderType=cv2.BORDER_CONSTANT) for term in cells
    ])  # fmt: skip
    count = np.maximum(sums[0], 1.0)
    r, rr, mx, my, xr, yr, xx, yy, xy = sums[1:] / count
    rr, xr, yr = rr - r * r, xr - r * mx, yr - r * my
    xx, yy, xy = xx - mx * mx, yy - my * my, xy - mx * my
    determinant = xx * yy - xy * xy
    good = (sums[0] >= sparse.min_samples) & (determinant > 1e-2)
    determinant = np.where(good, determinant, 1.0)
    a, b = (yy * xr - xy * yr) / determinant, (xx * yr - xy * xr) / determinant
    scatter = np.sqrt(np.maximum(rr - a * xr - b * yr, 0.0))
    # Of the middle of the cell.
    dx, dy = np.arange(columns) + 0.5 - mx, np.arange(rows)[:, None] + 0.5 - my
    variance = (1.0 + (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / determinant) * DEPTH_POINTS.correlation / count
    sigma = gates.depth.inverse_sigma + gates.depth.min_sigma * r * r
    good &= (scatter < sparse.max_scatter * sigma) & (variance < sparse.max_reading**2) & (r > 0)
    wide = [np.repeat(np.repeat(value, cell, axis=0), cell, axis=1) for value in (good, r - a * mx - b * my, a, b)]
    reading = wide[1] + wide[2] * x + wide[3] * y[:, None]
    filled = depth.copy()
    fill = wide[0] & ~inside & (reading > 1.0 / max_depth)
    filled[: rows * cell, : columns * cell][fill] = 1.0 / reading[fill]
    return filled
