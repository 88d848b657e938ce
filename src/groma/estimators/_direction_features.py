# SPDX-License-Identifier: BSD-3-Clause
"""What a common direction is tested against: normals perpendicular to it, or directions parallel to it.

Both whiten their residuals; the formulas stand in :mod:`groma.estimators.directions` and
:mod:`groma.estimators._parallel_lines`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from groma._numba import loop
from groma._typing import BoolArray, FloatArray, IntArray
from groma.geometry.algebra import norm, perpendicular, perpendicular_to, unit


# ------------------------------------------------------------------------------------------------------------ Kernels
@loop
def refine_perpendicular(normals, factors, sigma, gate, wider, max_move, steps, direction, covariance):
    """Refine a unit ``direction`` by robust least squares, in place, and write its covariance.

    Gauss-Newton steps with Geman-McClure weights on the normals within ``wider`` times the squared ``gate``; the last
    round takes those within the gate as they are and moves nothing.
    """
    x, y, z = direction[0], direction[1], direction[2]
    for step in range(steps):
        last = step == steps - 1
        limit = gate if last else wider * gate
        a1, b1, c1, a2, b2, c2 = perpendicular_to(x, y, z)
        h11, h12, h22, g1, g2, squares, count = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
        for n in range(len(normals)):
            u, v, w = normals[n, 0], normals[n, 1], normals[n, 2]
            first = factors[n, 0, 0] * x + factors[n, 1, 0] * y + factors[n, 2, 0] * z
            second = factors[n, 0, 1] * x + factors[n, 1, 1] * y + factors[n, 2, 1] * z
            variance = first * first + second * second + sigma * sigma
            residual = u * x + v * y + w * z
            square = residual * residual / variance
            if not square < limit:
                continue
            slope1, slope2 = u * a1 + v * b1 + w * c1, u * a2 + v * b2 + w * c2
            weight = (1.0 if last else 1.0 / ((1.0 + square / gate) * (1.0 + square / gate))) / variance
            h11 += weight * slope1 * slope1
            h12 += weight * slope1 * slope2
            h22 += weight * slope2 * slope2
            g1 += weight * slope1 * residual
            g2 += weight * slope2 * residual
            squares += square
            count += 1
        more = 1e-6 * max(h11 + h22, 1e-300)
        h11, h22 = h11 + more, h22 + more
        part = h12 / h11
        left = h22 - part * h12
        if last:
            scale = max(1.0, squares / max(count - 2, 1))
            i22 = scale / left
            i12, i11 = -part * i22, scale / h11 + part * part * i22
            first_basis, second_basis = (a1, b1, c1), (a2, b2, c2)
            for i in range(3):
                for j in range(3):
                    covariance[i, j] = (
                        i11 * first_basis[i] * first_basis[j]
                        + i12 * (first_basis[i] * second_basis[j] + second_basis[i] * first_basis[j])
                        + i22 * second_basis[i] * second_basis[j]
                    )
            break
        move2 = -(g2 - part * g1) / left
        move1 = -(g1 + h12 * move2) / h11
        share = min(1.0, max_move / max(math.sqrt(move1 * move1 + move2 * move2), 1e-300))
        move1, move2 = share * move1, share * move2
        x, y, z = x + move1 * a1 + move2 * a2, y + move1 * b1 + move2 * b2, z + move1 * c1 + move2 * c2
        length = max(math.sqrt(x * x + y * y + z * z), 1e-300)
        x, y, z = x / length, y / length, z / length
    direction[0], direction[1], direction[2] = x, y, z


# ------------------------------------------------------------------------------------------------------------- Public
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

    def refined(
        self, start: FloatArray, gate: float, wider: float, max_move: float, steps: int
    ) -> tuple[FloatArray, FloatArray]:
        """Direction (3,) of robust least squares and its covariance (3, 3), from one that is near it.

        ``gate`` bounds the squares of what agrees, ``wider`` times as large ones take part in the search.
        """
        direction, covariance = unit(np.array(start, dtype=np.float64)), np.zeros((3, 3))
        normals, factors = np.ascontiguousarray(self.normals), np.ascontiguousarray(self.factors)
        refine_perpendicular(normals, factors, self.sigma, gate, wider, max_move, steps, direction, covariance)
        return direction, covariance


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
    """Candidates: cross products of random pairs of normals, drawn by their certainty."""
    certainty = 1.0 / np.sqrt((pool.factors**2).sum(axis=(1, 2)) + pool.sigma**2)
    pairs = rng.choice(len(pool), (count, 2), p=certainty / certainty.sum())
    crossed = np.cross(pool.normals[pairs[:, 0]], pool.normals[pairs[:, 1]])
    return unit(crossed[norm(crossed) > min_sine])
