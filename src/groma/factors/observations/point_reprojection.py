# SPDX-License-Identifier: BSD-3-Clause
r"""A point seen at a pixel, under any camera model.

With :math:`P = R_{cw} X_w + t_{cw}` and the projection :math:`\pi` of the camera model with parameters k,

.. math:: r = \pi(P, k) - u \qquad \text{(pixels)}

.. math:: A = \frac{\partial \pi}{\partial P}, \qquad
          \frac{\partial r}{\partial \xi} = A\,[\, I \mid -[P]_\times \,], \qquad
          \frac{\partial r}{\partial X_w} = A\, R_{cw}, \qquad
          \frac{\partial r}{\partial k} = \frac{\partial \pi}{\partial k}

for the left twist :math:`\xi = (\rho, \omega)`; each row a of A gives the pose row :math:`[a^\top, (P \times a)^\top]`.

Source: Point-line-plane notes, eqs. (2) to (5). Here the residual has the opposite sign (predicted minus measured), and
the twist has the translation first, which is the order in which the block :math:`[I, -[P]_\times]` printed there holds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.cameras.dispatch import project, project_jacobian, wrap
from groma.factors._examples import indices
from groma.factors._pixels import INTRINSICS, PixelFactor, load_row, pixel_example, put_parameters
from groma.factors._rig import EXTRINSICS, MOTION, POSE, clear_record, put_point, put_point_pose, transform_point
from groma.factors.contract import Example, Measurement, Ref, Slot, register


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _difference(model_tag, params, uv, pixels, i):
    """Subtract the measured pixel from ``uv``, the short way in a panorama; False if the result is not finite."""
    uv[0] -= pixels[i, 0]
    uv[1] -= pixels[i, 1]
    wrap(model_tag, params, uv)
    return abs(uv[0]) + abs(uv[1]) < math.inf


@loop
def _residual_all(
    model_tag, poses, pose_index, points, intrinsics, point_index, intrinsics_index, smallest_depth, pixels,
    begin, end, out,
):  # fmt: skip
    P, uv, params = np.empty(3), np.empty(2), np.empty(intrinsics.shape[1])
    camera, degenerate = -1, 0
    for i in range(begin, end):
        camera = load_row(intrinsics, intrinsics_index[i], camera, params)
        transform_point(poses, pose_index[i], points, point_index[i], P)
        if (
            P[2] > smallest_depth
            and project(model_tag, params, P, uv)
            and _difference(model_tag, params, uv, pixels, i)
        ):
            out[i - begin, 0], out[i - begin, 1] = uv[0], uv[1]
        else:
            out[i - begin, 0], out[i - begin, 1] = 0.0, 0.0
            degenerate += 1
    return degenerate


@loop
def _linearize_all(
    model_tag, poses, pose_index, points, intrinsics, point_index, intrinsics_index, smallest_depth, pixels,
    begin, end, pose_column, point_column, intrinsics_column, record,
):  # fmt: skip
    P, uv, params = np.empty(3), np.empty(2), np.empty(intrinsics.shape[1])
    A, J_params = np.empty((2, 3)), np.empty((2, intrinsics.shape[1]))
    camera, degenerate, last = -1, 0, record.shape[2] - 1
    for i in range(begin, end):
        k, c = i - begin, pose_index[i]
        camera = load_row(intrinsics, intrinsics_index[i], camera, params)
        transform_point(poses, c, points, point_index[i], P)
        if (
            P[2] > smallest_depth
            and project_jacobian(model_tag, params, P, uv, A, J_params)
            and _difference(model_tag, params, uv, pixels, i)
        ):
            record[k, 0, last], record[k, 1, last] = uv[0], uv[1]
            if pose_column >= 0:
                put_point_pose(A[0, 0], A[0, 1], A[0, 2], P, record, k, 0, pose_column)
                put_point_pose(A[1, 0], A[1, 1], A[1, 2], P, record, k, 1, pose_column)
            if point_column >= 0:
                put_point(A[0, 0], A[0, 1], A[0, 2], poses, c, record, k, 0, point_column)
                put_point(A[1, 0], A[1, 1], A[1, 2], poses, c, record, k, 1, point_column)
            if intrinsics_column >= 0:
                put_parameters(J_params, record, k, 0, intrinsics_column)
                put_parameters(J_params, record, k, 1, intrinsics_column)
        else:
            clear_record(record, k, pose_column, point_column, 3, intrinsics_column, params.shape[0])
            degenerate += 1
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("point_reprojection")
@dataclass(frozen=True, kw_only=True)
class PointReprojection(PixelFactor):
    """Points seen at pixels; residual in pixels.

    Degenerate, thus left out of the sum: points that the model cannot project, and points not in front of a perspective
    camera (see :attr:`require_in_front`).
    """

    #: Points in the world (with the slots of :class:`~groma.factors._rig.CameraFactor`).
    point: Ref
    #: (N, 2) measured pixels.
    pixels: FloatArray
    #: Leave out points with z <= 0 in a perspective camera. False evaluates the formula there as it is written, which
    #: is the habit of most bundle adjusters. Models that see behind themselves are not concerned.
    require_in_front: bool = True

    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("point", "point"), INTRINSICS, EXTRINSICS, MOTION)
    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("pixels", (2,)),)
    rows: ClassVar[int] = 2

    def _arguments(self, inputs: tuple[Any, ...]) -> tuple[Any, ...]:
        smallest_depth = self.smallest_depth if self.require_in_front else -np.inf
        return self.arguments(inputs, self.point, smallest_depth, self.pixels)

    def residuals(self, inputs: tuple[Any, ...], begin: int, end: int, out: FloatArray) -> int:  # noqa: D102
        return _residual_all(*self._arguments(inputs[1:]), begin, end, out)

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        return _linearize_all(*self._arguments(inputs), begin, end, *columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)),
            point=Ref("points", indices(rng, 4)),
            intrinsics=Ref("intrinsics", indices(rng, 2)),
            camera_model="RADIAL",
            pixels=rng.uniform(100.0, 500.0, (6, 2)),
        )
        return pixel_example(factor, rng)
