# SPDX-License-Identifier: BSD-3-Clause
r"""A line passes through a point that was seen in an image: the distance, in pixels, of the pixel from the image line.

One row of :mod:`groma.factors.observations.line_reprojection`, whose loop it shares, with the pixel of the point in the
place of an end point:

.. math:: r = \frac{a\,(u - c_x) + b\,(v - c_y) + m_z}{h}, \qquad a = m_x/f_x,\; b = m_y/f_y,\; h = \sqrt{a^2 + b^2}

for the moment m of the line in the camera. It ties a line to a point without touching the point: both stay uncoupled
and can be eliminated. The other half of the relation is :mod:`groma.factors.relations.point_to_image_line`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import indices
from groma.factors._pixels import INTRINSICS, PixelFactor, pixel_example
from groma.factors._rig import EXTRINSICS, POSE
from groma.factors.contract import Example, Measurement, Ref, Slot, register
from groma.factors.observations.line_reprojection import linearize_pixels


@register("line_to_pixel")
@dataclass(frozen=True, kw_only=True)
class LineToPixel(PixelFactor):
    """Lines through points seen in images, cameras without distortion; residual: distance of the pixel in pixels.

    Degenerate: lines through the camera centre, and lines without an image (see
    :class:`~groma.factors.observations.line_reprojection.LineReprojection`).
    """

    #: Lines in the world, any scale of (m, d).
    line: Ref
    #: (N, 2) measured pixels of points on the lines.
    pixels: FloatArray

    pinhole_only: ClassVar[bool] = True
    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("line", "line"), INTRINSICS, EXTRINSICS)
    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("pixels", (2,)),)
    rows: ClassVar[int] = 1

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        arguments = self.arguments(inputs, self.line, (None,), self.pixels)
        return linearize_pixels(*arguments, begin, end, *columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)),
            line=Ref("lines", indices(rng, 4)),
            intrinsics=Ref("intrinsics", indices(rng, 2)),
            camera_model="PINHOLE",
            pixels=rng.uniform(100.0, 500.0, (6, 2)),
        )
        return pixel_example(factor, rng)
