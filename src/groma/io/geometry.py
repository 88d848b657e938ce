# SPDX-License-Identifier: BSD-3-Clause
"""Geometry without images, as meshes, edge graphs and point clouds hold it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError
from groma.geometry.algebra import finite_rows


@dataclass(frozen=True, eq=False)
class Geometry:
    """Segments, triangles, points, or several of them: a reference to compare lines and planes with."""

    #: (R, 2, 3) segments; pieces of a curve or edges of a graph are segments too.
    segments: FloatArray = field(default_factory=lambda: np.zeros((0, 2, 3)))
    #: (T, 3, 3) corners of triangles.
    triangles: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 3)))
    #: (P, 3) points of surfaces or edges.
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        for name, row in (("segments", (2, 3)), ("triangles", (3, 3)), ("points", (3,))):
            object.__setattr__(self, name, finite_rows(name, getattr(self, name), row))

    def __len__(self) -> int:
        return len(self.segments) + len(self.triangles) + len(self.points)

    @property
    def extent(self) -> float:
        """Length of the diagonal of the box around it."""
        every = np.concatenate([part.reshape(-1, 3) for part in (self.segments, self.triangles, self.points)])
        return float(np.linalg.norm(np.ptp(every, axis=0))) if len(every) else 0.0

    def surface_points(self, count: int = 200_000, seed: int = 0) -> FloatArray:
        """Return the points (n, 3), or ``count`` uniform random samples of the triangles.

        Raises
        ------
        InputError
            If the triangles have no area.
        """
        if len(self.triangles) == 0:
            return self.points
        rng = np.random.default_rng(seed)
        first, second = (self.triangles[:, k] - self.triangles[:, 0] for k in (1, 2))
        area = np.linalg.norm(np.cross(first, second), axis=1)
        if not area.sum() > 0:
            raise InputError("The triangles of the reference have no area.")
        row = rng.choice(len(area), count, p=area / area.sum())
        a, b = rng.random((2, count, 1))
        a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
        return self.triangles[row, 0] + a * first[row] + b * second[row]
