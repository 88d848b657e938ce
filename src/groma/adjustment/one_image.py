# SPDX-License-Identifier: BSD-3-Clause
"""The factors of one image before landmarks that are held, as :mod:`groma.adjustment.assemble` makes them of a scene.

Localising a photograph takes several of them, and the tables of a scene, with their checks, take longer than
the factors.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.cameras import CameraModel
from groma.factors.contract import Factor, Ref
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.point_reprojection import PointReprojection


def one_image_factors(
    model: CameraModel, points: tuple[FloatArray, FloatArray], lines: tuple[FloatArray, FloatArray]
) -> tuple[Factor, ...]:
    """Return the factors of one image, first of all points, then of all lines, each of a landmark of its own.

    Parameters
    ----------
    model
        Of the camera. Lines ask for one without distortion.
    points
        Pixels (N, 2), and their standard deviations (N,).
    lines
        Segments (M, 4), and standard deviations (M,) of their ends, pixels.
    """
    factors: list[Factor] = []
    for group, (seen, sigma) in (("points", points), ("lines", lines)):
        if not len(seen):
            continue
        zeros, own = np.zeros(len(seen), np.int64), Ref(group, np.arange(len(seen)))
        common = {
            "camera_model": model, "pose": Ref("frames", zeros), "intrinsics": Ref("intrinsics", zeros),
            "sqrt_information": 1.0 / sigma,
        }  # fmt: skip
        if group == "points":
            factors.append(PointReprojection(point=own, pixels=seen, **common))
        else:
            factors.append(LineReprojection(line=own, segments=seen, **common))
    return tuple(factors)
