# SPDX-License-Identifier: BSD-3-Clause
r"""The orthonormal charts of lines: a rotation and an angle.

State (5,): the unit quaternion of the rotation :math:`U = [u_1\,u_2\,u_3]` and an angle :math:`\phi`. With
:math:`w_1 = \cos\phi,\ w_2 = \sin\phi` the line is

.. math:: m = w_1 u_1, \qquad d = w_2 u_2, \qquad \phi = \mathrm{atan2}(\lVert d\rVert, \lVert m\rVert),

of unit norm as a 6-vector. An increment :math:`\theta` (radians) is

.. math:: \text{right: } U \leftarrow U\,\mathrm{Exp}(\theta_{1..3}), \quad
          \text{left: } U \leftarrow \mathrm{Exp}(\theta_{1..3})\,U, \qquad \phi \leftarrow \phi + \theta_4,

.. math:: B_{right} = \begin{bmatrix} 0 & -w_1 u_3 & w_1 u_2 & -w_2 u_1 \\ w_2 u_3 & 0 & -w_2 u_1 & w_1 u_2
          \end{bmatrix}, \qquad
          B_{left} = \begin{bmatrix} -w_1 u_1^\wedge & -w_2 u_1 \\ -w_2 u_2^\wedge & w_1 u_2 \end{bmatrix}
                   = B_{right}\,\mathrm{blkdiag}(U^\top, 1) .

The charts are singular for lines through the origin (:math:`m = 0`: column 2 of the right form vanishes, and the line
can leave the origin in the direction :math:`\pm u_3` only) and for lines at infinity (:math:`d = 0`, column 1). The
roll that is undefined there is chosen by a fixed rule. Where :math:`\lVert m\rVert / \lVert d\rVert` is far from 1 the
columns have very different lengths: choose the unit of length so that lines are about one unit away.

Turning U by 180 degrees about one of its axes and reflecting :math:`\phi` gives the same oriented line in four ways.
An increment may carry :math:`\phi` through 0 or 90 degrees; that is left as it is. :meth:`local` knows all four, and
:meth:`canonical` goes back to :math:`0 \le \phi \le \pi/2`.

References
----------
Plücker notes, (70)-(72) and (84), right form: the signs of W in (71) are corrected here. Point-line-plane notes, (9),
left form. Both follow Bartoli and Sturm, *Structure-from-motion using lines*, 2005.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import FloatArray, IntArray
from groma.geometry import quaternion
from groma.geometry.charts.chart import Chart, minus_skew_kernel, perpendicular, turn_and_add_all, turn_between, unit
from groma.geometry.quaternion import to_matrix_kernel


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _ambient(state, R, out):
    to_matrix_kernel(state, R)
    w1, w2 = math.cos(state[4]), math.sin(state[4])
    for j in range(3):
        out[j] = w1 * R[3 * j]
        out[3 + j] = w2 * R[3 * j + 1]


@loop
def _ambient_all(state, out):
    R = np.empty(9)
    for i in range(state.shape[0]):
        _ambient(state[i], R, out[i])


@kernel
def _basis_right(state, R, B):
    to_matrix_kernel(state, R)
    w1, w2 = math.cos(state[4]), math.sin(state[4])
    for j in range(3):
        u1, u2, u3 = R[3 * j], R[3 * j + 1], R[3 * j + 2]
        B[j, 0] = 0.0
        B[j, 1] = -w1 * u3
        B[j, 2] = w1 * u2
        B[j, 3] = -w2 * u1
        B[3 + j, 0] = w2 * u3
        B[3 + j, 1] = 0.0
        B[3 + j, 2] = -w2 * u1
        B[3 + j, 3] = w1 * u2


@kernel
def _basis_left(state, R, B):
    to_matrix_kernel(state, R)
    w1, w2 = math.cos(state[4]), math.sin(state[4])
    for k in range(2):
        # -v^ with v = m, then d
        w = w1 if k == 0 else w2
        x, y, z = w * R[k], w * R[3 + k], w * R[6 + k]
        minus_skew_kernel(x, y, z, 3 * k, B)
    for j in range(3):
        B[j, 3] = -w2 * R[3 * j]
        B[3 + j, 3] = w1 * R[3 * j + 1]


@loop
def _basis_all(state, left, out):
    R = np.empty(9)
    for i in range(state.shape[0]):
        if left:
            _basis_left(state[i], R, out[i])
        else:
            _basis_right(state[i], R, out[i])


# ------------------------------------------------------------------------------------------------------------- Public
#: Half turns about the first, second and third axis, and none; and what they do to phi: (slope, offset).
_TURNS = np.eye(4)
_PHI = np.array([[-1.0, 0.0], [-1.0, np.pi], [1.0, np.pi], [1.0, 0.0]])


def _turned(state: FloatArray, which: IntArray) -> FloatArray:
    """Apply the symmetry ``which`` (N,) to each state: another state of the same oriented line."""
    q = quaternion.multiply(state[:, :4], _TURNS[which])
    return np.column_stack([q, _PHI[which, 0] * state[:, 4] + _PHI[which, 1]])


class OrthonormalLineRight(Chart):
    """Lines by rotation and angle, increments from the right, ``"orthonormal_right"``."""

    name: ClassVar[str] = "orthonormal_right"
    kind: ClassVar[str] = "line"
    state_size = 5
    _left: ClassVar[bool] = False

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Turn U by theta1..3 and add theta4 to phi."""
        return self._retracted(turn_and_add_all, state, delta, self._left)

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Increments (N, 4) that lead to the oriented lines ``other``.

        It inverts :meth:`retract` up to a rotation of 2.2 radians. Beyond that, or where ``other`` is stored in another
        of its four forms, the way is to a form that is nearer.
        """
        state, other = self._checked_pair(state, other)
        relative = quaternion.multiply(quaternion.conjugate(state[:, :4]), other[:, :4])
        # Component k is the scalar part of the way to the form turned about axis k. The factor keeps the stored form
        # unless another one is clearly nearer.
        goal = _turned(other, np.argmax(np.abs(relative) * [1.0, 1.0, 1.0, 2.0], axis=1))
        phi = goal[:, 4] - state[:, 4]
        turn = turn_between(state[:, :4], goal[:, :4], self._left)
        return np.column_stack([turn, phi - 2 * np.pi * np.round(phi / (2 * np.pi))])

    def ambient(self, state: FloatArray) -> FloatArray:
        """(m, d) = (cos(phi) u1, sin(phi) u2), (N, 6)."""
        return self._ambient_by(_ambient_all, state)

    def from_ambient(self, ambient: FloatArray) -> FloatArray:
        """State (N, 5) of Plücker lines (m, d) of any scale, with 0 <= phi <= pi/2.

        For m = 0 or d = 0 the missing axis is the first perpendicular vector of the other one. Of a moment that is not
        orthogonal to d, the part along d is dropped.

        Raises
        ------
        InputError
            If a line is not finite or all zeros.
        """
        scaled = self._checked_ambient(ambient)
        m, d = scaled[:, :3], scaled[:, 3:]
        at_infinity = ~d.any(axis=1, keepdims=True)
        u1, u2, length = moment_frame(m, np.where(at_infinity, perpendicular(_unit_or_x(m))[0], d))
        phi = np.arctan2(np.linalg.norm(d, axis=1), length)
        U = np.stack([u1, u2, np.cross(u1, u2)], axis=2)
        return np.column_stack([quaternion.from_matrix(U), phi])

    def canonical(self, state: FloatArray) -> FloatArray:
        """The same oriented lines with 0 <= phi <= pi/2, (N, 5)."""
        state = self._checked_state(state)
        c, s = np.cos(state[:, 4]), np.sin(state[:, 4])
        # signs of (cos, sin): (+, +) none, (+, -) about u1, (-, +) about u2, (-, -) about u3
        which = np.where(c >= 0.0, np.where(s >= 0.0, 3, 0), np.where(s >= 0.0, 1, 2))
        out = _turned(state, which)
        out[:, 4] = np.arctan2(np.abs(s), np.abs(c))
        return out

    def basis(self, state: FloatArray) -> FloatArray:
        """Derivative of (m, d) with respect to the increment, (N, 6, 4)."""
        return self._basis_by(_basis_all, state, self._left)


class OrthonormalLineLeft(OrthonormalLineRight):
    """Lines by rotation and angle, increments from the left, ``"orthonormal_left"``."""

    name: ClassVar[str] = "orthonormal_left"
    _left: ClassVar[bool] = True


def _unit_or_x(vectors: FloatArray) -> FloatArray:
    """Unit vectors (N, 3); the x axis for those that are zero."""
    zero = ~vectors.any(axis=1, keepdims=True)
    return unit(np.where(zero, [1.0, 0.0, 0.0], vectors))


def moment_frame(moment: FloatArray, direction: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Orthogonal unit vectors along the moment and the direction of lines, and the length of the moment.

    Parameters
    ----------
    moment, direction : (N, 3) float64
        Of lines; the direction is not zero.

    Returns
    -------
    m_hat, d_hat : (N, 3) float64
        Orthonormal. m_hat is the first perpendicular vector of d_hat where the moment is zero.
    length : (N,) float64
        Length of the moment orthogonal to the direction.
    """
    d_hat = unit(direction)
    # Two cross products: however little of the moment is left, it is orthogonal to d.
    across = np.cross(np.cross(d_hat, moment), d_hat)
    length = np.linalg.norm(across, axis=1)
    m_hat = unit(np.where(length[:, None] > 0.0, across, perpendicular(d_hat)[0]))
    return m_hat, d_hat, length
