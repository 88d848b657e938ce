# SPDX-License-Identifier: BSD-3-Clause
r"""A plane measured in the camera, compared with a landmark as unit quaternions.

A plane :math:`\pi = (n, w)`, scaled to a unit 4-vector, is read as the quaternion :math:`[n_x, n_y, n_z, w]`. The
measurement :math:`\tilde\pi_c = (\tilde n, \tilde w)` is taken to the world frame and compared with the landmark:

.. math:: y = T_{cw}^\top \tilde\pi_c = (R^\top \tilde n,\; t \cdot \tilde n + \tilde w), \qquad
          e = \pm\,\mathrm{unit}(y) \otimes \mathrm{unit}(\pi_w)^*, \qquad r = \mathrm{Log}(e) \quad\text{(radians)}

with the sign that makes the scalar part of e positive, because :math:`\pi` and :math:`-\pi` are one plane. With the
left and right Jacobians of SO(3) at r, and for any 4-vector y with vector part :math:`y_v` and last entry :math:`y_4`
the map :math:`Q(y) = \frac{2}{\lVert y\rVert^2} [\, y_4 I + [y_v]_\times \mid -y_v \,]`, the derivative of unit(y) as a
left rotation vector,

.. math:: \frac{\partial r}{\partial \xi} = J_l(r)^{-1} Q(y)
          \begin{bmatrix} 0 & R^\top [\tilde n]_\times \\ \tilde n^\top & t^\top [\tilde n]_\times \end{bmatrix}, \qquad
          \frac{\partial r}{\partial \pi_w} = -J_r(r)^{-1} Q(\pi_w)

for the left twist :math:`(\rho, \omega)`. The residual does not depend on scale and sign of :math:`\pi_w`.

Source: Point-line-plane notes, section IV. Eq. (13) there mixes a left and an additive increment, its parts
:math:`\partial u/\partial\phi` and :math:`\partial\phi/\partial y` have wrong exponents and a wrong sign, and it is 0/0
at the identity; the map Q replaces the whole chain. The increment of the landmark there, exp(delta) times pi, is the
chart ``quaternion_left``.

The residual depends on the origin and the unit of length, gives little weight to normals of planes far away (about
:math:`2/\sqrt{1 + w^2}`), and jumps where its norm reaches :math:`\pi`:
:mod:`groma.factors.observations.plane_observation` is the friendlier form.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._record import SMALL_TURN, put_block, put_residual
from groma.factors.contract import WORLD_FIXED, Invariance, Measurement, register
from groma.factors.observations.plane_observation import PlaneInCamera


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _log(e, r):
    """Write r = Log(e) (3,) of the unit quaternion ``e`` with e_w >= 0; return c of the inverse Jacobians.

    J_l^-1 = I - [r]x / 2 + c [r]x², c = (1 - (theta/2) cot(theta/2))/theta², theta = |r| = 2 alpha.
    """
    s = math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    alpha = math.atan2(s, e[3])
    scale = 2.0 * alpha / s if s > 0.0 else 2.0
    r[0], r[1], r[2] = scale * e[0], scale * e[1], scale * e[2]
    square = 4.0 * alpha * alpha
    if square < SMALL_TURN:
        return 1.0 / 12.0 + square * (1.0 / 720.0 + square * (1.0 / 30240.0 + square / 1209600.0))
    return (1.0 - alpha * e[3] / s) / square


@kernel
def _multiply_inverse_jacobian(r, side, c, J):
    """Multiply ``J`` (3, k) from the left by I - side/2 [r]x + c [r]x²: side 1 is the left Jacobian's inverse."""
    for j in range(J.shape[1]):
        a0, a1, a2 = J[0, j], J[1, j], J[2, j]
        b0, b1, b2 = r[1] * a2 - r[2] * a1, r[2] * a0 - r[0] * a2, r[0] * a1 - r[1] * a0
        J[0, j] = a0 - 0.5 * side * b0 + c * (r[1] * b2 - r[2] * b1)
        J[1, j] = a1 - 0.5 * side * b1 + c * (r[2] * b0 - r[0] * b2)
        J[2, j] = a2 - 0.5 * side * b2 + c * (r[0] * b1 - r[1] * b0)


@kernel
def _pull_back(y0, y1, y2, y3, scale, Q):
    """Write scale times [y3 I + [y]x | -y] to ``Q`` (3, 4)."""
    Q[0, 0], Q[0, 1], Q[0, 2], Q[0, 3] = scale * y3, -scale * y2, scale * y1, -scale * y0
    Q[1, 0], Q[1, 1], Q[1, 2], Q[1, 3] = scale * y2, scale * y3, -scale * y0, -scale * y1
    Q[2, 0], Q[2, 1], Q[2, 2], Q[2, 3] = -scale * y1, scale * y0, scale * y3, -scale * y2


@kernel
def _linearize(T, plane, measured, r, e, Q, J_pose, J_plane):
    """Write ``r`` (3,), ``J_pose`` (3, 6), ``J_plane`` (3, 4); False for a plane of zeros."""
    n0, n1, n2, w = measured[0], measured[1], measured[2], measured[3]
    y0 = T[0] * n0 + T[4] * n1 + T[8] * n2
    y1 = T[1] * n0 + T[5] * n1 + T[9] * n2
    y2 = T[2] * n0 + T[6] * n1 + T[10] * n2
    y3 = T[3] * n0 + T[7] * n1 + T[11] * n2 + w
    p0, p1, p2, p3 = plane[0], plane[1], plane[2], plane[3]
    yy, pp = y0 * y0 + y1 * y1 + y2 * y2 + y3 * y3, p0 * p0 + p1 * p1 + p2 * p2 + p3 * p3
    if not (1e-200 < yy < math.inf and 1e-200 < pp < math.inf):
        return False
    # e = y ⊗ p*, a product of the norms of both
    e[0] = -y3 * p0 + p3 * y0 - (y1 * p2 - y2 * p1)
    e[1] = -y3 * p1 + p3 * y1 - (y2 * p0 - y0 * p2)
    e[2] = -y3 * p2 + p3 * y2 - (y0 * p1 - y1 * p0)
    e[3] = y3 * p3 + y0 * p0 + y1 * p1 + y2 * p2
    scale = 1.0 / (math.sqrt(yy) * math.sqrt(pp))
    if e[3] < 0.0:
        scale = -scale
    for j in range(4):
        e[j] *= scale
    c = _log(e, r)
    # pose: Q(y) times the rows [0, Rᵀ [n]x] and [nᵀ, tᵀ [n]x]
    _pull_back(y0, y1, y2, y3, 2.0 / yy, Q)
    t0, t1, t2 = T[3], T[7], T[11]
    for i in range(3):
        # the row Q[i, :3] Rᵀ + Q[i, 3] tᵀ, to be multiplied by [n]x: aᵀ [n]x = (a x n)ᵀ
        a0 = Q[i, 0] * T[0] + Q[i, 1] * T[1] + Q[i, 2] * T[2] + Q[i, 3] * t0
        a1 = Q[i, 0] * T[4] + Q[i, 1] * T[5] + Q[i, 2] * T[6] + Q[i, 3] * t1
        a2 = Q[i, 0] * T[8] + Q[i, 1] * T[9] + Q[i, 2] * T[10] + Q[i, 3] * t2
        J_pose[i, 0], J_pose[i, 1], J_pose[i, 2] = Q[i, 3] * n0, Q[i, 3] * n1, Q[i, 3] * n2
        J_pose[i, 3] = a1 * n2 - a2 * n1
        J_pose[i, 4] = a2 * n0 - a0 * n2
        J_pose[i, 5] = a0 * n1 - a1 * n0
    _multiply_inverse_jacobian(r, 1.0, c, J_pose)
    # plane
    _pull_back(p0, p1, p2, p3, -2.0 / pp, J_plane)
    _multiply_inverse_jacobian(r, -1.0, c, J_plane)
    return True


@loop
def _linearize_all(poses, pose_index, planes, plane_index, measured, begin, end, pose_column, plane_column, record):
    r, e, Q, J_pose, J_plane = np.empty(3), np.empty(4), np.empty((3, 4)), np.empty((3, 6)), np.empty((3, 4))
    degenerate = 0
    for i in range(begin, end):
        if not _linearize(poses[pose_index[i]], planes[plane_index[i]], measured[i], r, e, Q, J_pose, J_plane):
            r[:], J_pose[:], J_plane[:] = 0.0, 0.0, 0.0
            degenerate += 1
        row = record[i - begin]
        put_block(J_pose, row, pose_column)
        put_block(J_plane, row, plane_column)
        put_residual(r, row)
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("plane_quaternion")
class PlaneQuaternion(PlaneInCamera):
    """Planes measured in the camera, compared as quaternions; residual: a rotation vector (radians).

    Degenerate: a plane of zeros.
    """

    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("planes_in_cam", (4,), num_normalized=4),)
    invariance: ClassVar[Invariance] = WORLD_FIXED  # the angle between 4-vectors depends on the world origin

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        return _linearize_all(*inputs, self.plane.index, self.planes_in_cam, begin, end, *columns, record)
