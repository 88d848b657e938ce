# SPDX-License-Identifier: BSD-3-Clause
"""How many pixels a radian is, across the image of a line."""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.cameras.contract import CameraModel
from groma.geometry.algebra import unit


def pixels_across(model: CameraModel, params: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """How many pixels the ends of a segment move across it (n, 2) as their rays leave its plane, per radian.

    Across the image of the line there: under distortion it is a curve.

    Parameters
    ----------
    model : CameraModel
        Camera model.
    params : (k,) or (n, k) float64
        Camera parameters.
    first, second : (n, 3) float64
        Unit bearings of the two ends, camera frame.
    """
    normal = unit(np.cross(first, second))
    across = []
    for ray in (first, second):
        by_ray = model.project_jacobian(params, np.ascontiguousarray(ray))[1]
        moved = np.einsum("nij,nj->ni", by_ray, normal)
        along = unit(np.einsum("nij,nj->ni", by_ray, np.cross(normal, ray)))
        across.append(np.abs(along[:, 0] * moved[:, 1] - along[:, 1] * moved[:, 0]))
    return np.stack(across, axis=1)
