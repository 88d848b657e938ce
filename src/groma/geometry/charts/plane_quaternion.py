# SPDX-License-Identifier: BSD-3-Clause
r"""The quaternion charts of planes: the unit 4-vector turned as a quaternion.

State (4,): :math:`\pi = (n, w)` with :math:`\lVert\pi\rVert = 1`, read as the quaternion [x, y, z, w]. An increment
:math:`\delta \in R^3` is

.. math:: \text{left: } \pi \leftarrow \exp(\delta) \otimes \pi, \qquad
          \text{right: } \pi \leftarrow \pi \otimes \exp(\delta), \qquad
          B = \frac12 \begin{bmatrix} w I \mp n^\wedge \\ -n^\top \end{bmatrix}

(upper sign left). B has orthogonal columns of length 1/2 for every plane: the charts are regular everywhere, also for
planes through the origin and for the plane at infinity. What the three numbers *mean* changes with the plane:
they mix angle and offset. A plane at the distance r has :math:`\lVert n\rVert = 1/\sqrt{1 + r^2}`, so far planes pile
up at :math:`\pm(0, 0, 0, 1)` and a given increment turns their normals more; the unit of length matters.

:math:`\pi` and :math:`-\pi` are the same plane; :meth:`local` takes the shorter way.

References
----------
Point-line-plane notes, (12), (13), with the exponential corrected (the axis has unit length there).
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import FloatArray
from groma.geometry.charts.chart import Chart, turn_between, turn_kernel, unit


# ------------------------------------------------------------------------------------------------------------ Kernels
@loop
def _retract_all(state, delta, left, out):
    step = np.empty(4)
    for i in range(state.shape[0]):
        turn_kernel(state[i], delta[i], left, step, out[i])


@kernel
def _basis(plane, side, B):
    """Write B; ``side`` is -0.5 for the left form, 0.5 for the right one."""
    x, y, z, w = side * plane[0], side * plane[1], side * plane[2], 0.5 * plane[3]
    B[0, 0] = w
    B[0, 1] = -z
    B[0, 2] = y
    B[1, 0] = z
    B[1, 1] = w
    B[1, 2] = -x
    B[2, 0] = -y
    B[2, 1] = x
    B[2, 2] = w
    for k in range(3):
        B[3, k] = -0.5 * plane[k]


@loop
def _basis_all(state, left, out):
    side = -0.5 if left else 0.5
    for i in range(state.shape[0]):
        _basis(state[i], side, out[i])


# ------------------------------------------------------------------------------------------------------------- Public
class QuaternionPlaneLeft(Chart):
    """Planes by unit 4-vector, increments from the left, ``"quaternion_left"``."""

    name: ClassVar[str] = "quaternion_left"
    kind: ClassVar[str] = "plane"
    state_size = 4
    _left: ClassVar[bool] = True

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Turn the 4-vectors (N, 4) by delta (N, 3)."""
        return self._retracted(_retract_all, state, delta, self._left)

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Increments (N, 3), of length at most pi, that lead to the planes ``other`` or their negatives."""
        state, other = self._checked_pair(state, other)
        return turn_between(state, other, self._left)

    def from_ambient(self, ambient: FloatArray) -> FloatArray:
        """State (N, 4) of planes (n, w) of any scale; the sign is kept.

        Raises
        ------
        InputError
            If a plane is not finite or all zeros.
        """
        return unit(self._checked_ambient(ambient))

    def basis(self, state: FloatArray) -> FloatArray:
        """Derivative of (n, w) with respect to the increment, (N, 4, 3)."""
        return self._basis_by(_basis_all, state, self._left)


class QuaternionPlaneRight(QuaternionPlaneLeft):
    """Planes by unit 4-vector, increments from the right, ``"quaternion_right"``."""

    name: ClassVar[str] = "quaternion_right"
    _left: ClassVar[bool] = False
