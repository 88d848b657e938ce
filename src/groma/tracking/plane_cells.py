# SPDX-License-Identifier: BSD-3-Clause
r"""Planes of a depth image: small cells are fitted on their own, and neighbours that agree are joined.

Within a cell the plane is :math:`n \cdot X + w = 0`. All sums of a cell are kept, so a joined region is fitted without
going back to its points. With points :math:`X_i` of standard deviation :math:`\sigma_i` along the normal, and tangents
:math:`b_1, b_2`, the information on the two angles of the normal and on the offset is
:math:`\sum \sigma_i^{-2} a_i a_i^\top`, :math:`a_i = (b_1 \cdot X_i, b_2 \cdot X_i, 1)`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from groma._typing import FloatArray, IntArray
from groma.factors.plane_observation import PlaneObservation, Ref
from groma.tracking.camera import TrackCamera
from groma.tracking.depth import DepthImage, depth_sigma

STRIDE = 4  # every so many pixels a point
CELL = 5  # points along the side of a cell
MIN_CELLS = 12  # of a plane
#: Depth errors of neighbours are alike, and a depth camera bends planes: of all points this share counts, and no plane
#: is known better than the floors (radians, scene units).
EFFECTIVE = 0.02
ANGLE_FLOOR, OFFSET_FLOOR = 0.004, 0.004


@dataclass(frozen=True)
class DepthPlanes:
    """Planes seen by one frame."""

    #: (K, 4) unit normal towards the camera, and offset.
    plane: FloatArray
    #: (K, 3, 3) square root information in the basis of ``PlaneObservation``.
    sqrt_information: FloatArray
    #: (K,) number of points.
    support: FloatArray
    #: Centres of the cells (C, 3) in the camera, and the plane of each (C,).
    cells: FloatArray
    cell_plane: IntArray

    def __len__(self) -> int:
        return len(self.plane)


def find_depth_planes(camera: TrackCamera, image: DepthImage, max_depth: float, max_planes: int = 10) -> DepthPlanes:
    """Find the planes of a depth image, largest first."""
    points, sigma = _points(camera, image, max_depth)
    moments, counts, spread = _cell_moments(points, sigma)
    rows, columns = counts.shape
    flat = moments.reshape(-1, 10)
    good = counts.ravel() >= 0.7 * CELL * CELL
    normal, offset, thick, centre = _fit(flat)
    noise = np.maximum(spread.ravel(), 1e-6)
    good &= thick < 2.0 * noise
    good &= np.abs((normal * centre).sum(axis=1)) > 0.15 * np.linalg.norm(centre, axis=1)
    labels = _join(normal, offset, centre, noise, good, rows, columns)
    none = DepthPlanes(np.zeros((0, 4)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0, np.int64))
    if labels.max(initial=-1) < 0:
        return none
    # Refit regions, let cells choose the plane that fits them best, refit again.
    keep = np.zeros(0, np.int64)
    for _ in range(2):
        count = labels.max() + 1
        sums = np.zeros((count, 10))
        np.add.at(sums, labels[labels >= 0], flat[labels >= 0])
        size = np.bincount(labels[labels >= 0], minlength=count)
        keep = np.flatnonzero(size >= MIN_CELLS)
        if not len(keep):
            return none
        keep = keep[np.argsort(-size[keep], kind="stable")][:max_planes]
        keep = _distinct(*_fit(sums[keep])[:2], keep)
        region_normal, region_offset, _, _ = _fit(sums[keep])
        away = np.abs(centre @ region_normal.T + region_offset)
        tilt = np.abs(normal @ region_normal.T)
        fits = (away < 3.0 * noise[:, None]) & (tilt > np.cos(0.3)) & good[:, None]
        near = _touching(labels, keep, rows, columns)
        away = np.where(fits & near, away, np.inf)
        labels = np.where(np.isfinite(away).any(axis=1), away.argmin(axis=1), -1)
    count = len(keep)
    sums = np.zeros((count, 10))
    np.add.at(sums, labels[labels >= 0], flat[labels >= 0])
    size = np.bincount(labels[labels >= 0], minlength=count)
    keep = np.flatnonzero(size >= MIN_CELLS)
    if not len(keep):
        return none
    new = np.full(count, -1)
    new[keep] = np.arange(len(keep))
    labels = np.where(labels >= 0, new[labels], -1)
    normal, offset, _, _ = _fit(sums[keep])
    plane = np.hstack([normal, offset[:, None]])
    plane *= np.where(plane[:, 3:] < 0, -1.0, 1.0)  # the camera lies on the positive side
    of_plane = np.flatnonzero(labels >= 0)
    return DepthPlanes(
        plane,
        _sqrt_information(plane, sums[keep]),
        (size[keep] * float(CELL * CELL)).astype(np.float64),
        centre[of_plane],
        labels[of_plane],
    )


def _points(camera: TrackCamera, image: DepthImage, max_depth: float) -> tuple[FloatArray, FloatArray]:
    """Points (h, w, 3) on a grid, zero where unknown, and their standard deviations."""
    half = STRIDE // 2
    z = image[half::STRIDE, half::STRIDE].astype(np.float64)
    z = np.where((z > 0.1) & (z <= max_depth), z, 0.0)
    u = np.arange(z.shape[1]) * STRIDE + half + 0.5
    v = np.arange(z.shape[0]) * STRIDE + half + 0.5
    x, y = (u - camera.cx) / camera.fx * z, ((v - camera.cy) / camera.fy)[:, None] * z
    return np.stack([x, y, z], axis=2), depth_sigma(z)


def _cell_moments(points: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weighted sums (r, c, 10) of 1, X, X Xᵀ over cells, the number of points, and their mean sigma."""
    rows, columns = points.shape[0] // CELL, points.shape[1] // CELL
    points = points[: rows * CELL, : columns * CELL]
    sigma = sigma[: rows * CELL, : columns * CELL]
    known = points[..., 2] > 0
    weight = np.where(known, 1.0 / sigma**2, 0.0)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    terms = np.stack([np.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], axis=2) * weight[..., None]
    blocks = terms.reshape(rows, CELL, columns, CELL, 10).sum(axis=(1, 3))
    counts = known.reshape(rows, CELL, columns, CELL).sum(axis=(1, 3)).astype(float)
    spread = (sigma * known).reshape(rows, CELL, columns, CELL).sum(axis=(1, 3)) / np.maximum(counts, 1)
    return blocks, counts, spread


def _fit(sums: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Unit normal, offset, root mean square distance and centre of weighted sums (N, 10)."""
    total = np.maximum(sums[:, 0], 1e-12)
    centre = sums[:, 1:4] / total[:, None]
    upper = sums[:, 4:] / total[:, None]
    S = np.empty((len(sums), 3, 3))
    for k, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        S[:, i, j] = S[:, j, i] = upper[:, k] - centre[:, i] * centre[:, j]
    values, vectors = np.linalg.eigh(S)
    normal = vectors[:, :, 0]
    return normal, -(normal * centre).sum(axis=1), np.sqrt(np.maximum(values[:, 0], 0.0)), centre


def _join(normal, offset, centre, noise, good, rows, columns) -> IntArray:
    """Label cells by connected regions in which neighbours agree; -1 for cells that belong to none."""
    grid = np.arange(rows * columns).reshape(rows, columns)
    first = np.concatenate([grid[:, :-1].ravel(), grid[:-1].ravel()])
    second = np.concatenate([grid[:, 1:].ravel(), grid[1:].ravel()])
    tilt = np.abs((normal[first] * normal[second]).sum(axis=1)) > np.cos(0.12)
    gap = centre[second] - centre[first]
    limit = 2.0 * np.maximum(noise[first], noise[second]) + 0.002
    flat = (np.abs((gap * normal[first]).sum(axis=1)) < limit) & (np.abs((gap * normal[second]).sum(axis=1)) < limit)
    joined = good[first] & good[second] & tilt & flat
    graph = coo_array((np.ones(joined.sum()), (first[joined], second[joined])), shape=(rows * columns,) * 2)
    labels = connected_components(graph, directed=False)[1].astype(np.int64)
    size = np.bincount(labels)
    order = np.full(len(size), -1)
    big = np.flatnonzero(size >= MIN_CELLS // 2)
    order[big] = np.arange(len(big))
    return np.where(good, order[labels], -1)


def _distinct(normal: FloatArray, offset: FloatArray, keep: IntArray) -> IntArray:
    """Drop regions that lie on a larger one."""
    chosen: list[int] = []
    for k in range(len(keep)):
        same = [
            j for j in chosen
            if abs(normal[j] @ normal[k]) > np.cos(0.05)
            and abs(offset[k] * np.sign(normal[j] @ normal[k]) - offset[j]) < 0.02 + 0.01 * abs(offset[j])
        ]  # fmt: skip
        if not same:
            chosen.append(k)
    return keep[chosen]


def _touching(labels: IntArray, keep: IntArray, rows: int, columns: int) -> np.ndarray:
    """Which cells (C, K) belong to a region or lie beside it, two cells deep, or touch any part of its plane."""
    grid = labels.reshape(rows, columns)
    out = np.zeros((len(keep), rows + 4, columns + 4), dtype=bool)
    for k, region in enumerate(keep):
        member = grid == region
        for i in range(5):
            for j in range(5):
                out[k, i : i + rows, j : j + columns] |= member
    return out[:, 2 : rows + 2, 2 : columns + 2].reshape(len(keep), -1).T


def _sqrt_information(plane: FloatArray, sums: FloatArray) -> FloatArray:
    """(K, 3, 3) square roots of the information on angles and offset."""
    count = len(plane)
    none = np.zeros(count, np.int64)
    factor = PlaneObservation(pose=Ref("p", none), plane=Ref("q", none), planes_in_cam=plane)
    basis = factor.basis
    S = np.empty((count, 3, 3))
    for k, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        S[:, i, j] = S[:, j, i] = sums[:, 4 + k]
    info = np.empty((count, 3, 3))
    # The residual in the basis is Bᵀ n, and a distance grows by X · B of it.
    info[:, :2, :2] = np.einsum("kia,kij,kjb->kab", basis, S, basis)
    info[:, :2, 2] = info[:, 2, :2] = np.einsum("kia,ki->ka", basis, sums[:, 1:4])
    info[:, 2, 2] = sums[:, 0]
    covariance = np.linalg.inv(EFFECTIVE * info + 1e-9 * np.eye(3))
    covariance += np.diag([ANGLE_FLOOR**2, ANGLE_FLOOR**2, OFFSET_FLOOR**2])
    return np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)), np.float64).transpose(0, 2, 1)


__all__ = ["DepthPlanes", "find_depth_planes"]
