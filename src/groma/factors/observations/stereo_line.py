# SPDX-License-Identifier: BSD-3-Clause
r"""A line seen as two segments by a rectified stereo pair: four signed distances in pixels.

The first two rows are those of :mod:`groma.factors.observations.line_reprojection` in the left camera, with the line
:math:`(m_c, d_c)`; the last two are the same in the right camera, where the moment is

.. math:: m_r = m_c + \tau \times d_c, \qquad \tau = (-b, 0, 0)

for the baseline b. With :math:`g = \partial r_i/\partial m_r` and :math:`h = \partial r_i/\partial d_c = g \times \tau`
(h = 0 in the left camera)

.. math:: \frac{\partial r_i}{\partial \xi} = [\,(d_c \times g)^\top,\; (m_c \times g + d_c \times h)^\top\,], \qquad
          \frac{\partial r_i}{\partial (m, d)} = [\,g^\top R,\; (g \times t + h)^\top R\,] .

The two segments need not show the same part of the line. A line in a plane with the baseline has the same image row
in both: the pair then says nothing about its distance, and another view must.

Source: Plücker notes, eqs. (65) to (76), with the corrections listed in
:mod:`groma.factors.observations.line_reprojection`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.cameras.dispatch import pinhole_parameters, pinhole_parameters_jacobian
from groma.factors._examples import indices
from groma.factors._pixels import INTRINSICS, StereoFactor, load_row, pixel_example
from groma.factors._rig import EXTRINSICS, POSE, clear_record, put_line, put_line_pose, transform_line
from groma.factors.contract import Example, Measurement, Ref, Slot, register
from groma.factors.observations.line_reprojection import endpoint_distance, image_line_norm, put_pinhole


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _right_moment(L, baseline, right):
    """Write the moment m + τ x d (3,) in the right camera; False if the line passes its centre, to rounding."""
    m1, m2 = baseline * L[5], -baseline * L[4]
    right[0], right[1], right[2] = L[0], L[1] + m1, L[2] + m2
    terms = L[0] * L[0] + L[1] * L[1] + L[2] * L[2] + m1 * m1 + m2 * m2
    return right[0] * right[0] + right[1] * right[1] + right[2] * right[2] > 1e-18 * terms


@loop
def _linearize_all(
    model_tag, poses, pose_index, lines, intrinsics, line_index, intrinsics_index, segments, baselines,
    begin, end, pose_column, line_column, intrinsics_column, record,
):  # fmt: skip
    size = intrinsics.shape[1]
    L, right, K, params = np.empty(6), np.empty(3), np.empty(4), np.empty(size)
    J_K, out = np.empty((4, size)), np.empty((4, 8))
    camera, degenerate, last = -1, 0, record.shape[2] - 1
    step = 1 if baselines.shape[0] > 1 else 0
    for i in range(begin, end):
        k, c, baseline = i - begin, pose_index[i], baselines[i * step]
        if intrinsics_index[i] != camera:
            camera = load_row(intrinsics, intrinsics_index[i], camera, params)
            pinhole_parameters(model_tag, params, K)
            pinhole_parameters_jacobian(model_tag, params, J_K)
        valid = transform_line(poses, c, lines, line_index[i], L)
        valid &= _right_moment(L, baseline, right)
        h = image_line_norm(L[0], L[1], L[2], K)
        h_right = image_line_norm(right[0], right[1], right[2], K)
        if valid and h > 0.0 and h_right > 0.0:
            for row in range(2):
                u, v = segments[i, 2 * row], segments[i, 2 * row + 1]
                valid &= endpoint_distance(L[0], L[1], L[2], K, h, u, v, out, row)
                u, v = segments[i, 4 + 2 * row], segments[i, 5 + 2 * row]
                valid &= endpoint_distance(right[0], right[1], right[2], K, h_right, u, v, out, 2 + row)
        else:
            valid = False
        if valid:
            for row in range(4):
                record[k, row, last] = out[row, 0]
                g0, g1, g2 = out[row, 1], out[row, 2], out[row, 3]
                b = baseline if row >= 2 else 0.0
                # h = g x τ = (0, -b g_z, b g_y)
                if pose_column >= 0:
                    put_line_pose(g0, g1, g2, 0.0, -b * g2, b * g1, L, record, k, row, pose_column)
                if line_column >= 0:
                    put_line(g0, g1, g2, 0.0, -b * g2, b * g1, poses, c, record, k, row, line_column)
                if intrinsics_column >= 0:
                    put_pinhole(out, J_K, record, k, row, intrinsics_column)
        else:
            clear_record(record, k, pose_column, line_column, 6, intrinsics_column, size)
            degenerate += 1
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("stereo_line")
@dataclass(frozen=True, kw_only=True)
class StereoLine(StereoFactor):
    """Lines seen by rectified stereo pairs; residual: end point distances, left then right, in pixels.

    Degenerate, both segments together: where one of the two cameras has no image of the line (see
    :class:`~groma.factors.observations.line_reprojection.LineReprojection`).
    """

    #: Lines in the world, any scale of (m, d).
    line: Ref
    #: (N, 8) measured end points u1, v1, u2, v2 on the left, then on the right, in pixels.
    segments: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("line", "line"), INTRINSICS, EXTRINSICS)
    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("segments", (8,)),)
    rows: ClassVar[int] = 4

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        arguments = self.arguments(inputs, self.line, self.segments, np.atleast_1d(self.baseline))
        return _linearize_all(*arguments, begin, end, *columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)),
            line=Ref("lines", indices(rng, 4)),
            intrinsics=Ref("intrinsics", indices(rng, 2)),
            camera_model="PINHOLE",
            segments=rng.uniform(100.0, 500.0, (6, 8)),
            baseline=0.5,
        )
        return pixel_example(factor, rng)
