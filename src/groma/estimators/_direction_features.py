# SPDX-License-Identifier: BSD-3-Clause
"""What a common direction is tested against: normals perpendicular to it, or directions parallel to it.

Both whiten their residuals; the formulas stand in :mod:`groma.estimators.directions` and
:mod:`groma.estimators._parallel_lines`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.geometry.algebra import norm, perpendicular, unit


@dataclass(frozen=True)
class Perpendicular:
    """Normals to which the direction is perpendicular. Directions are (H, 3), results (H, N)."""

    normals: FloatArray
    factors: FloatArray
    sigma: float

    def take(self, rows: IntArray | BoolArray) -> Perpendicular:
        return Perpendicular(self.normals[rows], self.factors[rows], self.sigma)

    def __len__(self) -> int:
        return len(self.normals)

    def _variance(self, directions: FloatArray) -> FloatArray:
        return (directions @ self.factors[..., 0].T) ** 2 + (directions @ self.factors[..., 1].T) ** 2 + self.sigma**2

    def squared(self, directions: FloatArray) -> FloatArray:
        """Squared whitened residuals."""
        return (directions @ self.normals.T) ** 2 / self._variance(directions)

    def chance(self, directions: FloatArray, gate: float) -> FloatArray:
        """Probabilities to agree with a random direction within ``gate``."""
        # n.v of a random direction is uniform in -1 .. 1.
        return np.minimum(np.sqrt(gate * self._variance(directions)), 1.0)

    def rows(self, direction: FloatArray) -> FloatArray:
        """Whitened rows (N, freedom, 3): residuals are their products with the direction."""
        return (self.normals / np.sqrt(self._variance(direction[None])[0])[:, None])[:, None]


@dataclass(frozen=True)
class Parallel:
    """Directions to which the direction is parallel: whitened bases and the square roots of their determinants."""

    directions: FloatArray
    whitened: FloatArray
    area: FloatArray

    @classmethod
    def of(cls, directions: FloatArray, covariance: FloatArray, sigma: FloatArray) -> Parallel:
        basis = np.stack(perpendicular(directions), axis=1)
        inner = basis @ covariance @ np.swapaxes(basis, 1, 2) + sigma[:, None, None] ** 2 * np.eye(2)
        # Eigenvalues and axes of two by two numbers: a hundred times as fast as those of any matrix.
        first, mixed, second = inner[:, 0, 0], inner[:, 0, 1], inner[:, 1, 1]
        half = 0.5 * (first - second)
        large = 0.5 * (first + second) + np.hypot(half, mixed)
        small = (first * second - mixed**2) / large
        turn = 0.5 * np.arctan2(mixed, half)
        axes = np.stack([np.cos(turn), np.sin(turn), -np.sin(turn), np.cos(turn)], axis=1).reshape(-1, 2, 2)
        scaled = axes / np.sqrt(np.stack([large, small], axis=1))[..., None]
        return cls(directions, scaled @ basis, np.sqrt(large * small))

    @cached_property
    def products(self) -> FloatArray:
        """Products (N, 9) of the whitened bases with themselves."""
        return (np.swapaxes(self.whitened, 1, 2) @ self.whitened).reshape(-1, 9)

    def __len__(self) -> int:
        return len(self.area)

    def squared(self, directions: FloatArray) -> FloatArray:
        """Squared whitened residuals."""
        return (directions @ self.whitened[:, 0].T) ** 2 + (directions @ self.whitened[:, 1].T) ** 2


def crossings(pool: Perpendicular, count: int, min_sine: float, rng: np.random.Generator) -> FloatArray:
    """Candidates: cross products of so many pairs of normals, drawn by their certainty."""
    certainty = 1.0 / np.sqrt((pool.factors**2).sum(axis=(1, 2)) + pool.sigma**2)
    pairs = rng.choice(len(pool), (count, 2), p=certainty / certainty.sum())
    crossed = np.cross(pool.normals[pairs[:, 0]], pool.normals[pairs[:, 1]])
    return unit(crossed[norm(crossed) > min_sine])
