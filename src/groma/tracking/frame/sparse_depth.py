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

from groma.tracking.frame.depth import DEPTH_FLOOR, INVERSE_DEPTH_SIGMA, DepthImage

#: Images of which a smaller share is known are filled.
DENSE = 0.35
#: Side of a cell, pixels, and of a window, cells.
CELL, WINDOW = 4, 11
#: Samples that a window has at least; neighbours err alike, so many count as one.
LEAST, CORRELATION = 12, 6.0
#: Largest deviation of samples from their plane, and of a reading, in standard deviations of one sample.
MAX_SCATTER, MAX_READING = 2.5, 2.0


def fill_sparse(depth: DepthImage, max_depth: float) -> DepthImage:
    """Return the depth image with holes filled where samples around them lie on a plane; dense images as they are."""
    known = (depth > 0) & (depth <= max_depth)
    if known.mean() >= DENSE or min(depth.shape) < CELL * WINDOW:
        return depth
    rows, columns = (size // CELL for size in depth.shape)
    rho = np.zeros((rows * CELL, columns * CELL))
    inside = known[: rows * CELL, : columns * CELL]
    np.divide(1.0, depth[: rows * CELL, : columns * CELL], out=rho, where=inside)
    y, x = (np.arange(size, dtype=np.float64) / CELL for size in rho.shape)
    terms = np.stack([inside.astype(np.float64), rho, rho * rho, inside * x, inside * y[:, None], rho * x,
                      rho * y[:, None], inside * x * x, inside * y[:, None] ** 2, inside * x * y[:, None]])  # fmt: skip
    cells = terms.reshape(10, rows, CELL, columns, CELL).sum(axis=(2, 4))
    sums = np.stack([
        cv2.boxFilter(term, -1, (WINDOW, WINDOW), normalize=False, borderType=cv2.BORDER_CONSTANT) for term in cells
    ])  # fmt: skip
    count = np.maximum(sums[0], 1.0)
    r, rr, mx, my, xr, yr, xx, yy, xy = sums[1:] / count
    rr, xr, yr = rr - r * r, xr - r * mx, yr - r * my
    xx, yy, xy = xx - mx * mx, yy - my * my, xy - mx * my
    determinant = xx * yy - xy * xy
    good = (sums[0] >= LEAST) & (determinant > 1e-2)
    determinant = np.where(good, determinant, 1.0)
    a, b = (yy * xr - xy * yr) / determinant, (xx * yr - xy * xr) / determinant
    scatter = np.sqrt(np.maximum(rr - a * xr - b * yr, 0.0))
    # Of the middle of the cell.
    dx, dy = np.arange(columns) + 0.5 - mx, np.arange(rows)[:, None] + 0.5 - my
    variance = (1.0 + (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / determinant) * CORRELATION / count
    sigma = INVERSE_DEPTH_SIGMA + DEPTH_FLOOR * r * r
    good &= (scatter < MAX_SCATTER * sigma) & (variance < MAX_READING**2) & (r > 0)
    wide = [np.repeat(np.repeat(value, CELL, axis=0), CELL, axis=1) for value in (good, r - a * mx - b * my, a, b)]
    reading = wide[1] + wide[2] * x + wide[3] * y[:, None]
    filled = depth.copy()
    fill = wide[0] & ~inside & (reading > 1.0 / max_depth)
    filled[: rows * CELL, : columns * CELL][fill] = 1.0 / reading[fill]
    return filled


__all__ = ["fill_sparse"]
