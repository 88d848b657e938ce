# SPDX-License-Identifier: BSD-3-Clause
r"""Unit vectors, the sphere S²: exponential, logarithm, and the chart of directions.

A tangent vector :math:`\tau \perp u` moves u along a great circle,

.. math:: \mathrm{Exp}_u(\tau) = \cos\lVert\tau\rVert\,u + \frac{\sin\lVert\tau\rVert}{\lVert\tau\rVert}\,\tau,
          \qquad \mathrm{Log}_u(v) = \mathrm{atan2}(\lVert u \times v\rVert, u\cdot v)\,
          \frac{v - (u\cdot v)\,u}{\lVert v - (u\cdot v)\,u\rVert} .

Two numbers suffice in a basis (b1, b2) of the tangent plane: :math:`\tau = \delta_1 b_1 + \delta_2 b_2`.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError
from groma.geometry.algebra import as_rows, vectors
from groma.geometry.charts.chart import as_steps, perpendicular, unit
from groma.geometry.charts.registry import charts_of, register_chart
from groma.geometry.manifold import Manifold


def tangent_basis(direction: FloatArray) -> FloatArray:
    """Two orthonormal vectors (..., 2, 3) perpendicular to unit vectors (..., 3); continuous where z keeps its sign."""
    direction = vectors(direction, 3, "A direction")
    first, second = perpendicular(direction.reshape(-1, 3))
    return np.stack([first, second], axis=1).reshape(*direction.shape[:-1], 2, 3)


def exp(direction: FloatArray, tangent: FloatArray) -> FloatArray:
    """Unit vectors (..., 3) reached from ``direction`` along ``tangent`` (..., 3), radians."""
    u, t = vectors(direction, 3, "A direction"), vectors(tangent, 3, "A direction")
    angle = np.linalg.norm(t, axis=-1, keepdims=True)
    return np.cos(angle) * u + np.sinc(angle / np.pi) * t


def log(direction: FloatArray, other: FloatArray) -> FloatArray:
    """Tangent vector (..., 3) that leads from ``direction`` to ``other``; one of length pi if they are opposite."""
    u, v = vectors(direction, 3, "A direction"), vectors(other, 3, "A direction")
    cosine = np.sum(u * v, axis=-1, keepdims=True)
    across = v - cosine * u
    across = across - np.sum(across * u, axis=-1, keepdims=True) * u  # exactly tangent, also for opposite vectors
    sine = np.linalg.norm(across, axis=-1, keepdims=True)
    angle = np.arctan2(sine, cosine)
    opposite = (sine < 1e-15) & (cosine < 0)
    along = np.where(opposite, tangent_basis(u)[..., 0, :], across)
    length = np.where(opposite, 1.0, np.where(sine > 0, sine, 1.0))
    return angle * along / length


def turned(direction: FloatArray, delta: FloatArray) -> FloatArray:
    """Unit vectors (N, 3) reached by angles (N, 2), radians, along the tangent basis."""
    first, second = perpendicular(direction)
    return unit(exp(direction, delta[:, :1] * first + delta[:, 1:] * second))


@register_chart
class Unit3(Manifold):
    """The chart of directions: two numbers in the tangent basis. The sign of a direction is kept."""

    name: ClassVar[str] = "sphere"
    kind: ClassVar[str] = "direction"
    state_size, ambient_size, factor_columns, dof = 3, 3, 3, 2

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Move unit vectors (N, 3) by angles (N, 2), radians, along the tangent basis."""
        return turned(*as_steps(state, delta, 3, 2))

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Angles (N, 2) that lead from ``state`` to ``other``."""
        return np.einsum("nkj,nj->nk", tangent_basis(state), log(state, other))

    def ambient(self, state: FloatArray) -> FloatArray:
        """The unit vectors themselves, (N, 3)."""
        return state

    def from_ambient(self, ambient: FloatArray) -> FloatArray:
        """Unit vectors (N, 3) of vectors of any length.

        Raises
        ------
        InputError
            If a vector is zero or not finite.
        """
        ambient = as_rows(ambient, (3,), "ambient")
        length = np.linalg.norm(ambient, axis=-1)
        if not (length > 0).all() or not np.isfinite(length).all():
            raise InputError("A direction must be a finite vector that is not zero. Drop it, or build it again.")
        return unit(ambient)

    def basis(self, state: FloatArray) -> FloatArray:
        """The tangent basis as columns, (N, 3, 2)."""
        return np.ascontiguousarray(np.swapaxes(tangent_basis(state), -1, -2))

    def random(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Unit vectors, uniform on the sphere."""
        return unit(rng.normal(size=(count, 3)))


#: Charts of directions by name, registered ones too.
DIRECTION_CHARTS = charts_of("direction")
