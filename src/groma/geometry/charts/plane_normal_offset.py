# SPDX-License-Identifier: BSD-3-Clause
r"""The normal-and-offset chart of planes: the unit normal turns, the offset shifts.

State (4,): (n, w) with :math:`\lVert n\rVert = 1`. With (b1, b2, n) orthonormal (the rule is in
:mod:`groma.geometry.charts.chart`) and :math:`\tau = \delta_1 b_1 + \delta_2 b_2`, an increment (two angles in radians,
one length in scene units) is

.. math:: n \leftarrow \cos\lVert\tau\rVert\, n + \frac{\sin\lVert\tau\rVert}{\lVert\tau\rVert}\,\tau, \qquad
          w \leftarrow w + \delta_3, \qquad
          B = \begin{bmatrix} b_1 & b_2 & 0 \\ 0 & 0 & 1 \end{bmatrix} .

B has orthonormal columns for every finite plane, near, far and through the origin; the plane at infinity (n = 0) has no
state. Angles and lengths stay apart, so the chart suits planes whose noise is known in radians and metres. The plane
turns about its foot point of the origin: far from it, a small angle is a large shift.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from groma._typing import FloatArray
from groma.geometry.charts.chart import Chart, perpendicular, random_planes, reject
from groma.geometry.charts.unit3 import turned


class NormalOffsetPlane(Chart):
    """Planes by unit normal and offset, ``"normal_offset"``; regular for every finite plane."""

    name: ClassVar[str] = "normal_offset"
    kind: ClassVar[str] = "plane"
    state_size = 4

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Turn the normals by delta1, delta2 and add delta3 to the offsets."""
        state, delta = self._checked_step(state, delta)
        return np.column_stack([turned(state[:, :3], delta[:, :2]), state[:, 3] + delta[:, 2]])

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Increments (N, 3) that lead to the planes ``other``.

        It inverts :meth:`retract` up to a turn of 2.2 radians. Beyond that the way is to (-n', -w'), the same plane.
        """
        state, other = self._checked_pair(state, other)
        n = state[:, :3]
        cosine = np.sum(n * other[:, :3], axis=1)
        sign = np.where(cosine < -0.6, -1.0, 1.0)  # derived from cos(2 atan 2), as for the charts of lines
        goal = sign[:, None] * other
        b = np.stack(perpendicular(n), axis=1)
        tangent = (b @ goal[:, :3, None])[:, :, 0]
        sine = np.linalg.norm(tangent, axis=1)
        angle = np.arctan2(sine, sign * cosine)
        ratio = np.where(sine > 0.0, angle / np.where(sine > 0.0, sine, 1.0), 1.0)
        return np.column_stack([ratio[:, None] * tangent, goal[:, 3] - state[:, 3]])

    def from_ambient(self, ambient: FloatArray) -> FloatArray:
        """State (N, 4) of planes (n, w) of any scale; the orientation is kept.

        Raises
        ------
        InputError
            If a plane is not finite, all zeros, or at infinity (n = 0).
        """
        scaled = self._checked_ambient(ambient)
        length = np.linalg.norm(scaled[:, :3], axis=1, keepdims=True)
        reject(
            length[:, 0] < 1e-150,
            np.asarray(ambient),
            "The normal-and-offset chart holds finite planes, with a normal n other than zero",
            "Use the chart 'quaternion_left' for the plane at infinity, or drop the plane.",
        )
        return scaled / length

    def basis(self, state: FloatArray) -> FloatArray:
        """Derivative of (n, w) with respect to the increment, (N, 4, 3)."""
        state = self._checked_state(state)
        out = np.zeros((len(state), 4, 3))
        out[:, :3, 0], out[:, :3, 1] = perpendicular(state[:, :3])
        out[:, 3, 2] = 1.0
        return out

    def random(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Planes 0.5 to 2 units from the origin."""
        return random_planes(rng, count)
