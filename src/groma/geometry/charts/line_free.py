# SPDX-License-Identifier: BSD-3-Clause
r"""The free-line charts: a frame that sits on the line, and its distance from the origin.

State (5,): the unit quaternion of :math:`R = R_{WL}` and the signed distance :math:`d_L` (scene units). The x axis of
the frame L is the direction of the line, its z axis points from the origin to the anchor, the point closest to it:

.. math:: d = R\,e_1, \qquad p_L = d_L\, R\,e_3, \qquad m = p_L \times d = d_L\, R\,e_2 .

With :math:`x_i = R e_i`, an increment (:math:`\delta_{1..3}` in radians, :math:`\delta_4` in scene units) is

.. math:: \text{right: } R \leftarrow R\,\mathrm{Exp}(\delta_{1..3}), \quad
          \text{left: } R \leftarrow \mathrm{Exp}(\delta_{1..3})\,R, \qquad d_L \leftarrow d_L + \delta_4,

.. math:: B_{right} = \begin{bmatrix} d_L x_3 & 0 & -d_L x_1 & x_2 \\ 0 & -x_3 & x_2 & 0 \end{bmatrix}, \qquad
          B_{left} = \begin{bmatrix} -m^\wedge & x_2 \\ -d^\wedge & 0 \end{bmatrix} .

This is the orthonormal chart in other coordinates: :math:`R = U \Pi` with
:math:`\Pi e_1 = e_2,\ \Pi e_2 = e_1,\ \Pi e_3 = -e_3`, and :math:`d_L = \cot\phi`. It is singular in the same place, at
:math:`d_L = 0`, where the roll about the line does nothing; lines at infinity have no state.

:math:`d_L` may pass through zero and stay negative (the z axis then points at the origin); :meth:`local` knows both
forms, and :meth:`canonical` goes back to :math:`d_L \ge 0` by a half turn about the line.

References
----------
Free line notes, (1.1)-(1.3); the derivative with respect to the line, which they lack, is derived above.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import FloatArray
from groma.geometry import quaternion
from groma.geometry.charts.chart import Chart, minus_skew_kernel, reject, turn_and_add_all, turn_between
from groma.geometry.charts.line_orthonormal import moment_frame
from groma.geometry.quaternion import to_matrix_kernel


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _ambient(state, R, out):
    to_matrix_kernel(state, R)
    for j in range(3):
        out[j] = state[4] * R[3 * j + 1]
        out[3 + j] = R[3 * j]


@loop
def _ambient_all(state, out):
    R = np.empty(9)
    for i in range(state.shape[0]):
        _ambient(state[i], R, out[i])


@kernel
def _basis_right(state, R, B):
    to_matrix_kernel(state, R)
    distance = state[4]
    for j in range(3):
        x1, x2, x3 = R[3 * j], R[3 * j + 1], R[3 * j + 2]
        B[j, 0] = distance * x3
        B[j, 1] = 0.0
        B[j, 2] = -distance * x1
        B[j, 3] = x2
        B[3 + j, 0] = 0.0
        B[3 + j, 1] = -x3
        B[3 + j, 2] = x2
        B[3 + j, 3] = 0.0


@kernel
def _basis_left(state, R, B):
    to_matrix_kernel(state, R)
    for k in range(2):
        # -v^ with v = m = d_L x2, then d = x1
        w = state[4] if k == 0 else 1.0
        x, y, z = w * R[1 - k], w * R[4 - k], w * R[7 - k]
        minus_skew_kernel(x, y, z, 3 * k, B)
    for j in range(3):
        B[j, 3] = R[3 * j + 1]
        B[3 + j, 3] = 0.0


@loop
def _basis_all(state, left, out):
    R = np.empty(9)
    for i in range(state.shape[0]):
        if left:
            _basis_left(state[i], R, out[i])
        else:
            _basis_right(state[i], R, out[i])


# ------------------------------------------------------------------------------------------------------------- Public
def _other_side(state: FloatArray) -> FloatArray:
    """The same oriented lines with the frame turned half about x and d_L negated."""
    return np.column_stack([quaternion.multiply(state[:, :4], np.array([1.0, 0.0, 0.0, 0.0])), -state[:, 4]])


class FreeLineRight(Chart):
    """Lines by frame and distance, increments from the right, ``"free_right"``."""

    name: ClassVar[str] = "free_right"
    kind: ClassVar[str] = "line"
    state_size = 5
    _left: ClassVar[bool] = False

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Turn the frame by delta1..3 and add delta4 to d_L, which may become negative."""
        return self._retracted(turn_and_add_all, state, delta, self._left)

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Increments (N, 4) that lead to the oriented lines ``other``.

        It inverts :meth:`retract` up to a rotation of 2.2 radians. Beyond that, or where ``other`` is stored with the
        opposite sign of d_L, the way is to the nearer form.
        """
        state, other = self._checked_pair(state, other)
        relative = quaternion.multiply(quaternion.conjugate(state[:, :4]), other[:, :4])
        turned = np.abs(relative[:, :1]) > 2.0 * np.abs(relative[:, 3:])
        goal = np.where(turned, _other_side(other), other)
        turn = turn_between(state[:, :4], goal[:, :4], self._left)
        return np.column_stack([turn, goal[:, 4] - state[:, 4]])

    def ambient(self, state: FloatArray) -> FloatArray:
        """(m, d) = (d_L x2, x1), (N, 6), with a unit direction."""
        return self._ambient_by(_ambient_all, state)

    def from_ambient(self, ambient: FloatArray) -> FloatArray:
        """State (N, 5) of Plücker lines (m, d) of any scale, with d_L >= 0.

        For m = 0 the y axis is the first perpendicular vector of d. Of a moment that is not orthogonal to d, the part
        along d is dropped.

        Raises
        ------
        InputError
            If a line is not finite, all zeros, or at infinity (d = 0).
        """
        scaled = self._checked_ambient(ambient)
        length = np.linalg.norm(scaled[:, 3:], axis=1)
        reject(
            length < 1e-150,
            np.asarray(ambient),
            "The free-line chart holds finite lines, with a direction d other than zero",
            "Use the chart 'orthonormal_right' for lines at infinity, or drop the line.",
        )
        x2, x1, moment = moment_frame(scaled[:, :3], scaled[:, 3:])
        R = np.stack([x1, x2, np.cross(x1, x2)], axis=2)
        return np.column_stack([quaternion.from_matrix(R), moment / length])

    def canonical(self, state: FloatArray) -> FloatArray:
        """The same oriented lines with d_L >= 0, (N, 5)."""
        state = self._checked_state(state)
        return np.where(state[:, 4:] < 0.0, _other_side(state), state)

    def basis(self, state: FloatArray) -> FloatArray:
        """Derivative of (m, d) with respect to the increment, (N, 6, 4)."""
        return self._basis_by(_basis_all, state, self._left)


class FreeLineLeft(FreeLineRight):
    """Lines by frame and distance, increments from the left, ``"free_left"``."""

    name: ClassVar[str] = "free_left"
    _left: ClassVar[bool] = True
