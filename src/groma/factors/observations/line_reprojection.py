# SPDX-License-Identifier: BSD-3-Clause
r"""A line seen as an image segment: signed distances, in pixels, of the two end points from the projected line.

With the line :math:`m_c = R m + t \times R d, \; d_c = R d` in the camera and a pinhole camera
:math:`(f_x, f_y, c_x, c_y)`, the image line is :math:`l = \mathcal K m_c`; divided by :math:`f_x f_y` and written about
the principal point it is :math:`(a, b, m_z)` with :math:`a = m_x/f_x,\; b = m_y/f_y`. For the end point (u, v)

.. math:: r = \frac{a\,(u - c_x) + b\,(v - c_y) + m_z}{h}, \qquad h = \sqrt{a^2 + b^2} .

.. math:: g = \frac{\partial r}{\partial m_c} = \frac1h \Big[ \frac{u - c_x - r a/h}{f_x},\;
              \frac{v - c_y - r b/h}{f_y},\; 1 \Big]

.. math:: \frac{\partial r}{\partial \xi} = [\,(d_c \times g)^\top,\; (m_c \times g)^\top\,], \qquad
          \frac{\partial r}{\partial (m, d)} = [\,g^\top R,\; (g \times t)^\top R\,], \qquad
          \frac{\partial r}{\partial (f_x, f_y, c_x, c_y)} =
              \Big[ -g_x a,\; -g_y b,\; -\frac ah,\; -\frac bh \Big]

for the left twist :math:`(\rho, \omega)`. The residual does not depend on the scale of (m, d), and changes its sign
with that of (m, d).

Source: Plücker notes, eqs. (65) to (68), (75), (76), with (66) in the layout of (82), and the denominators of (81)
squared as in Point-line-plane notes, eqs. (6) to (12). Written about the principal point there is less cancellation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.cameras.dispatch import pinhole_parameters, pinhole_parameters_jacobian
from groma.factors._examples import indices
from groma.factors._pixels import INTRINSICS, PixelFactor, load_row, pixel_example
from groma.factors._rig import EXTRINSICS, MOTION, POSE, clear_record, put_line, put_line_pose, transform_line
from groma.factors.contract import Example, Measurement, Ref, Slot, register


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def image_line_norm(m0, m1, m2, K):
    """Return h of the image line of the moment m in the camera; 0 where there is none (m along the optical axis).

    The limit is an image line 1e9 focal lengths away from the principal point.
    """
    if K[0] == 0.0 or K[1] == 0.0:
        return 0.0
    a, b = m0 / K[0], m1 / K[1]
    h = math.sqrt(a * a + b * b)
    return h if h * abs(K[0]) + h * abs(K[1]) > 1e-9 * abs(m2) else 0.0


@kernel
def endpoint_distance(m0, m1, m2, K, h, u, v, out, row):
    """Write to ``out[row]`` (8,): r, the three numbers of g = dr/dm, and dr/d(fx, fy, cx, cy)."""
    a, b, k = m0 / K[0], m1 / K[1], 1.0 / h
    x, y = u - K[2], v - K[3]
    r = (a * x + b * y + m2) * k
    g0, g1 = (x - r * a * k) * k / K[0], (y - r * b * k) * k / K[1]
    out[row, 0] = r
    out[row, 1] = g0
    out[row, 2] = g1
    out[row, 3] = k
    out[row, 4] = -g0 * a
    out[row, 5] = -g1 * b
    out[row, 6] = -a * k
    out[row, 7] = -b * k
    return abs(r) < math.inf


@kernel
def put_pinhole(out, J_K, record, i, row, column):
    """Write the derivative by the parameters of the camera, from out[row, 4:8] of :func:`endpoint_distance`."""
    for j in range(J_K.shape[1]):
        record[i, row, column + j] = (
            out[row, 4] * J_K[0, j] + out[row, 5] * J_K[1, j] + out[row, 6] * J_K[2, j] + out[row, 7] * J_K[3, j]
        )


@loop
def linearize_pixels(
    model_tag, poses, pose_index, lines, intrinsics, line_index, intrinsics_index, row_tag, pixels,
    begin, end, pose_column, line_column, intrinsics_column, record,
):  # fmt: skip
    """Write one row for each of the ``pixels`` of a line: the two ends of a segment (N, 4), or one point on it (N, 2).

    ``row_tag`` is a tuple with ``None`` for each row: its length is part of its type, so that Numba knows it.
    """
    size, rows = intrinsics.shape[1], len(row_tag)
    L, K, J_K, params, out = np.empty(6), np.empty(4), np.empty((4, size)), np.empty(size), np.empty((2, 8))
    camera, degenerate, last = -1, 0, record.shape[2] - 1
    for i in range(begin, end):
        k, c = i - begin, pose_index[i]
        if intrinsics_index[i] != camera:
            camera = load_row(intrinsics, intrinsics_index[i], camera, params)
            pinhole_parameters(model_tag, params, K)
            pinhole_parameters_jacobian(model_tag, params, J_K)
        valid = transform_line(poses, c, lines, line_index[i], L)
        h = image_line_norm(L[0], L[1], L[2], K)
        if (
            valid
            and h > 0.0
            and endpoint_distance(L[0], L[1], L[2], K, h, pixels[i, 0], pixels[i, 1], out, 0)
            and (rows == 1 or endpoint_distance(L[0], L[1], L[2], K, h, pixels[i, 2], pixels[i, 3], out, 1))
        ):
            for row in range(rows):
                g0, g1, g2 = out[row, 1], out[row, 2], out[row, 3]
                record[k, row, last] = out[row, 0]
                if pose_column >= 0:
                    put_line_pose(g0, g1, g2, 0.0, 0.0, 0.0, L, record, k, row, pose_column)
                if line_column >= 0:
                    put_line(g0, g1, g2, 0.0, 0.0, 0.0, poses, c, record, k, row, line_column)
                if intrinsics_column >= 0:
                    put_pinhole(out, J_K, record, k, row, intrinsics_column)
        else:
            clear_record(record, k, pose_column, line_column, 6, intrinsics_column, size)
            degenerate += 1
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("line_reprojection")
@dataclass(frozen=True, kw_only=True)
class LineReprojection(PixelFactor):
    """Lines seen as image segments, cameras without distortion; residual: two distances in pixels.

    Under distortion use :class:`~groma.factors.observations.line_bearing.LineBearing`. Degenerate: lines through the
    camera centre (to 1e-9 of the lengths involved), and lines in the plane z = 0 of the camera, which have no image.
    """

    #: Lines in the world, any scale of (m, d).
    line: Ref
    #: (N, 4) measured end points u1, v1, u2, v2 in pixels; their order does not matter.
    segments: FloatArray

    pinhole_only: ClassVar[bool] = True
    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("line", "line"), INTRINSICS, EXTRINSICS, MOTION)
    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("segments", (4,)),)
    rows: ClassVar[int] = 2

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        arguments = self.arguments(inputs, self.line, (None, None), self.segments)
        return linearize_pixels(*arguments, begin, end, *columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)),
            line=Ref("lines", indices(rng, 4)),
            intrinsics=Ref("intrinsics", indices(rng, 2)),
            camera_model="PINHOLE",
            segments=rng.uniform(100.0, 500.0, (6, 4)),
        )
        return pixel_example(factor, rng)
