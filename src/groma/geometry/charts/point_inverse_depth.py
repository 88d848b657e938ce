# SPDX-License-Identifier: BSD-3-Clause
r"""The inverse-depth chart of points: plain increments, taken so that far points move as their images do.

State (7,): the point x, an anchor c, for example the mean of the camera centres that see it, and a share k. With
:math:`v = x - c`, a step :math:`\delta` splits into the share :math:`a = v\cdot\delta / \lVert v\rVert^2` along v and
the rest across it:

.. math:: x \leftarrow c + \frac{v + \delta - k a v}{1 - k a}, \qquad B = I .

To first order this is :math:`x + \delta`, so factors and normal equations do not change. With k = 1 it is linear in the
inverse of the distance, as pixels are: a point of small parallax reaches its place, however far, in one or two steps,
where adding :math:`\delta` needs dozens; and no step takes a point through its anchor to the other side. The distance
grows at most :data:`MAX_GROWTH`-fold in a step. With k = 0 steps are added: that suits points among their cameras,
which have no common depth.

J. Civera, A. J. Davison, J. M. M. Montiel, *Inverse depth parametrization for monocular SLAM*, T-RO 24, 2008, for the
linearity in the inverse depth. Here the state stays Cartesian.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from groma._numba import loop
from groma._typing import FloatArray
from groma.errors import ShapeError
from groma.geometry.charts.chart import Chart

#: Most that the distance from the anchor grows in one step (cost: more steps for points that go farther).
MAX_GROWTH = 10.0


# ------------------------------------------------------------------------------------------------------------ Kernels
@loop
def _retract_all(state, delta, largest_growth, out):
    for i in range(state.shape[0]):
        c0, c1, c2 = state[i, 3], state[i, 4], state[i, 5]
        v0, v1, v2 = state[i, 0] - c0, state[i, 1] - c1, state[i, 2] - c2
        squared = v0 * v0 + v1 * v1 + v2 * v2
        a = state[i, 6] * (v0 * delta[i, 0] + v1 * delta[i, 1] + v2 * delta[i, 2])
        a = a / squared if squared > 1e-200 else 0.0  # on its anchor a point has no direction
        growth = 1.0 / max(1.0 - a, 1.0 / largest_growth)
        if a == 0.0:  # to the last digit
            out[i, 0] = state[i, 0] + delta[i, 0]
            out[i, 1] = state[i, 1] + delta[i, 1]
            out[i, 2] = state[i, 2] + delta[i, 2]
        else:
            out[i, 0] = c0 + (v0 + (delta[i, 0] - a * v0)) * growth
            out[i, 1] = c1 + (v1 + (delta[i, 1] - a * v1)) * growth
            out[i, 2] = c2 + (v2 + (delta[i, 2] - a * v2)) * growth
        for j in range(3, 7):
            out[i, j] = state[i, j]


# ------------------------------------------------------------------------------------------------------------- Public
class InverseDepthPoint(Chart):
    """Points with an anchor each, ``"inverse_depth"``; regular everywhere but on the anchor, where steps are added."""

    name: ClassVar[str] = "inverse_depth"
    kind: ClassVar[str] = "point"
    state_size = 7

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Move the points by steps (N, 3) in scene units; the anchors stay."""
        return self._retracted(_retract_all, state, delta, MAX_GROWTH)

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Increments (N, 3) that lead to the points ``other``; their anchors do not matter.

        It inverts :meth:`retract` for points on the same side of the anchor that are up to ten times as far. For
        others there is no such step; plain differences are returned.
        """
        state, other = self._checked_pair(state, other)
        v, w, k = state[:, :3] - state[:, 3:6], other[:, :3] - state[:, 3:6], state[:, 6]
        squared = np.einsum("ni,ni->n", v, v)
        along = np.einsum("ni,ni->n", v, w) / np.where(squared > 1e-200, squared, 1.0)
        # along = (1 + (1 - k) a) / (1 - k a), solved for a
        slope = 1.0 - k + k * along
        a = (along - 1.0) / np.where(slope > 0.0, slope, 1.0)
        reachable = (squared > 1e-200) & (slope > 0.0) & (k * a <= 1.0 - 1.0 / MAX_GROWTH) & (k > 0.0)
        step = w * (1.0 - k * a)[:, None] - (1.0 - k * a)[:, None] * v
        return np.where(reachable[:, None], step, other[:, :3] - state[:, :3])

    def ambient(self, state: FloatArray) -> FloatArray:
        """The points (N, 3)."""
        return np.ascontiguousarray(self._checked_state(state)[:, :3])

    def from_ambient(self, ambient: FloatArray) -> FloatArray:
        """State of points (N, 3) anchored at the origin; see :meth:`anchored`."""
        points = np.ascontiguousarray(ambient, dtype=np.float64)
        return self.anchored(points, np.zeros_like(points))

    @staticmethod
    def anchored(points: FloatArray, anchors: FloatArray, share: float | FloatArray = 1.0) -> FloatArray:
        """State (N, 7) of points (N, 3) with anchors (N, 3) and shares (N,) between 0 and 1."""
        points, anchors = np.asarray(points, dtype=np.float64), np.asarray(anchors, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or anchors.shape != points.shape:
            raise ShapeError(f"Points and anchors must both have shape (N, 3); got {points.shape} and {anchors.shape}.")
        column = np.broadcast_to(np.asarray(share, dtype=np.float64), len(points))[:, None]
        return np.ascontiguousarray(np.hstack([points, anchors, column]))

    def basis(self, state: FloatArray) -> None:
        """Return None: the derivative is the identity."""
        return None

    def random(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Points 2 to 5 away from anchors near the origin, all on the same side, with shares of every size."""
        away = np.array([0.0, 0.0, 1.0]) + rng.uniform(-0.4, 0.4, (count, 3))
        away *= rng.uniform(2.0, 5.0, (count, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
        anchor = rng.uniform(-0.3, 0.3, (count, 3))
        return self.anchored(anchor + away, anchor, rng.choice([0.0, 0.4, 1.0], count))
