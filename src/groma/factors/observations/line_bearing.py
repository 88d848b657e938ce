# SPDX-License-Identifier: BSD-3-Clause
r"""A line seen as two bearings: sines of the angles between them and the plane through camera centre and line.

With the moment :math:`m_c = R m + t \times R d` of the line in the camera, and the unit bearings
:math:`f_s, f_e` of the two ends of the measured segment,

.. math:: r = [\, f_s \cdot \hat m_c,\; f_e \cdot \hat m_c \,], \qquad
          g = \frac{\partial r_i}{\partial m_c} = \frac{f_i - r_i\, \hat m_c}{\lVert m_c \rVert}

.. math:: \frac{\partial r_i}{\partial \xi} = [\,(d_c \times g)^\top,\; (m_c \times g)^\top\,], \qquad
          \frac{\partial r_i}{\partial (m, d)} = [\,g^\top R,\; (g \times t)^\top R\,]

for the left twist :math:`(\rho, \omega)`. Bearings come from any camera model
(:meth:`groma.cameras.CameraModel.unproject`), so this is the line factor under distortion, and for fisheye cameras. The
parameters of the camera are held; :mod:`groma.factors.observations.line_unprojection` estimates them. Multiply by the
focal length, through ``sqrt_information``, to get about pixels.

Source: the motion of the line is Plücker notes, eq. (65); the residual is the one of eq. (76) on the unit sphere. It
does not depend on the scale of (m, d), and changes its sign with that of (m, d).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import indices, make_example, visible_scene
from groma.factors._rig import (
    EXTRINSICS,
    MOTION,
    POSE,
    CameraFactor,
    clear_record,
    put_line,
    put_line_pose,
    transform_line,
)
from groma.factors.contract import ANY_SIMILARITY, Example, Invariance, Measurement, Ref, Slot, register


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def bearing_sine(L, k, bearings, i, out):
    """Write r and g = dr/dm (3,) to ``out`` (4,); k = 1/|m|."""
    u0, u1, u2 = L[0] * k, L[1] * k, L[2] * k
    r = bearings[i, 0] * u0 + bearings[i, 1] * u1 + bearings[i, 2] * u2
    out[0] = r
    out[1] = (bearings[i, 0] - r * u0) * k
    out[2] = (bearings[i, 1] - r * u1) * k
    out[3] = (bearings[i, 2] - r * u2) * k


@loop
def _linearize_all(poses, pose_index, lines, line_index, starts, ends, begin, end, pose_column, line_column, record):
    L, out = np.empty(6), np.empty(4)
    degenerate, last = 0, record.shape[2] - 1
    for i in range(begin, end):
        k, c = i - begin, pose_index[i]
        valid = transform_line(poses, c, lines, line_index[i], L)
        norm = math.sqrt(L[0] * L[0] + L[1] * L[1] + L[2] * L[2])
        if valid and norm < math.inf:
            for row in range(2):
                if row == 0:
                    bearing_sine(L, 1.0 / norm, starts, i, out)
                else:
                    bearing_sine(L, 1.0 / norm, ends, i, out)
                record[k, row, last] = out[0]
                if pose_column >= 0:
                    put_line_pose(out[1], out[2], out[3], 0.0, 0.0, 0.0, L, record, k, row, pose_column)
                if line_column >= 0:
                    put_line(out[1], out[2], out[3], 0.0, 0.0, 0.0, poses, c, record, k, row, line_column)
        else:
            clear_record(record, k, pose_column, line_column, 6, -1, 0)
            degenerate += 1
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("line_bearing")
@dataclass(frozen=True, kw_only=True)
class LineBearing(CameraFactor):
    """Lines seen as pairs of bearings, any camera; residual: two sines of angles.

    Degenerate: lines through the camera centre (to 1e-9 of the lengths involved), of which every bearing plane is one.
    """

    #: Lines in the world, any scale of (m, d).
    line: Ref
    #: (N, 3) bearings of the first end points, camera frame; scaled to unit length on construction.
    start_bearings: FloatArray
    #: (N, 3) bearings of the second end points.
    end_bearings: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("line", "line"), EXTRINSICS, MOTION)
    invariance: ClassVar[Invariance] = ANY_SIMILARITY
    measurements: ClassVar[tuple[Measurement, ...]] = (
        Measurement("start_bearings", (3,), num_normalized=3),
        Measurement("end_bearings", (3,), num_normalized=3),
    )
    rows: ClassVar[int] = 2

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        bearings = (self.start_bearings, self.end_bearings)
        return _linearize_all(*inputs, self.line.index, *bearings, begin, end, *columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)),
            line=Ref("lines", indices(rng, 4)),
            start_bearings=rng.normal((0.0, 0.0, 3.0), 1.0, (6, 3)),
            end_bearings=rng.normal((0.0, 0.0, 3.0), 1.0, (6, 3)),
        )
        return make_example(factor, rng, states=visible_scene(rng))
