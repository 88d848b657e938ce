# SPDX-License-Identifier: BSD-3-Clause
r"""A point with a measured depth, as an RGB-D camera gives it.

Depth is the coordinate along the optical axis of :math:`P = R X_w + t`, not the distance:

.. math:: r = P_z - \tilde z \quad\text{(scene units)}, \qquad
          \frac{\partial r}{\partial \xi} = [\, e_3^\top,\; (P \times e_3)^\top \,], \qquad
          \frac{\partial r}{\partial X_w} = e_3^\top R

for the left twist :math:`(\rho, \omega)`. The noise of depth cameras grows with the square of the depth: give
``sqrt_information`` per observation. Use it beside
:class:`~groma.factors.observations.point_reprojection.PointReprojection`, which holds the other two coordinates.

Source: eqs. (3), (4) of the Point-line-plane notes, third row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._numba import loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import indices, make_example, visible_scene
from groma.factors._rig import EXTRINSICS, POSE, CameraFactor, clear_record, put_point, put_point_pose, transform_point
from groma.factors.contract import Example, Measurement, Ref, Slot, register


# ------------------------------------------------------------------------------------------------------------ Kernels
@loop
def _linearize_all(poses, pose_index, points, point_index, depths, begin, end, pose_column, point_column, record):
    P = np.empty(3)
    degenerate, last = 0, record.shape[2] - 1
    for i in range(begin, end):
        k, c = i - begin, pose_index[i]
        transform_point(poses, c, points, point_index[i], P)
        if abs(P[0]) + abs(P[1]) + abs(P[2]) < math.inf:
            record[k, 0, last] = P[2] - depths[i]
            if pose_column >= 0:
                put_point_pose(0.0, 0.0, 1.0, P, record, k, 0, pose_column)
            if point_column >= 0:
                put_point(0.0, 0.0, 1.0, poses, c, record, k, 0, point_column)
        else:
            clear_record(record, k, pose_column, point_column, 3, -1, 0)
            degenerate += 1
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("point_depth")
@dataclass(frozen=True, kw_only=True)
class PointDepth(CameraFactor):
    """Measured depths of points; residual in scene units. Never degenerate for finite variables."""

    #: Points in the world.
    point: Ref
    #: (N,) measured depths along the optical axis, scene units.
    depths: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("point", "point"), EXTRINSICS)
    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("depths", ()),)
    rows: ClassVar[int] = 1

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        return _linearize_all(*inputs, self.point.index, self.depths, begin, end, *columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)), point=Ref("points", indices(rng, 4)), depths=rng.uniform(5.0, 10.0, 6)
        )
        return make_example(factor, rng, states=visible_scene(rng))
