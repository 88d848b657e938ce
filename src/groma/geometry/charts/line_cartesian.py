# SPDX-License-Identifier: BSD-3-Clause
r"""The Cartesian chart of lines: turn the direction, shift the foot point.

State: the Plücker line (m, d) with :math:`\lVert d\rVert = 1`; its foot point, the point closest to the origin, is
:math:`p = d \times m`. With unit vectors b1, b2 so that (b1, b2, d) is orthonormal and right-handed (the rule is in
:mod:`groma.geometry.charts.chart`), an increment :math:`\delta = (\alpha_1, \alpha_2, \beta_1, \beta_2)` gives

.. math:: d' = \mathrm{unit}(d + \alpha_1 b_1 + \alpha_2 b_2), \qquad p' = p + \beta_1 b_1 + \beta_2 b_2, \qquad
          m' = p' \times d',

.. math:: B = \frac{\partial (m, d)}{\partial \delta} = \begin{bmatrix}
          p \times b_1 & p \times b_2 & b_1 \times d & b_2 \times d \\ b_1 & b_2 & 0 & 0 \end{bmatrix}.

:math:`\alpha` is in radians to first order, :math:`\beta` in scene units. B has rank 4 for every finite line, also
through the origin, and is well conditioned near it; a line at infinity has no state. Far away (distance r), B
has the condition r: a line turns about its foot point, which may lie far from the part that was seen.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import FloatArray
from groma.geometry.algebra import cross
from groma.geometry.charts.chart import Chart, perpendicular, perpendicular_kernel, random_lines, reject, unit


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _retract(line, delta, b, out):
    mx, my, mz, dx, dy, dz = line[0], line[1], line[2], line[3], line[4], line[5]
    perpendicular_kernel(dx, dy, dz, b)
    px = dy * mz - dz * my + delta[2] * b[0, 0] + delta[3] * b[1, 0]
    py = dz * mx - dx * mz + delta[2] * b[0, 1] + delta[3] * b[1, 1]
    pz = dx * my - dy * mx + delta[2] * b[0, 2] + delta[3] * b[1, 2]
    dx += delta[0] * b[0, 0] + delta[1] * b[1, 0]
    dy += delta[0] * b[0, 1] + delta[1] * b[1, 1]
    dz += delta[0] * b[0, 2] + delta[1] * b[1, 2]
    k = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    dx *= k
    dy *= k
    dz *= k
    out[0] = py * dz - pz * dy
    out[1] = pz * dx - px * dz
    out[2] = px * dy - py * dx
    out[3] = dx
    out[4] = dy
    out[5] = dz


@loop
def _retract_all(state, delta, out):
    b = np.empty((2, 3))
    for i in range(state.shape[0]):
        _retract(state[i], delta[i], b, out[i])


@kernel
def _basis(line, b, B):
    mx, my, mz, dx, dy, dz = line[0], line[1], line[2], line[3], line[4], line[5]
    perpendicular_kernel(dx, dy, dz, b)
    px = dy * mz - dz * my
    py = dz * mx - dx * mz
    pz = dx * my - dy * mx
    for k in range(2):
        x, y, z = b[k, 0], b[k, 1], b[k, 2]
        B[0, k] = py * z - pz * y
        B[1, k] = pz * x - px * z
        B[2, k] = px * y - py * x
        B[3, k] = x
        B[4, k] = y
        B[5, k] = z
        B[0, 2 + k] = y * dz - z * dy
        B[1, 2 + k] = z * dx - x * dz
        B[2, 2 + k] = x * dy - y * dx
        B[3, 2 + k] = 0.0
        B[4, 2 + k] = 0.0
        B[5, 2 + k] = 0.0


@loop
def _basis_all(state, out):
    b = np.empty((2, 3))
    for i in range(state.shape[0]):
        _basis(state[i], b, out[i])


# ------------------------------------------------------------------------------------------------------------- Public
class CartesianLine(Chart):
    """Lines by unit direction and foot point, ``"cartesian"``; regular for every finite line."""

    name: ClassVar[str] = "cartesian"
    kind: ClassVar[str] = "line"
    state_size = 6

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Move lines (N, 6) by (alpha1, alpha2, beta1, beta2) (N, 4); m is orthogonal to d afterwards."""
        return self._retracted(_retract_all, state, delta)

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Increments (N, 4) that lead to the lines ``other``.

        No increment turns a direction by 90 degrees or more. Where d and d' enclose more, the opposite orientation of
        ``other`` is the goal: the same line, (-m', -d').
        """
        state, other = self._checked_pair(state, other)
        d, d_other = state[:, 3:], other[:, 3:]
        p, p_other = cross(d, state[:, :3]), cross(d_other, other[:, :3])
        cosine = np.sum(d * d_other, axis=1, keepdims=True)
        cosine = np.where(cosine == 0.0, 1e-100, cosine)  # out of reach: huge, but finite
        # The point of the other line in the plane through p perpendicular to d.
        shift = p_other - np.sum(p_other * d, axis=1, keepdims=True) / cosine * d_other - p
        b = np.stack(perpendicular(d), axis=1)
        alpha = (b @ (d_other / cosine)[:, :, None])[:, :, 0]
        return np.hstack([alpha, (b @ shift[:, :, None])[:, :, 0]])

    def from_ambient(self, ambient: FloatArray) -> FloatArray:
        """State (N, 6) of Plücker lines (m, d) of any scale; of a moment that is not orthogonal to d, the rest is kept.

        Raises
        ------
        InputError
            If a line is not finite, all zeros, or at infinity (d = 0).
        """
        scaled = self._checked_ambient(ambient)
        length = np.linalg.norm(scaled[:, 3:], axis=1, keepdims=True)
        reject(
            length[:, 0] < 1e-150,
            np.asarray(ambient),
            "The Cartesian chart holds finite lines, with a direction d other than zero",
            "Use the chart 'orthonormal_right' for lines at infinity, or drop the line.",
        )
        d = unit(scaled[:, 3:])
        foot = cross(d, scaled[:, :3] / length)
        return np.hstack([np.asarray(cross(foot, d), dtype=np.float64), d])

    def basis(self, state: FloatArray) -> FloatArray:
        """Derivative of (m, d) with respect to the increment, (N, 6, 4)."""
        return self._basis_by(_basis_all, state)

    def random(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Lines with unit direction, 0.5 to 2 units from the origin."""
        return random_lines(rng, count)
