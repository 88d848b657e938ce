# SPDX-License-Identifier: BSD-3-Clause
r"""Surface normals of a depth image.

The inverse depth of a plane is linear in the pixel, so its two slopes over a small window give the normal,

.. math:: n \propto -\Big(f_x \rho_u,\; f_y \rho_v,\; \rho - (u - c_x) \rho_u - (v - c_y) \rho_v\Big),

towards the camera. The slope along a row is the least-squares one over pairs of pixels at equal distances on both
sides,

.. math:: \rho_u = \frac{\sum_k 2 k\, (\rho_{u+k} - \rho_{u-k})}{\sum_k (2 k)^2}, \qquad k = 1, \dots, r,

summed over the 2 r + 1 rows of the window; likewise down columns. Pairs with a hole, or a step of depth between them,
are left out, so normals near an edge come from the pairs that do not cross it; the last pixel before an edge has none.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from groma._numba import loop
from groma.errors import InputError
from groma.frontend.depth_noise import as_depth, as_pinhole

# --------------------------------------------------------------------------------------------------------- Kernels


@loop
def _pair_sums(rho, radius, step, numerator, denominator):
    """Sums over pairs along rows, (H, W), without summing rows up."""
    for v in range(rho.shape[0]):
        for u in range(rho.shape[1]):
            top = bottom = np.float32(0.0)
            if rho[v, u] > 0.0:
                limit = step * rho[v, u]
                for k in range(1, min(radius, u, rho.shape[1] - 1 - u) + 1):
                    a, b = rho[v, u - k], rho[v, u + k]
                    usable = (a > 0.0) & (b > 0.0)
                    usable = usable & (abs(a - rho[v, u]) < k * limit) & (abs(b - rho[v, u]) < k * limit)
                    weight = np.float32(2 * k) if usable else np.float32(0.0)
                    top += weight * (b - a)
                    bottom += weight * weight
            numerator[v, u] = top
            denominator[v, u] = bottom


@loop
def _write_normals(rho, pinhole, sums, radius, normals):
    """Add the sums (4, H, W) of both directions over windows and write normals (H, W, 3)."""
    height, width = rho.shape
    columns = np.zeros((2, width))  # running sums of the pairs along rows, over 2 r + 1 rows
    for v in range(height):
        lines = range(min(radius + 1, height)) if v == 0 else range(v + radius, min(v + radius + 1, height))
        for line in lines:
            for u in range(width):
                columns[0, u] += sums[0, line, u]
                columns[1, u] += sums[1, line, u]
        if v > radius:
            for u in range(width):
                columns[0, u] -= sums[0, v - radius - 1, u]
                columns[1, u] -= sums[1, v - radius - 1, u]
        top = bottom = 0.0  # running sums of the pairs down columns, over 2 r + 1 columns
        for u in range(min(radius, width)):
            top += sums[2, v, u]
            bottom += sums[3, v, u]
        for u in range(width):
            if u + radius < width:
                top += sums[2, v, u + radius]
                bottom += sums[3, v, u + radius]
            if u > radius:
                top -= sums[2, v, u - radius - 1]
                bottom -= sums[3, v, u - radius - 1]
            normals[v, u, 0] = normals[v, u, 1] = normals[v, u, 2] = 0.0
            if not (rho[v, u] > 0.0 and columns[1, u] > 3.0 and bottom > 3.0):
                continue
            across, down = columns[0, u] / columns[1, u], top / bottom
            x, y = pinhole[0] * across, pinhole[1] * down
            z = rho[v, u] - (u + 0.5 - pinhole[2]) * across - (v + 0.5 - pinhole[3]) * down
            scale = -1.0 / math.sqrt(x * x + y * y + z * z)
            normals[v, u, 0], normals[v, u, 1], normals[v, u, 2] = scale * x, scale * y, scale * z


# ---------------------------------------------------------------------------------------------------------- Public


def depth_normals(
    depth: npt.NDArray[np.floating],
    pinhole: npt.ArrayLike,
    radius: int = 3,
    max_slope: float = 0.02,
) -> npt.NDArray[np.float32]:
    """Return unit normals of a depth image, towards the camera.

    Parameters
    ----------
    depth : (H, W) float
        Depth, metres; 0 where unknown.
    pinhole : (4,) float
        fx, fy, cx, cy; the first pixel's centre is (0.5, 0.5).
    radius : int
        The window is 2 radius + 1 pixels wide.
    max_slope : float
        Neighbours whose depths differ by more than this share, per pixel, are not on one surface.

    Returns
    -------
    (H, W, 3) float32
        Normals; zero where depth is unknown or has no usable neighbours.

    Raises
    ------
    ShapeError, InputError
        If arguments are not usable.
    """
    image, camera = as_depth(depth), as_pinhole(pinhole)
    if not 1 <= radius <= 50 or not 0 < max_slope:
        raise InputError(f"radius must be 1 to 50 and max_slope positive; got {radius} and {max_slope}.")
    rho = np.zeros_like(image)
    np.divide(np.float32(1.0), image, out=rho, where=image > 0)
    sums = np.empty((4, *image.shape), np.float32)
    turned = np.empty((2, image.shape[1], image.shape[0]), np.float32)
    _pair_sums(rho, radius, max_slope, sums[0], sums[1])
    _pair_sums(np.ascontiguousarray(rho.T), radius, max_slope, turned[0], turned[1])
    sums[2], sums[3] = turned[0].T, turned[1].T
    normals = np.empty((*image.shape, 3), np.float32)
    _write_normals(rho, camera, sums, radius, normals)
    return normals


__all__ = ["depth_normals"]
