# SPDX-License-Identifier: BSD-3-Clause
r"""The closest-point chart of planes: the foot point of the origin, moved as three plain numbers.

State (3,): :math:`c = -w\,n / \lVert n\rVert^2` in scene units. The factors read
:math:`(n, w) = (c, -\lVert c\rVert^2)`, and

.. math:: c \leftarrow c + \delta, \qquad B = \begin{bmatrix} I \\ -2 c^\top \end{bmatrix} .

The chart cannot hold planes through the origin: there c = 0 whatever the normal is, and (n, w) = 0 is no plane. Near
the origin it is badly scaled, since a step of the length of c turns the normal by a right angle. Use it where all
planes stay away from the origin, in the units of the scene; otherwise take ``"normal_offset"``. The chart has no
orientation: normals always point from the origin to the plane.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import FloatArray
from groma.geometry.charts.chart import Chart, reject

#: Planes nearer to the origin than this (scene units) are refused.
MINIMUM_DISTANCE = 1e-9


# ------------------------------------------------------------------------------------------------------------ Kernels
@loop
def _retract_all(state, delta, out):
    for i in range(state.shape[0]):
        for j in range(3):
            out[i, j] = state[i, j] + delta[i, j]


@kernel
def _ambient(point, out):
    out[0] = point[0]
    out[1] = point[1]
    out[2] = point[2]
    out[3] = -(point[0] * point[0] + point[1] * point[1] + point[2] * point[2])


@loop
def _ambient_all(state, out):
    for i in range(state.shape[0]):
        _ambient(state[i], out[i])


@loop
def _basis_all(state, out):
    for i in range(state.shape[0]):
        for k in range(3):
            for j in range(3):
                out[i, j, k] = 1.0 if j == k else 0.0
            out[i, 3, k] = -2.0 * state[i, k]


# ------------------------------------------------------------------------------------------------------------- Public
class ClosestPointPlane(Chart):
    """Planes by foot point of the origin, ``"closest_point"``; not for planes through the origin."""

    name: ClassVar[str] = "closest_point"
    kind: ClassVar[str] = "plane"
    state_size = 3

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Add delta (N, 3). A step that ends at the origin gives zeros, which factors count as degenerate."""
        return self._retracted(_retract_all, state, delta)

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Differences of the foot points, (N, 3)."""
        state, other = self._checked_pair(state, other)
        return other - state

    def ambient(self, state: FloatArray) -> FloatArray:
        """(n, w) = (c, -c.c), (N, 4)."""
        return self._ambient_by(_ambient_all, state)

    def from_ambient(self, ambient: FloatArray) -> FloatArray:
        """Foot points (N, 3) of planes (n, w) of any scale and sign.

        Raises
        ------
        InputError
            If a plane is not finite, all zeros, at infinity (n = 0), or within 1e-9 of the origin.
        """
        scaled = self._checked_ambient(ambient)
        length = np.linalg.norm(scaled[:, :3], axis=1, keepdims=True)
        reject(
            (length[:, 0] < 1e-150) | (np.abs(scaled[:, 3]) < MINIMUM_DISTANCE * length[:, 0]),
            np.asarray(ambient),
            "The closest-point chart holds planes that are neither at infinity nor within 1e-9 of the origin",
            "Use the chart 'normal_offset' or 'quaternion_left', or move the origin of the world.",
        )
        return -(scaled[:, 3:] / length) * (scaled[:, :3] / length)

    def basis(self, state: FloatArray) -> FloatArray:
        """Derivative of (n, w) with respect to the increment, (N, 4, 3)."""
        return self._basis_by(_basis_all, state)
