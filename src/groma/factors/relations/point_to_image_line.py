# SPDX-License-Identifier: BSD-3-Clause
r"""A point lies on a line that was seen in an image: the distance, in pixels, of its projection from the image line.

With :math:`P = R_{cw} X_w + t_{cw}`, the projection :math:`\pi` of the camera model and the measured image line
:math:`(a, b, c), \; a^2 + b^2 = 1`,

.. math:: r = [\,a\;\; b\,]\,\pi(P, k) + c \qquad \text{(pixels)}

.. math:: s = [\,a\;\; b\,] \frac{\partial \pi}{\partial P}, \qquad
          \frac{\partial r}{\partial \xi} = [\, s \mid (P \times s^\top)^\top \,], \qquad
          \frac{\partial r}{\partial X_w} = s\, R_{cw}, \qquad
          \frac{\partial r}{\partial k} = [\,a\;\; b\,] \frac{\partial \pi}{\partial k} .

It ties a point to a line without touching the line: point and line stay uncoupled, and both can be eliminated. The
other half of the relation is :mod:`groma.factors.relations.line_to_pixel`. Under distortion the image of a line is
curved; the measured line must then be its tangent near the point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._numba import loop
from groma._typing import Columns, FloatArray, Inputs
from groma.cameras.dispatch import project_jacobian
from groma.factors._examples import indices
from groma.factors._pixels import INTRINSICS, PixelFactor, load_row, pixel_example
from groma.factors._rig import EXTRINSICS, POSE, clear_record, put_point, put_point_pose, transform_point
from groma.factors.contract import Example, Measurement, Ref, Slot, register


# ------------------------------------------------------------------------------------------------------------ Kernels
@loop
def _linearize_all(
    model_tag, poses, pose_index, points, intrinsics, point_index, intrinsics_index, smallest_depth, image_lines,
    begin, end, pose_column, point_column, intrinsics_column, record,
):  # fmt: skip
    P, uv, params = np.empty(3), np.empty(2), np.empty(intrinsics.shape[1])
    A, J_params = np.empty((2, 3)), np.empty((2, intrinsics.shape[1]))
    camera, degenerate, last = -1, 0, record.shape[2] - 1
    for i in range(begin, end):
        k, c = i - begin, pose_index[i]
        a, b = image_lines[i, 0], image_lines[i, 1]
        camera = load_row(intrinsics, intrinsics_index[i], camera, params)
        transform_point(poses, c, points, point_index[i], P)
        r = math.inf
        if P[2] > smallest_depth and project_jacobian(model_tag, params, P, uv, A, J_params):
            r = a * uv[0] + b * uv[1] + image_lines[i, 2]
        if abs(r) < math.inf:
            record[k, 0, last] = r
            s0, s1, s2 = a * A[0, 0] + b * A[1, 0], a * A[0, 1] + b * A[1, 1], a * A[0, 2] + b * A[1, 2]
            if pose_column >= 0:
                put_point_pose(s0, s1, s2, P, record, k, 0, pose_column)
            if point_column >= 0:
                put_point(s0, s1, s2, poses, c, record, k, 0, point_column)
            if intrinsics_column >= 0:
                for j in range(params.shape[0]):
                    record[k, 0, intrinsics_column + j] = a * J_params[0, j] + b * J_params[1, j]
        else:
            clear_record(record, k, pose_column, point_column, 3, intrinsics_column, params.shape[0])
            degenerate += 1
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("point_to_image_line")
@dataclass(frozen=True, kw_only=True)
class PointToImageLine(PixelFactor):
    """Points on lines seen in images, any camera model; residual: distance from the image line in pixels.

    Degenerate: points that the model cannot project, and points not in front of a perspective camera.
    """

    #: Points in the world.
    point: Ref
    #: (N, 3) measured image lines a, b, c with a u + b v + c = 0 in pixels, any scale.
    image_lines: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("point", "point"), INTRINSICS, EXTRINSICS)
    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("image_lines", (3,), num_normalized=2),)
    rows: ClassVar[int] = 1

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        arguments = self.arguments(inputs, self.point, self.smallest_depth, self.image_lines)
        return _linearize_all(*arguments, begin, end, *columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)),
            point=Ref("points", indices(rng, 4)),
            intrinsics=Ref("intrinsics", indices(rng, 2)),
            camera_model="RADIAL",
            image_lines=np.hstack([rng.normal(size=(6, 2)), rng.uniform(-300.0, 300.0, (6, 1))]),
        )
        return pixel_example(factor, rng)
