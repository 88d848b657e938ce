# SPDX-License-Identifier: BSD-3-Clause
r"""Errors that neighbours in an image share, and what they leave of the weight of many.

Residual lens distortion, refraction and a rolling shutter displace everything in one part of an image alike, points and
lines. A thousand observations there do not hold a thousand times the information of one. Let the shared errors of two
observations at the distance :math:`d` have the covariance :math:`\tau^2(d)`, in addition to their own noise. Where all
observations, with the information :math:`J = \sum 1/\sigma^2`, lie within the range of the shared error, least squares
with the full covariance :math:`\mathrm{diag}(\sigma^2) + \tau^2 1 1^T` weights each by

.. math:: \frac{1}{\sigma_i^2 f^2}, \qquad f^2 = 1 + \tau^2 J,

and, for a covariance that decreases slowly with distance, by :math:`f_i^2 = 1 + \sum_j \tau^2(d_{ij}) / \sigma_j^2`.
The covariance is estimated from the residuals of points, over all pairs of all images, for one ring of distances after
another. Sums over pairs are correlations of coarse grids, computed by Fourier transforms.

Points at the same pixel, as where a detector gives a keypoint two orientations, are one measurement counted twice. They
share its weight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.execution import map_in_threads
from groma.gates import NORMAL, SURVEYED, gate
from groma.mapping.noise.landmarks import pixels_of
from groma.scene import Scene


@dataclass(frozen=True)
class SharedNoiseGates:
    """Which errors are shared."""

    num_cells: int = gate(64, "cells", "along the longer side of an image", "cost: how finely distances are told apart")
    rings: tuple[float, ...] = gate(
        (1.0, 2.0, 4.0, 8.0, 16.0), "cells", "at which rings of pairs end", "convention: doubling"
    )
    min_observations: int = gate(1000, "observations", "that tell what they share", SURVEYED)
    min_share: float = gate(0.25, "share", "of errors' variance that residuals have", "derived from two views")


GATES = SharedNoiseGates()


def with_shared_noise(scene: Scene, point_sigma_px: float, line_sigma_px: float) -> Scene:
    """Return the scene with larger standard deviations where observations share errors with many others.

    Parameters
    ----------
    scene : Scene
        An adjusted scene; the standard deviations of its observations are relative to those that follow.
    point_sigma_px, line_sigma_px : float
        Standard deviations of the usual point, and of a segment where its line is measured, pixels.

    Returns
    -------
    Scene
        Standard deviations multiplied by :math:`f_i`, relative to that of the usual point.
    """
    points, lines = scene.point_observations, scene.line_observations
    if len(points) < GATES.min_observations or not scene.cameras.width.any():
        return scene
    grid = _Grid(scene)
    times = _times_measured(points.image_idx, points.pixel)
    points = points.replace(sigma=points.sigma * np.sqrt(times))
    cells = grid.cells(points.image_idx, points.pixel)
    middles = grid.cells(lines.image_idx, 0.5 * (lines.segment[:, :2] + lines.segment[:, 2:]))
    sigma, line_sigma = point_sigma_px * points.sigma, line_sigma_px * lines.sigma
    pixels = pixels_of(scene, points.image_idx, scene.points.xyz[points.point_idx])
    residual = (pixels - points.pixel) / sigma[:, None]
    told = (times == 1) & (np.einsum("ni,ni->n", residual, residual) < NORMAL.mistake**2)
    covariance = _covariance(grid, cells[told], residual[told], sigma[told])
    information = grid.sums(cells, 1.0 / sigma**2) + grid.sums(middles, 1.0 / line_sigma**2)
    around = grid.smoothed(information, covariance).reshape(-1)
    # An observation and its repetitions are not among the others.
    factor = np.sqrt(1.0 + np.maximum(around[cells] - covariance[0, 0] * times / sigma**2, 0.0))
    line_factor = np.sqrt(1.0 + np.maximum(around[middles] - covariance[0, 0] / line_sigma**2, 0.0))
    usual = float(np.median(factor))
    return scene.replace(
        point_observations=points.replace(sigma=points.sigma * factor / usual),
        line_observations=lines.replace(sigma=lines.sigma * line_factor / usual),
    )


def _times_measured(image_idx: IntArray, pixel: FloatArray) -> IntArray:
    """How many observations each shares its image and its very pixel with, itself included (N,)."""
    order = np.lexsort((pixel[:, 1], pixel[:, 0], image_idx))
    rows = np.column_stack([image_idx, pixel])[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (rows[1:] != rows[:-1]).any(axis=1)
    group = np.cumsum(new) - 1
    count = np.empty(len(rows), dtype=np.int64)
    count[order] = np.bincount(group)[group]
    return count


class _Grid:
    """Cells of all images, of one size in pixels, with room beside them so that sides do not touch."""

    def __init__(self, scene: Scene) -> None:
        camera = scene.images.camera_idx
        width, height = scene.cameras.width[camera], scene.cameras.height[camera]
        self.size = float(max(width.max(), height.max())) / GATES.num_cells
        room = int(GATES.rings[-1])
        self.shape = (
            len(scene.images),
            int(np.ceil(height.max() / self.size)) + room,
            int(np.ceil(width.max() / self.size)) + room,
        )
        rows, columns = (np.minimum(np.arange(n), n - np.arange(n)) for n in self.shape[1:])
        #: Distance in cells from the first cell, around the sides.
        self.distance = np.hypot(rows[:, None], columns[None, :])

    def cells(self, image_idx: IntArray, pixel: FloatArray) -> IntArray:
        """Number of the cell of each pixel (N,)."""
        _, height, width = self.shape
        room = int(GATES.rings[-1])
        at = np.clip((pixel / self.size).astype(np.int64), 0, [width - room - 1, height - room - 1])
        return (image_idx * height + at[:, 1]) * width + at[:, 0]

    def sums(self, cells: IntArray, values: FloatArray) -> FloatArray:
        """Sum of the values in every cell of every image."""
        return np.bincount(cells, values, int(np.prod(self.shape))).reshape(self.shape).astype(np.float64, copy=False)

    def pairs(self, sums: FloatArray) -> FloatArray:
        """Sums of products of cells, by how far they lie apart, over all images."""
        power = np.abs(np.fft.rfft2(sums)) ** 2
        return np.fft.irfft2(power.sum(axis=0), self.shape[1:])

    def smoothed(self, sums: FloatArray, kernel: FloatArray) -> FloatArray:
        """The sums of all cells around, times the kernel."""
        return np.fft.irfft2(np.fft.rfft2(sums) * np.fft.rfft2(kernel), self.shape[1:])


def _covariance(grid: _Grid, cells: IntArray, residual: FloatArray, sigma: FloatArray) -> FloatArray:
    """The shared variance by how far cells lie apart, pixels squared, of the shape of a grid; zero where it is none."""
    # Landmarks follow their observations: residuals are smaller than errors.
    residual = residual / np.sqrt(max(np.sum(residual**2) / max(residual.size, 1), GATES.min_share))
    summed = [*(residual.T / sigma), 1.0 / sigma**2]
    first, second, weights = map_in_threads(lambda values: grid.pairs(grid.sums(cells, values)), summed)
    products = first + second
    # Without pairs of an observation with itself.
    products[0, 0] -= np.sum(residual**2 / sigma[:, None] ** 2)
    weights[0, 0] -= np.sum(1.0 / sigma**4)
    covariance, least, inner = np.zeros_like(weights), np.inf, 0.0
    for outer in GATES.rings:
        ring = (grid.distance >= inner) & (grid.distance < outer)
        total = max(weights[ring].sum(), 1e-300)
        # Every pair is there twice, in two coordinates: the deviation of their mean is one over the root of the sum.
        least = min(least, 0.5 * products[ring].sum() / total)
        if least < NORMAL.far / np.sqrt(total):
            break
        covariance[ring], inner = least, outer
    return covariance
