# SPDX-License-Identifier: BSD-3-Clause
r"""A line seen as the normal of the plane through camera centre and segment: a parallel and an anchor term.

The measurement is the unit normal n of that plane, camera frame: :math:`n = (f_1 \times f_2)/\lVert\cdot\rVert` for the
bearings of the segment's ends. With the unit direction :math:`\hat d` of the line, its *anchor*
:math:`p = d \times m/\lVert d\rVert^2` (the point closest to the world origin), the anchor in the camera
:math:`a = R p + t`, :math:`\varrho = \lVert a\rVert`, and :math:`v = -a/\varrho` (from the anchor to the camera),

.. math:: r = [\, n \cdot R \hat d,\;\; n \cdot v \,] \qquad \text{(sines of angles).}

With :math:`N = (I - v v^\top)\, n`, :math:`x = R\hat d`, :math:`n_w = R^\top n` and
:math:`q = \partial r_2/\partial p = -R^\top N/\varrho`, for the left twist :math:`(\rho, \omega)`

.. math:: \frac{\partial r}{\partial \xi} =
          \begin{bmatrix} 0 & (x \times n)^\top \\ -N^\top/\varrho & (v \times n)^\top \end{bmatrix}, \qquad
          \frac{\partial r}{\partial m} = \begin{bmatrix} 0 \\ (q \times d)^\top/\lVert d\rVert^2 \end{bmatrix}, \qquad
          \frac{\partial r}{\partial d} = \begin{bmatrix} (n_w - r_1 \hat d)^\top/\lVert d\rVert \\
              (m \times q - 2 (q \cdot p)\, d)^\top/\lVert d\rVert^2 \end{bmatrix} .

Source: Free line notes, eqs. (3.1) to (3.6) for the residual and (4.5) to (4.38) for the pose, a right increment there.
The derivative by the line, missing there, is taken by (m, d), so that any chart of lines will do. The residual does not
depend on the scale of (m, d); :math:`r_1` changes its sign with that of (m, d).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import indices, make_example, visible_scene
from groma.factors._record import put_block, put_residual
from groma.factors._rig import EXTRINSICS, POSE, CameraFactor
from groma.factors.contract import Example, Invariance, Measurement, Ref, Slot, register


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _linearize(T, line, n, r, J_pose, J_line):
    """Write ``r`` (2,), ``J_pose`` (2, 6), ``J_line`` (2, 6); False if the anchor is at infinity or in the camera."""
    m0, m1, m2, d0, d1, d2 = line[0], line[1], line[2], line[3], line[4], line[5]
    dd = d0 * d0 + d1 * d1 + d2 * d2
    if not 1e-200 < dd < math.inf:
        return False
    k2 = 1.0 / dd
    k = math.sqrt(k2)
    p0, p1, p2 = (d1 * m2 - d2 * m1) * k2, (d2 * m0 - d0 * m2) * k2, (d0 * m1 - d1 * m0) * k2
    a0 = T[0] * p0 + T[1] * p1 + T[2] * p2 + T[3]
    a1 = T[4] * p0 + T[5] * p1 + T[6] * p2 + T[7]
    a2 = T[8] * p0 + T[9] * p1 + T[10] * p2 + T[11]
    distance = math.sqrt(a0 * a0 + a1 * a1 + a2 * a2)
    terms = p0 * p0 + p1 * p1 + p2 * p2 + T[3] * T[3] + T[7] * T[7] + T[11] * T[11]
    if not (distance > 1e-9 * math.sqrt(terms) and distance < math.inf):
        return False
    s = 1.0 / distance
    v0, v1, v2 = -a0 * s, -a1 * s, -a2 * s
    x0 = (T[0] * d0 + T[1] * d1 + T[2] * d2) * k
    x1 = (T[4] * d0 + T[5] * d1 + T[6] * d2) * k
    x2 = (T[8] * d0 + T[9] * d1 + T[10] * d2) * k
    r[0] = n[0] * x0 + n[1] * x1 + n[2] * x2
    r[1] = n[0] * v0 + n[1] * v1 + n[2] * v2
    # -N / distance
    q0, q1, q2 = -(n[0] - r[1] * v0) * s, -(n[1] - r[1] * v1) * s, -(n[2] - r[1] * v2) * s
    # pose
    J_pose[0, 0], J_pose[0, 1], J_pose[0, 2] = 0.0, 0.0, 0.0
    J_pose[0, 3], J_pose[0, 4], J_pose[0, 5] = x1 * n[2] - x2 * n[1], x2 * n[0] - x0 * n[2], x0 * n[1] - x1 * n[0]
    J_pose[1, 0], J_pose[1, 1], J_pose[1, 2] = q0, q1, q2
    J_pose[1, 3], J_pose[1, 4], J_pose[1, 5] = v1 * n[2] - v2 * n[1], v2 * n[0] - v0 * n[2], v0 * n[1] - v1 * n[0]
    # line
    w0, w1, w2 = (
        T[0] * q0 + T[4] * q1 + T[8] * q2,
        T[1] * q0 + T[5] * q1 + T[9] * q2,
        T[2] * q0 + T[6] * q1 + T[10] * q2,
    )
    wp = 2.0 * (w0 * p0 + w1 * p1 + w2 * p2)
    for j in range(3):
        J_line[0, j] = 0.0
        J_line[0, 3 + j] = (T[j] * n[0] + T[4 + j] * n[1] + T[8 + j] * n[2] - r[0] * line[3 + j] * k) * k
    J_line[1, 0], J_line[1, 1], J_line[1, 2] = (
        (w1 * d2 - w2 * d1) * k2,
        (w2 * d0 - w0 * d2) * k2,
        (w0 * d1 - w1 * d0) * k2,
    )
    J_line[1, 3] = (m1 * w2 - m2 * w1 - wp * d0) * k2
    J_line[1, 4] = (m2 * w0 - m0 * w2 - wp * d1) * k2
    J_line[1, 5] = (m0 * w1 - m1 * w0 - wp * d2) * k2
    return True


@loop
def _linearize_all(poses, pose_index, lines, line_index, normals, begin, end, pose_column, line_column, record):
    r, J_pose, J_line = np.empty(2), np.empty((2, 6)), np.empty((2, 6))
    degenerate = 0
    for i in range(begin, end):
        if not _linearize(poses[pose_index[i]], lines[line_index[i]], normals[i], r, J_pose, J_line):
            r[:], J_pose[:], J_line[:] = 0.0, 0.0, 0.0
            degenerate += 1
        row = record[i - begin]
        put_block(J_pose, row, pose_column)
        put_block(J_line, row, line_column)
        put_residual(r, row)
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("line_normal")
@dataclass(frozen=True, kw_only=True)
class LineNormal(CameraFactor):
    """Lines seen as plane normals; residual: sine of the angle line to plane, sine of the angle anchor ray to plane.

    Degenerate: a line whose anchor is the camera centre (to 1e-9 of the lengths involved), or at infinity. A line that
    passes through the camera elsewhere is not.
    """

    #: Lines in the world, any scale of (m, d).
    line: Ref
    #: (N, 3) measured normals, camera frame; scaled to unit length on construction.
    normals: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("line", "line"), EXTRINSICS)
    invariance: ClassVar[Invariance] = Invariance(translation=False, scale=True)  # anchors are closest to the origin
    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("normals", (3,), num_normalized=3),)
    rows: ClassVar[int] = 2

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        return _linearize_all(*inputs, self.line.index, self.normals, begin, end, *columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)), line=Ref("lines", indices(rng, 4)), normals=rng.normal(size=(6, 3))
        )
        return make_example(factor, rng, states=visible_scene(rng))
