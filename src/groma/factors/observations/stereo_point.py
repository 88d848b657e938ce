# SPDX-License-Identifier: BSD-3-Clause
r"""A point seen by a rectified stereo pair: column on the left, common row, column on the right.

Both cameras have the pinhole parameters :math:`(f_x, f_y, c_x, c_y)`; the right one is displaced by the baseline b
along the x axis of the left one. With :math:`P = (x, y, z) = R X_w + t` in the left camera

.. math:: r = \Big[\, f_x \frac xz + c_x - u_l,\;\; f_y \frac yz + c_y - v,\;\; f_x \frac{x - b}{z} + c_x - u_r \,\Big]

in pixels; the third row is the first one of the point :math:`P - (b, 0, 0)`. Each row a of
:math:`\partial r/\partial P` gives the pose row :math:`[a^\top, (P \times a)^\top]` and the point row :math:`a^\top R`.

Source: eqs. (2) to (5) of the Point-line-plane notes, applied to both cameras.
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
from groma.factors._pixels import INTRINSICS, StereoFactor, load_row, pixel_example, put_parameters
from groma.factors._rig import EXTRINSICS, POSE, clear_record, put_point, put_point_pose, transform_point
from groma.factors.contract import Example, Measurement, Ref, Slot, register


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _linearize(P, baseline, K, pixels, i, r, A):
    """Write ``r`` (3,) and A = dr/dP (3, 3); False for a point that is not in front of the pair."""
    z = P[2]
    if not z > 1e-12 * (abs(P[0]) + abs(P[1])):
        return False
    k = 1.0 / z
    x, y, x_right = P[0] * k, P[1] * k, (P[0] - baseline) * k
    r[0] = K[0] * x + K[2] - pixels[i, 0]
    r[1] = K[1] * y + K[3] - pixels[i, 1]
    r[2] = K[0] * x_right + K[2] - pixels[i, 2]
    A[0, 0], A[0, 1], A[0, 2] = K[0] * k, 0.0, -K[0] * x * k
    A[1, 0], A[1, 1], A[1, 2] = 0.0, K[1] * k, -K[1] * y * k
    A[2, 0], A[2, 1], A[2, 2] = K[0] * k, 0.0, -K[0] * x_right * k
    return abs(r[0]) + abs(r[1]) + abs(r[2]) < math.inf


@kernel
def _parameters(P, baseline, J_K, J_params):
    """Write ``J_params`` (3, k) from the derivative ``J_K`` (4, k) of fx, fy, cx, cy."""
    x, y, x_right = P[0] / P[2], P[1] / P[2], (P[0] - baseline) / P[2]
    for j in range(J_K.shape[1]):
        J_params[0, j] = x * J_K[0, j] + J_K[2, j]
        J_params[1, j] = y * J_K[1, j] + J_K[3, j]
        J_params[2, j] = x_right * J_K[0, j] + J_K[2, j]


@loop
def _linearize_all(
    model_tag, poses, pose_index, points, intrinsics, point_index, intrinsics_index, pixels, baselines,
    begin, end, pose_column, point_column, intrinsics_column, record,
):  # fmt: skip
    size = intrinsics.shape[1]
    P, r, A, params, K = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(size), np.empty(4)
    J_K, J_params = np.empty((4, size)), np.empty((3, size))
    camera, degenerate, last = -1, 0, record.shape[2] - 1
    step = 1 if baselines.shape[0] > 1 else 0
    for i in range(begin, end):
        k, c, baseline = i - begin, pose_index[i], baselines[i * step]
        if intrinsics_index[i] != camera:
            camera = load_row(intrinsics, intrinsics_index[i], camera, params)
            pinhole_parameters(model_tag, params, K)
            pinhole_parameters_jacobian(model_tag, params, J_K)
        transform_point(poses, c, points, point_index[i], P)
        if _linearize(P, baseline, K, pixels, i, r, A):
            if intrinsics_column >= 0:
                _parameters(P, baseline, J_K, J_params)
            for row in range(3):
                record[k, row, last] = r[row]
                if pose_column >= 0:
                    put_point_pose(A[row, 0], A[row, 1], A[row, 2], P, record, k, row, pose_column)
                if point_column >= 0:
                    put_point(A[row, 0], A[row, 1], A[row, 2], poses, c, record, k, row, point_column)
                if intrinsics_column >= 0:
                    put_parameters(J_params, record, k, row, intrinsics_column)
        else:
            clear_record(record, k, pose_column, point_column, 3, intrinsics_column, size)
            degenerate += 1
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("stereo_point")
@dataclass(frozen=True, kw_only=True)
class StereoPoint(StereoFactor):
    """Points seen by rectified stereo pairs; residual: u left, v, u right in pixels.

    Degenerate: points not in front of the pair.
    """

    #: Points in the world.
    point: Ref
    #: (N, 3) measured u left, v, u right in pixels; the disparity is u left - u right.
    pixels: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("point", "point"), INTRINSICS, EXTRINSICS)
    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("pixels", (3,)),)
    rows: ClassVar[int] = 3

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        arguments = self.arguments(inputs, self.point, self.pixels, np.atleast_1d(self.baseline))
        return _linearize_all(*arguments, begin, end, *columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)),
            point=Ref("points", indices(rng, 4)),
            intrinsics=Ref("intrinsics", indices(rng, 2)),
            camera_model="PINHOLE",
            pixels=rng.uniform(100.0, 500.0, (6, 3)),
            baseline=rng.uniform(0.3, 0.6, 6),
        )
        return pixel_example(factor, rng)
