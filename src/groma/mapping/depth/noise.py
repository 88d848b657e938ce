# SPDX-License-Identifier: BSD-3-Clause
r"""How much depth maps err, from the points of a model that are known better.

Two numbers of :class:`~groma.features.depth.noise.DepthNoise`, :math:`\sigma_z = c_0 + c_2 z^2`, are fitted to the
spread of differences at ten depths: the first prevails in rendered depths, the second in those of stereo pairs and
structured light. Errors of neighbours are alike. With correlations :math:`\rho_s` within a cell of the image and
:math:`\rho_f` across it, the mean of m depths in the same cell and n others has the variance of one depth times
:math:`f^2 / (m + n)`; every depth of them is therefore given the standard deviation :math:`f \sigma`,

.. math:: f^2 = 1 + (m - 1) \rho_s + n \rho_f .
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.features.depth.noise import DepthNoise
from groma.features.depth.points import DEPTH_POINTS
from groma.gates import NORMAL, SIGMA_OF_MEDIAN, gate


@dataclass(frozen=True)
class MapNoiseGates:
    """How the noise of depth maps is estimated."""

    groups: int = gate(10, "groups", "of depths, from near to far", "cost: two numbers are fitted")
    known_share: float = gate(0.5, "share", "of a group, the best known points, that tell it", "convention: a half")
    least: float = gate(1e-4, "share", "of the depth: no depth is known better", "derived from 16-bit files")
    cells: int = gate(6, "cells", "along the width of an image, in which errors are alike", "cost: 36 in a square")


NOISE = MapNoiseGates()


@dataclass(frozen=True)
class SharedErrors:
    """Correlations of the errors of depths in one image: in the same cell, and in different ones."""

    near: float = 0.0
    far: float = 0.0

    def factors(self, image_idx: IntArray, cell: IntArray) -> FloatArray:
        """Return by what to multiply standard deviations of depths (N,) in cells that are numbered over all images."""
        same, whole = np.bincount(cell)[cell], np.bincount(image_idx)[image_idx]
        return np.sqrt(1.0 + (same - 1) * self.near + (whole - same) * self.far)


def fitted_noise(depth: FloatArray, difference: FloatArray, sigma: FloatArray) -> DepthNoise:
    """Return the noise of measured depths.

    Parameters
    ----------
    depth, difference : (N,) float64
        Measured depths, and how far they are from those of points.
    sigma : (N,) float64
        Standard deviations of the depths of the points.
    """
    if len(depth) < NORMAL.sample:
        return DepthNoise(correlation=DEPTH_POINTS.correlation, max_depth=1e6)
    groups = [
        rows[np.argsort(sigma[rows])][: math.ceil(NOISE.known_share * len(rows))]
        for rows in np.array_split(np.argsort(depth), NOISE.groups)
    ]
    middle = np.array([np.median(depth[rows]) for rows in groups])
    spread = SIGMA_OF_MEDIAN * np.array([np.median(np.abs(difference[rows])) for rows in groups])
    spread = np.maximum(spread, NOISE.least * middle)  # with what the points err by: rather too much than too little
    from scipy.optimize import nnls  # takes 0.2 s to import

    constant, quadratic = nnls(np.column_stack([1.0 / spread, middle**2 / spread]), np.ones(len(middle)))[0]
    if constant == 0.0:
        constant = NOISE.least * float(middle[0])
    return DepthNoise(float(constant), float(quadratic), 0.0, correlation=DEPTH_POINTS.correlation, max_depth=1e6)


def shared_errors(whitened: FloatArray, image_idx: IntArray, cell: IntArray) -> SharedErrors:
    """Return the correlations of whitened differences (N,), by products of all pairs in a cell, and in an image."""
    good = np.abs(whitened) < NORMAL.mistake
    values, image, cell = whitened[good], image_idx[good], cell[good]
    if len(values) < NORMAL.sample:
        return SharedErrors()
    sums = [np.bincount(index, values) for index in (cell, image)]
    counts = [np.bincount(index).astype(np.float64) for index in (cell, image)]
    alone = float((values**2).sum())
    in_cells, in_images = (float((one**2).sum()) for one in sums)
    pairs_in_cells, pairs_in_images = (float((one**2).sum()) for one in counts)
    near = (in_cells - alone) / max(pairs_in_cells - len(values), 1.0)
    far = (in_images - in_cells) / max(pairs_in_images - pairs_in_cells, 1.0)
    variance = max(alone / len(values), 1e-300)
    near, far = np.clip(near / variance, 0.0, 1.0), np.clip(far / variance, 0.0, 1.0)
    return SharedErrors(float(max(near, far)), float(far))


def cells_of(image_idx: IntArray, pixel: FloatArray, width: FloatArray) -> IntArray:
    """Number (N,) the cells of pixels (N, 2) in images of a width (N,), over all images."""
    at = np.clip((pixel * (NOISE.cells / np.maximum(width, 1.0))[:, None]).astype(np.int64), 0, 10 * NOISE.cells)
    return np.unique(np.column_stack([image_idx, at]), axis=0, return_inverse=True)[1].ravel()
