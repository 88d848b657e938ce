# SPDX-License-Identifier: BSD-3-Clause
"""Candidates of :mod:`groma.estimators.plane_search`: planes of neighbouring features, and of near segments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from groma._typing import FloatArray, IntArray
from groma.geometry._algebra import dot, norm, unit

#: Most candidates of each kind.
_MAX_CANDIDATES = 1536


@dataclass(frozen=True)
class Features:
    """Points and segment ends."""

    places: FloatArray
    covariances: FloatArray
    #: (N,) other end of the same segment, or the feature itself.
    partner: IntArray
    #: (N,) first end of the segment that a point lies on, -1 for none.
    carrier: IntArray
    #: (N,) distance at which a feature has its neighbours.
    spacing: FloatArray
    #: (N, 6) covariances as vectors whose product with :func:`squares` of a normal is the variance along it.
    packed: FloatArray

    def spread(self, normal: FloatArray, rows: IntArray | slice = slice(None)) -> FloatArray:
        """Standard deviations along a normal."""
        return np.sqrt(np.maximum(self.packed[rows] @ squares(normal), 1e-300))


def squares(normal: FloatArray) -> FloatArray:
    """Products (..., 6) of the entries of normals (..., 3), those off the diagonal twice."""
    x, y, z = normal[..., 0], normal[..., 1], normal[..., 2]
    return np.stack([x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z], axis=-1)


def from_neighbours(features: Features, neighbours: IntArray, gate: float, rng: np.random.Generator) -> FloatArray:
    """Candidates (H, 4) from a feature and two of its neighbours, improved on the neighbourhood."""
    count = min(_MAX_CANDIDATES, 4 * len(neighbours))
    seed = rng.permutation(np.repeat(np.arange(len(neighbours)), -(-count // len(neighbours))))[:count]
    patch = neighbours[seed]
    choice = rng.integers(1, patch.shape[1], (count, 2))
    corner = features.places[np.column_stack([seed, np.take_along_axis(patch, choice, 1)])]
    normal = unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    valid = norm(normal) > 0.5
    normal, center, patch = normal[valid], corner[valid, 0], patch[valid]
    around, noise = features.places[patch], features.covariances[patch]
    for _ in range(3):
        height = np.einsum("hki,hi->hk", around - center[:, None], normal)
        variance = np.einsum("hi,hkij,hj->hk", normal, noise, normal)
        weight = np.where(height**2 < 4.0 * gate * variance, 1.0, 0.0) / (variance + height**2)
        weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
        enough = (weight > 0).sum(axis=1) >= 4
        middle = np.einsum("hk,hki->hi", weight, around)
        away = around - middle[:, None]
        _, axes = np.linalg.eigh(np.einsum("hk,hki,hkj->hij", weight, away, away))
        normal = np.where(enough[:, None], axes[:, :, 0], normal)
        center = np.where(enough[:, None], middle, center)
    return np.column_stack([normal, -dot(normal, center)])


def from_segments(features: Features, num_points: int, gate: float) -> tuple[FloatArray, int]:
    """Candidates (H, 4) from pairs of near segments that are coplanar within their noise, and how many were tried."""
    ends = features.places[num_points:].reshape(-1, 2, 3)
    if len(ends) < 2:
        return np.zeros((0, 4)), 0
    middle = ends.mean(axis=1)
    count = min(12 if len(ends) > 200 else 50, len(ends))
    near = np.asarray(KDTree(middle).query(middle, k=count)[1], dtype=np.int64)
    first, second = np.repeat(np.arange(len(ends)), count - 1), near[:, 1:].ravel()
    once = np.unique(np.column_stack([np.minimum(first, second), np.maximum(first, second)]), axis=0)
    once = once[once[:, 0] != once[:, 1]]
    four = ends[once].reshape(-1, 4, 3)
    center = four.mean(axis=1)
    away = four - center[:, None]
    values, axes = np.linalg.eigh(np.einsum("hki,hkj->hij", away, away))
    normal = axes[:, :, 0]
    noise = features.covariances[num_points:].reshape(-1, 2, 3, 3)[once].reshape(-1, 4, 3, 3)
    variance = np.einsum("hi,hkij,hj->hk", normal, noise, normal).mean(axis=1)
    flat = values[:, 0] < 2.0 * gate * variance
    # Two segments on one line leave the plane open.
    flat &= values[:, 1] > 25.0 * np.maximum(values[:, 0], variance)
    chosen = np.flatnonzero(flat)
    if len(chosen) > _MAX_CANDIDATES:
        chosen = chosen[np.argsort(-values[chosen, 1] / variance[chosen], kind="stable")[:_MAX_CANDIDATES]]
    return np.column_stack([normal, -dot(normal, center)])[chosen], len(once)
