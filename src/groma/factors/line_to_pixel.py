# SPDX-License-Identifier: BSD-3-Clause
r"""A line passes through a point that was seen in an image: the distance, in pixels, of the pixel from the image line.

One row of :mod:`groma.factors.line_reprojection`, with the pixel of the point in the place of an end point:

.. math:: r = \frac{a\,(u - c_x) + b\,(v - c_y) + m_z}{h}, \qquad a = m_x/f_x,\; b = m_y/f_y,\; h = \sqrt{a^2 + b^2}

for the moment m of the line in the camera. It ties a line to a point without touching the point: both stay uncoupled
and can be eliminated. The other half of the relation is :mod:`groma.factors.point_to_image_line`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._numba import loop
from groma._typing import FloatArray
from groma.cameras import CameraModel
from groma.cameras._dispatch import pinhole_parameters, pinhole_parameters_jacobian
from groma.factors._examples import indices, make_example
from groma.factors._factor import Example, Ref, Slot, register
from groma.factors._rig import (
    EXTRINSICS,
    POSE,
    CameraFactor,
    as_camera_model,
    check_intrinsics,
    clear_block,
    clear_residual,
    load_row,
    put_line,
    put_line_pose,
    transform_line,
    visible_scene,
)
from groma.factors.line_reprojection import endpoint_distance, image_line_norm, put_pinhole
from groma.geometry._manifold import Euclidean


# ------------------------------------------------------------------------------------------------------------ Kernels
@loop
def _linearize_all(
    model_tag, poses, pose_index, lines, intrinsics, line_index, intrinsics_index, pixels,
    begin, end, pose_column, line_column, intrinsics_column, record,
):  # fmt: skip
    size = intrinsics.shape[1]
    L, K, J_K, params, out = np.empty(6), np.empty(4), np.empty((4, size)), np.empty(size), np.empty((1, 8))
    camera, degenerate, last = -1, 0, record.shape[2] - 1
    for i in range(begin, end):
        k, c = i - begin, pose_index[i]
        if intrinsics_index[i] != camera:
            camera = load_row(intrinsics, intrinsics_index[i], camera, params)
            pinhole_parameters(model_tag, params, K)
            pinhole_parameters_jacobian(model_tag, params, J_K)
        valid = transform_line(poses, c, lines, line_index[i], L)
        h = image_line_norm(L[0], L[1], L[2], K)
        if valid and h > 0.0 and endpoint_distance(L[0], L[1], L[2], K, h, pixels[i, 0], pixels[i, 1], out, 0):
            g0, g1, g2 = out[0, 1], out[0, 2], out[0, 3]
            record[k, 0, last] = out[0, 0]
            if pose_column >= 0:
                put_line_pose(g0, g1, g2, 0.0, 0.0, 0.0, L, record, k, 0, pose_column)
            if line_column >= 0:
                put_line(g0, g1, g2, 0.0, 0.0, 0.0, poses, c, record, k, 0, line_column)
            if intrinsics_column >= 0:
                put_pinhole(out, J_K, record, k, 0, intrinsics_column)
        else:
            clear_block(record, k, pose_column, 6)
            clear_block(record, k, line_column, 6)
            clear_block(record, k, intrinsics_column, size)
            clear_residual(record, k)
            degenerate += 1
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("line_to_pixel")
@dataclass(frozen=True, kw_only=True)
class LineToPixel(CameraFactor):
    """Lines through points seen in images, cameras without distortion; residual: distance of the pixel in pixels.

    Degenerate: lines through the camera centre, and lines without an image (see
    :class:`~groma.factors.line_reprojection.LineReprojection`).
    """

    #: Lines in the world, any scale of (m, d).
    line: Ref
    #: Parameters of the cameras, all of one model.
    intrinsics: Ref
    #: SIMPLE_PINHOLE or PINHOLE (or another model without distortion).
    camera_model: CameraModel | str
    #: (N, 2) measured pixels of points on the lines.
    pixels: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("line", "line"), Slot("intrinsics", "intrinsics"), EXTRINSICS)
    measured: ClassVar[tuple[tuple[str, int], ...]] = (("pixels", 2),)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "camera_model", as_camera_model(self.camera_model))
        as_camera_model(self.camera_model).require_pinhole()

    @property
    def residual_size(self) -> int:  # noqa: D102
        return 1

    def evaluate(  # noqa: D102
        self, inputs: tuple[Any, ...], begin: int, end: int, columns: tuple[int, ...], record: FloatArray
    ) -> int:
        camera = as_camera_model(self.camera_model)
        check_intrinsics(camera, inputs[3])
        arrays = (self.line.index, self.intrinsics.index, self.pixels)
        arguments: tuple[Any, ...] = (camera.tag, *inputs, *arrays, begin, end, *columns, record)
        return _linearize_all(*arguments)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)),
            line=Ref("lines", indices(rng, 4)),
            intrinsics=Ref("intrinsics", indices(rng, 2)),
            camera_model="PINHOLE",
            pixels=rng.uniform(100.0, 500.0, (6, 2)),
        )
        pinhole = np.array([[500.0, 510.0, 320.0, 240.0], [400.0, 405.0, 300.0, 200.0]])
        manifolds = {"intrinsics": Euclidean(4, "intrinsics")}
        return make_example(factor, rng, manifolds=manifolds, states={**visible_scene(rng), "intrinsics": pinhole})
