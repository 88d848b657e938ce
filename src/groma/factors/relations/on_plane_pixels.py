# SPDX-License-Identifier: BSD-3-Clause
r"""A point or a line lies on a plane: by how many pixels does its image move when it is put there?

For a point c of the world (a point landmark, or the point of a line closest to an anchor) and a plane (n, w), with
:math:`\hat n = n/\lVert n\rVert`, the distance :math:`h = (n \cdot c + w)/\lVert n\rVert` and the foot
:math:`c - h\hat n`,

.. math:: r = \pi(R\,c + t, k) - \pi(R\,(c - h\hat n) + t, k) \qquad \text{(pixels)} .

The noise of images is the noise of this residual, so no weight between pixels and lengths has to be chosen. Points and
lines are coupled with cameras and planes only, never with one another, and can be eliminated.

With A, B the derivatives of :math:`\pi` at the two points in the camera, and a, b rows of them,

.. math:: \frac{\partial r}{\partial c} = A R - B R\,(I - \hat n \hat n^\top), \qquad
          \frac{\partial r}{\partial \xi} = [\,a - b \mid (P \times a - Q \times b)\,], \qquad
          \frac{\partial r}{\partial (n, w)} = B R\, \frac{\partial (h \hat n)}{\partial (n, w)},

.. math:: \frac{\partial (h \hat n)}{\partial n} = \frac{\hat n\,(c - h\hat n)^\top + h\,(I - \hat n\hat n^\top)}
          {\lVert n\rVert}, \qquad \frac{\partial (h \hat n)}{\partial w} = \frac{\hat n}{\lVert n\rVert} .

For a line :math:`c(a) = (d \times m + (a \cdot d)\,d)/\lVert d\rVert^2` at the anchors of both ends, with

.. math:: \frac{\partial c}{\partial m} = \frac{[d]_\times}{\lVert d\rVert^2}, \qquad
          \frac{\partial c}{\partial d} = \frac{-[m]_\times + (a\cdot d) I + d\,a^\top - 2\,c\,d^\top}
          {\lVert d\rVert^2} .

A camera that looks along the normal cannot see the distance; others of the same landmark must.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.cameras.dispatch import project_jacobian, wrap
from groma.factors._examples import indices
from groma.factors._pixels import INTRINSICS, PixelFactor, load_row, pixel_example
from groma.factors._rig import EXTRINSICS, POSE, clear_block, clear_record
from groma.factors.contract import WORLD_FIXED, Example, Invariance, Measurement, Ref, Slot, register


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _foot(c, planes, k, foot, normal):
    """Write the foot of ``c`` on plane ``k``, the unit normal and, last, distance and 1 / |n|: ``normal`` (5,)."""
    n0, n1, n2 = planes[k, 0], planes[k, 1], planes[k, 2]
    scale = 1.0 / math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    normal[0], normal[1], normal[2], normal[4] = n0 * scale, n1 * scale, n2 * scale, scale
    h = normal[0] * c[0] + normal[1] * c[1] + normal[2] * c[2] + planes[k, 3] * scale
    normal[3] = h
    foot[0] = c[0] - h * normal[0]
    foot[1] = c[1] - h * normal[1]
    foot[2] = c[2] - h * normal[2]


@kernel
def _into_camera(poses, p, c, P):
    P[0] = poses[p, 0] * c[0] + poses[p, 1] * c[1] + poses[p, 2] * c[2] + poses[p, 3]
    P[1] = poses[p, 4] * c[0] + poses[p, 5] * c[1] + poses[p, 6] * c[2] + poses[p, 7]
    P[2] = poses[p, 8] * c[0] + poses[p, 9] * c[1] + poses[p, 10] * c[2] + poses[p, 11]


@kernel
def _difference(model_tag, params, uv, other):
    """Subtract a pixel from ``uv``, the short way in a panorama; False if the result is not finite."""
    uv[0] -= other[0]
    uv[1] -= other[1]
    wrap(model_tag, params, uv)
    return abs(uv[0]) + abs(uv[1]) < math.inf


@kernel
def _into_world(A, row, poses, p, out):
    """Write A[row] R (3,)."""
    out[0] = A[row, 0] * poses[p, 0] + A[row, 1] * poses[p, 4] + A[row, 2] * poses[p, 8]
    out[1] = A[row, 0] * poses[p, 1] + A[row, 1] * poses[p, 5] + A[row, 2] * poses[p, 9]
    out[2] = A[row, 0] * poses[p, 2] + A[row, 1] * poses[p, 6] + A[row, 2] * poses[p, 10]


@kernel
def _put_pose(A, B, row, P, Q, record, i, target, column):
    a0, a1, a2, b0, b1, b2 = A[row, 0], A[row, 1], A[row, 2], B[row, 0], B[row, 1], B[row, 2]
    record[i, target, column] = a0 - b0
    record[i, target, column + 1] = a1 - b1
    record[i, target, column + 2] = a2 - b2
    record[i, target, column + 3] = P[1] * a2 - P[2] * a1 - (Q[1] * b2 - Q[2] * b1)
    record[i, target, column + 4] = P[2] * a0 - P[0] * a2 - (Q[2] * b0 - Q[0] * b2)
    record[i, target, column + 5] = P[0] * a1 - P[1] * a0 - (Q[0] * b1 - Q[1] * b0)


@kernel
def _put_plane(b, foot, normal, record, i, target, column):
    """Write b d(h n̂)/d(n, w) for the derivative ``b`` of one row by the foot in the world."""
    bn = (b[0] * normal[0] + b[1] * normal[1] + b[2] * normal[2]) * normal[4]
    h = normal[3] * normal[4]
    record[i, target, column] = bn * foot[0] + h * b[0] - normal[3] * bn * normal[0]
    record[i, target, column + 1] = bn * foot[1] + h * b[1] - normal[3] * bn * normal[1]
    record[i, target, column + 2] = bn * foot[2] + h * b[2] - normal[3] * bn * normal[2]
    record[i, target, column + 3] = bn


@kernel
def _by_place(a, b, normal, s):
    """Write the derivative of one row by the point in the world: a - b (I - n̂ n̂ᵀ)."""
    bn = b[0] * normal[0] + b[1] * normal[1] + b[2] * normal[2]
    s[0] = a[0] - b[0] + bn * normal[0]
    s[1] = a[1] - b[1] + bn * normal[1]
    s[2] = a[2] - b[2] + bn * normal[2]


@kernel
def _place_on_line(lines, j, anchors, i, end, c):
    m0, m1, m2, d0, d1, d2 = lines[j, 0], lines[j, 1], lines[j, 2], lines[j, 3], lines[j, 4], lines[j, 5]
    k2 = 1.0 / (d0 * d0 + d1 * d1 + d2 * d2)
    ad = anchors[i, end, 0] * d0 + anchors[i, end, 1] * d1 + anchors[i, end, 2] * d2
    c[0] = (d1 * m2 - d2 * m1 + ad * d0) * k2
    c[1] = (d2 * m0 - d0 * m2 + ad * d1) * k2
    c[2] = (d0 * m1 - d1 * m0 + ad * d2) * k2
    c[3] = ad
    c[4] = k2


@kernel
def _put_line(s, lines, j, anchors, i, end, c, record, k, target, column):
    """Write s dc/d(m, d) for the derivative ``s`` of one row by the point c of the line."""
    m0, m1, m2, d0, d1, d2 = lines[j, 0], lines[j, 1], lines[j, 2], lines[j, 3], lines[j, 4], lines[j, 5]
    ad, k2 = c[3], c[4]
    sd = s[0] * d0 + s[1] * d1 + s[2] * d2
    sc = 2.0 * (s[0] * c[0] + s[1] * c[1] + s[2] * c[2])
    record[k, target, column] = (s[1] * d2 - s[2] * d1) * k2
    record[k, target, column + 1] = (s[2] * d0 - s[0] * d2) * k2
    record[k, target, column + 2] = (s[0] * d1 - s[1] * d0) * k2
    record[k, target, column + 3] = (s[2] * m1 - s[1] * m2 + ad * s[0] + sd * anchors[i, end, 0] - sc * d0) * k2
    record[k, target, column + 4] = (s[0] * m2 - s[2] * m0 + ad * s[1] + sd * anchors[i, end, 1] - sc * d1) * k2
    record[k, target, column + 5] = (s[1] * m0 - s[0] * m1 + ad * s[2] + sd * anchors[i, end, 2] - sc * d2) * k2


@loop
def _linearize_all(
    model_tag, poses, pose_index, landmarks, planes, intrinsics, landmark_index, intrinsics_index, plane_index,
    smallest_depth, on_line, anchors, begin, end,
    pose_column, landmark_column, plane_column, intrinsics_column, record,
):  # fmt: skip
    size = intrinsics.shape[1]
    c, foot, P, Q, normal, params = np.empty(5), np.empty(3), np.empty(3), np.empty(3), np.empty(5), np.empty(size)
    uv_P, uv_Q, A, B = np.empty(2), np.empty(2), np.empty((2, 3)), np.empty((2, 3))
    J_P, J_Q, a, b, s = np.empty((2, size)), np.empty((2, size)), np.empty(3), np.empty(3), np.empty(3)
    camera, degenerate, last = -1, 0, record.shape[2] - 1
    for i in range(begin, end):
        k, p, j, q = i - begin, pose_index[i], landmark_index[i], plane_index[i]
        camera = load_row(intrinsics, intrinsics_index[i], camera, params)
        good = planes[q, 0] * planes[q, 0] + planes[q, 1] * planes[q, 1] + planes[q, 2] * planes[q, 2] > 1e-200
        if on_line:
            direction = landmarks[j, 3:]
            good = good and direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2 > 1e-200
        for row in range(record.shape[1]):
            if not good:
                break
            if row % 2 == 0:  # a new place: the point itself, or one of the line's two
                if on_line:
                    _place_on_line(landmarks, j, anchors, i, row // 2, c)
                else:
                    c[0], c[1], c[2] = landmarks[j, 0], landmarks[j, 1], landmarks[j, 2]
                _foot(c, planes, q, foot, normal)
                _into_camera(poses, p, c, P)
                _into_camera(poses, p, foot, Q)
                good = (
                    P[2] > smallest_depth
                    and Q[2] > smallest_depth
                    and project_jacobian(model_tag, params, P, uv_P, A, J_P)
                    and project_jacobian(model_tag, params, Q, uv_Q, B, J_Q)
                    and _difference(model_tag, params, uv_P, uv_Q)
                )
                if not good:
                    break
            coordinate = row % 2
            record[k, row, last] = uv_P[coordinate]
            if last == 0:
                continue
            _into_world(A, coordinate, poses, p, a)
            _into_world(B, coordinate, poses, p, b)
            _by_place(a, b, normal, s)
            if pose_column >= 0:
                _put_pose(A, B, coordinate, P, Q, record, k, row, pose_column)
            if landmark_column >= 0:
                if on_line:
                    _put_line(s, landmarks, j, anchors, i, row // 2, c, record, k, row, landmark_column)
                else:
                    record[k, row, landmark_column] = s[0]
                    record[k, row, landmark_column + 1] = s[1]
                    record[k, row, landmark_column + 2] = s[2]
            if plane_column >= 0:
                _put_plane(b, foot, normal, record, k, row, plane_column)
            if intrinsics_column >= 0:
                for m in range(size):
                    record[k, row, intrinsics_column + m] = J_P[coordinate, m] - J_Q[coordinate, m]
        if not good:
            clear_record(record, k, pose_column, landmark_column, 6 if on_line else 3, intrinsics_column, size)
            clear_block(record, k, plane_column, 4)
            degenerate += 1
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, kw_only=True)
class _OnPlanePixels(PixelFactor):
    """What both forms share."""

    #: The planes, any scale of (n, w).
    plane: Ref

    def _evaluate(
        self,
        landmark: Ref,
        anchors: FloatArray | None,
        inputs: tuple[Any, ...],
        begin: int,
        end: int,
        columns: tuple[int, ...],
        record: FloatArray,
    ) -> int:
        places = np.zeros((1, 2, 3)) if anchors is None else anchors
        measured = self.plane.index, self.smallest_depth, anchors is not None, places
        return _linearize_all(*self.arguments(inputs, landmark, *measured), begin, end, *columns, record)


@register("point_on_plane_pixels")
@dataclass(frozen=True, kw_only=True)
class PointOnPlanePixels(_OnPlanePixels):
    """Points on planes; residual: by how many pixels the point's image moves when it is put on the plane.

    Degenerate: points, or their feet on the plane, that the camera cannot see.
    """

    #: Points in the world.
    point: Ref

    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("point", "point"), Slot("plane", "plane"), INTRINSICS, EXTRINSICS)
    rows: ClassVar[int] = 2

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        return self._evaluate(self.point, None, inputs, begin, end, columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)),
            point=Ref("points", indices(rng, 4)),
            plane=Ref("planes", indices(rng, 3)),
            intrinsics=Ref("intrinsics", indices(rng, 2)),
            camera_model="RADIAL",
        )
        return pixel_example(factor, rng)


@register("segment_on_plane_pixels")
@dataclass(frozen=True, kw_only=True)
class SegmentOnPlanePixels(_OnPlanePixels):
    """Line segments on planes; residual: the same in pixels for the line's points near both ends, four numbers.

    Degenerate: ends, or their feet on the plane, that the camera cannot see.
    """

    #: Lines in the world, any scale of (m, d).
    line: Ref
    #: (N, 2, 3) world points near the two ends of each segment.
    ends: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("line", "line"), Slot("plane", "plane"), INTRINSICS, EXTRINSICS)
    invariance: ClassVar[Invariance] = WORLD_FIXED  # ends are world points

    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("ends", (2, 3)),)
    rows: ClassVar[int] = 4

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        return self._evaluate(self.line, self.ends, inputs, begin, end, columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)),
            line=Ref("lines", indices(rng, 4)),
            plane=Ref("planes", indices(rng, 3)),
            intrinsics=Ref("intrinsics", indices(rng, 2)),
            camera_model="RADIAL",
            ends=rng.normal(size=(6, 2, 3)),
        )
        return pixel_example(factor, rng)
