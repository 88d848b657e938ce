# SPDX-License-Identifier: BSD-3-Clause
r"""Planes of a depth image: blocks are fitted, grown to regions, joined, and refined pixel by pixel.

The inverse depth of a plane is linear in the ray, :math:`\rho = \theta \cdot r` (:mod:`groma.features.depth.noise`).
With weights :math:`\omega = 1/\sigma_\rho^2` the ten sums

.. math:: \sum \omega\, (1, x, y, x^2, x y, y^2, \rho, x\rho, y\rho, \rho^2)

hold all that is needed to fit a set of pixels, to say how well any other plane fits them, and to join two sets. One
pass over the image makes the sums of small blocks; growing and joining never look at pixels again; a second pass
gives each pixel to the nearest of the planes around it, and makes the sums of which the planes are estimated.

1. A block whose pixels lie on a plane is a seed. The best seed that is left grows over neighbours that lie on its
   plane, by the mean square of their whitened distances and by the angle between the normals, both beyond what noise
   explains.
2. Regions on the same plane are joined, whether or not they touch.
3. Pixels within three standard deviations (and the bend of the camera) of a plane of their block or its neighbours get
   the label of the nearest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.errors import InputError
from groma.features.depth.noise import DepthNoise, as_depth, as_pinhole
from groma.features.depth.regions import MAX_REGIONS, REGIONS, assign, block_sums, grow, join
from groma.gates import NORMAL
from groma.geometry.charts.plane_normal_offset import NormalOffsetPlane


@dataclass(frozen=True)
class PlaneSearchOptions:
    """What counts as a plane of a depth image."""

    #: Side of a block, pixels.
    block: int = 10
    #: Every n-th pixel is used, across and down; every one where most depth is missing.
    step: int = 2
    #: A plane covers at least this share of the image, blocks without depth not counted.
    min_share: float = 0.006
    #: Maximum number of planes, the largest (cost: time).
    max_planes: int = 16
    #: Largest mean squared whitened distance of a block from the plane that grows over it.
    gate: float = NORMAL.far
    #: Normals of neighbours that differ by less are always joined, degrees; noise is allowed on top.
    angle_deg: float = 8.0
    #: Depth cameras bend planes: what lies within this share of the depth is one plane.
    bend: float = 0.008

    def __post_init__(self) -> None:
        if self.step < 1 or self.block < 2 * self.step or not 0 < self.min_share < 1:
            raise InputError(f"block must be at least twice step, step at least 1, 0 < min_share < 1; got {self}.")
        if not 1 <= self.max_planes <= MAX_REGIONS or self.gate <= 0 or not 0 < self.angle_deg < 90:
            raise InputError(f"max_planes must be 1 to {MAX_REGIONS}, gate and angle_deg positive; got {self}.")
        if not 0 <= self.bend < 0.5:
            raise InputError(f"bend must be a share of the depth, 0 to 0.5; got {self.bend}.")


@dataclass(frozen=True, eq=False)
class DepthPlanes:
    """The planes of one depth image in its camera, largest first."""

    #: (K, 4) unit normal and offset; the camera lies on the positive side, w > 0.
    planes: FloatArray
    #: (K, 3, 3) covariance in the chart ``normal_offset``: two angles (radians) and the offset (metres).
    covariances: FloatArray
    #: (K, 4, 4) the same covariance of (n, w), of rank 3.
    covariances_hesse: FloatArray
    #: (K,) number of samples, and (K, 3) their centroids, metres.
    num_samples: IntArray
    centers: FloatArray
    #: (K,) mean squared whitened distance; about 1 where the noise is as assumed and the surface is flat.
    reduced_chi_square: FloatArray
    #: (h, w) row of the plane that a sample lies on, -1 for none.
    labels: npt.NDArray[np.int8]
    #: Pixels from one sample to the next: sample (i, j) is pixel (step i + step // 2, step j + step // 2).
    step: int

    def __len__(self) -> int:
        return len(self.planes)


def find_depth_planes(
    depth: npt.NDArray[np.floating],
    pinhole: npt.ArrayLike,
    noise: DepthNoise | None = None,
    options: PlaneSearchOptions | None = None,
) -> DepthPlanes:
    r"""Find the planes of a depth image.

    .. math:: (n, w) = \frac{(-\theta, 1)}{\lVert\theta\rVert}, \qquad
        \Sigma_\theta = c \left(\sum \omega\, r r^\top\right)^{-1}

    with c the correlation of the noise times the reduced chi-square where that exceeds one; what all pixels have in
    common (``DepthNoise.tilt`` and ``shift``) is added.

    Parameters
    ----------
    depth : (H, W) float
        Depth along the optical axis, metres; 0 (or anything not positive) where unknown.
    pinhole : (4,) float
        fx, fy, cx, cy; the first pixel's centre is (0.5, 0.5).
    noise : DepthNoise, optional
        Errors of depth.
    options : PlaneSearchOptions, optional
        What counts as a plane.

    Returns
    -------
    DepthPlanes
        None to ``max_planes`` planes, largest first.

    Raises
    ------
    ShapeError, InputError
        If depth or camera are not usable.

    Notes
    -----
    Where much depth is missing, steps are made smaller and blocks larger, so that a block keeps enough samples. Gently
    curved surfaces are cut into planes.
    """
    image, camera = as_depth(depth), as_pinhole(pinhole)
    noise, options = noise or DepthNoise(), _for_density(options or PlaneSearchOptions(), image, REGIONS.min_count)
    step, size = options.step, max(options.block // options.step, 2)
    rows, columns = -(-image.shape[0] // step), -(-image.shape[1] // step)
    blocks = (-(-rows // size), -(-columns // size))
    sums, counts = np.empty((*blocks, 10)), np.empty(blocks, np.int64)
    numbers = noise.numbers
    block_sums(image, camera, numbers, size, step, sums, counts)

    occupied = int((counts > 0).sum())
    min_blocks = max(int(options.min_share * occupied), 4)
    block_labels = np.empty(blocks, np.int64)
    regions, region_counts = np.zeros((MAX_REGIONS, 10)), np.zeros(MAX_REGIONS, np.int64)
    cos_floor = math.cos(math.radians(options.angle_deg))
    limits = (float(options.gate), float(options.bend), cos_floor)
    found = grow(
        sums, counts, numbers, limits, (float(REGIONS.min_count), REGIONS.flat, NORMAL.far**2), min_blocks,
        block_labels, regions, region_counts,
    )  # fmt: skip
    target = np.zeros(found, np.int64)
    join(regions, region_counts, found, numbers, limits, (REGIONS.looser, NORMAL.far**2), target)
    return _refined(image, camera, noise, options, NORMAL.far, block_labels, regions, region_counts, target)


def _for_density(options: PlaneSearchOptions, image: npt.NDArray[np.float32], min_count: int) -> PlaneSearchOptions:
    """Return options under which a block of average density has twice the samples that it needs."""
    density = max(np.count_nonzero(image > 0) / image.size, 0.01)
    step = options.step
    while step > 1 and density * (options.block // step) ** 2 < 2 * min_count:
        step -= 1
    block = max(options.block, math.ceil(math.sqrt(2 * min_count / density)) * step)
    if density * (options.block // step) ** 2 >= 2 * min_count:
        block = options.block
    return replace(options, step=step, block=block)


def _refined(
    image: npt.NDArray[np.float32],
    camera: FloatArray,
    noise: DepthNoise,
    options: PlaneSearchOptions,
    inlier: float,
    blocks: IntArray,
    regions: FloatArray,
    region_counts: IntArray,
    target: IntArray,
) -> DepthPlanes:
    """Keep the largest regions, give them their pixels, and estimate them."""
    roots = np.flatnonzero(target == np.arange(len(target)))
    roots = roots[np.argsort(-region_counts[roots], kind="stable")][: options.max_planes]
    row_of = np.full(len(target) + 1, -1)  # the last entry is for blocks without region
    row_of[roots] = np.arange(len(roots))
    joined = np.append(row_of[target], -1)[blocks] if len(target) else np.full_like(blocks, -1)
    thetas, _, usable = _solve(regions[roots])
    step, size = options.step, max(options.block // options.step, 2)
    labels = np.full((-(-image.shape[0] // step), -(-image.shape[1] // step)), -1, np.int8)
    sums, counts = np.zeros((len(roots), 10)), np.zeros(len(roots), np.int64)
    centers = np.zeros((len(roots), 3))
    assign(
        image, camera, noise.numbers, options.bend, inlier, size, step, joined, thetas, labels, sums, counts, centers
    )

    theta, inverse, usable = _solve(sums)
    order = np.argsort(-counts, kind="stable")
    order = order[usable[order] & (counts[order] > 3)]
    renumbered = np.full(len(roots) + 1, -1, np.int8)
    renumbered[order] = np.arange(len(order), dtype=np.int8)
    theta, inverse, counts = theta[order], inverse[order], counts[order]
    residual = _quadratic(sums[order], theta)
    reduced = residual / np.maximum(counts - 3, 1)
    inverse *= (noise.correlation * np.maximum(reduced, 1.0))[:, None, None]
    length = np.linalg.norm(theta, axis=1)
    planes = np.column_stack([-theta, np.ones(len(order))]) / length[:, None]
    # d(n, w) / d theta, both divided by the length of theta.
    unit = theta / length[:, None]
    motion = np.zeros((len(order), 4, 3))
    motion[:, :3] = unit[:, :, None] * unit[:, None, :] - np.eye(3)
    motion[:, 3] = -unit / length[:, None]
    motion[:, :3] /= length[:, None, None]
    motion[:, 3] /= length[:, None]
    hesse = motion @ inverse @ motion.transpose(0, 2, 1)
    basis = NormalOffsetPlane().basis(planes)
    chart = basis.transpose(0, 2, 1) @ hesse @ basis
    middles = centers[order] / counts[:, None]
    # What is common to all pixels: tilts about the middle, and a shift.
    common = np.tile(np.diag([noise.tilt, noise.tilt, noise.shift]), (len(order), 1, 1))
    common[:, 2, :2] = -noise.tilt * np.einsum("kji,kj->ki", basis[:, :3, :2], middles)
    chart = chart + common @ common.transpose(0, 2, 1)
    hesse = basis @ chart @ basis.transpose(0, 2, 1)
    return DepthPlanes(planes, chart, hesse, counts, middles, reduced, renumbered[labels], options.step)


def _solve(sums: FloatArray) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Return theta (K, 3), the inverse of its information (K, 3, 3), and whether they are determined."""
    theta, inverse = np.zeros((len(sums), 3)), np.zeros((len(sums), 3, 3))
    usable = np.zeros(len(sums), bool)
    for row, s in enumerate(sums):
        if s[0] <= 0:
            continue
        # About the mean ray, for digits.
        mean = s[1:3] / s[0]
        inner = np.array([[s[3], s[4]], [s[4], s[5]]]) - s[0] * np.outer(mean, mean)
        determinant = inner[0, 0] * inner[1, 1] - inner[0, 1] ** 2
        if not determinant > 1e-8 * inner[0, 0] * inner[1, 1]:
            continue
        block = np.zeros((3, 3))
        block[:2, :2] = np.linalg.inv(inner)
        block[2, 2] = 1.0 / s[0]
        shift = np.eye(3)
        shift[2, :2] = -mean
        inverse[row] = shift @ block @ shift.T
        slope = block[:2, :2] @ (s[7:9] - mean * s[6])
        theta[row] = [*slope, s[6] / s[0] - slope @ mean]
        usable[row] = True
    return theta, inverse, usable


def _quadratic(sums: FloatArray, theta: FloatArray) -> FloatArray:
    """Return the sum of squared whitened distances, (K,)."""
    a, b, c = theta.T
    s = sums.T
    value = a * a * s[3] + b * b * s[5] + c * c * s[0] + 2 * (a * b * s[4] + a * c * s[1] + b * c * s[2])
    return np.maximum(value - 2 * (a * s[7] + b * s[8] + c * s[6]) + s[9], 0.0)
