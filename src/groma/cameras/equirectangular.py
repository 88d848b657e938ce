# SPDX-License-Identifier: BSD-3-Clause
r"""The 360-degree panorama: EQUIRECTANGULAR (w, h), its width and height in pixels.

.. math::
    u = w \Big(\frac12 + \frac{\operatorname{atan2}(x, z)}{2 \pi}\Big), \qquad
    v = h \Big(\frac12 + \frac{1}{\pi} \operatorname{atan2}\big(y, \sqrt{x^2 + z^2}\big)\Big)

Every direction has an image; those straight up and down are a whole row of it, so that they have no pixel here. Left
and right border are the same place: differences of pixels are taken the short way round (``wrap``), and u may leave
[0, w] for bearings, v not [0, h]. Width and height are known, not estimated. Name and parameters are COLMAP's.
"""

from __future__ import annotations

import math

from groma._numba import kernel
from groma.cameras.contract import CameraModel
from groma.cameras.fisheye import ON_AXIS
from groma.cameras.pinhole import MAX_NORM, MIN_NORM, clear
from groma.cameras.registry import register_camera

# --------------------------------------------------------------------------------------------------------- Kernels


@kernel
def _has_azimuth(X):
    """Whether the point is of representable size, and neither straight up nor down."""
    side = abs(X[0]) + abs(X[2])
    norm = side + abs(X[1])
    return MIN_NORM < norm < MAX_NORM and side > ON_AXIS * norm


@kernel
def equirectangular_project(params, X, uv):
    """Project with (w, h)."""
    if not _has_azimuth(X):
        uv[:] = 0.0
        return False
    level = math.sqrt(X[0] * X[0] + X[2] * X[2])
    uv[0] = params[0] * (0.5 + math.atan2(X[0], X[2]) / (2.0 * math.pi))
    uv[1] = params[1] * (0.5 + math.atan2(X[1], level) / math.pi)
    return True


@kernel
def equirectangular_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (w, h) and differentiate."""
    clear(uv, J_point, J_params)
    if not equirectangular_project(params, X, uv):
        return False
    x, y, z = X[0], X[1], X[2]
    squared = x * x + z * z
    level = math.sqrt(squared)
    across = params[0] / (2.0 * math.pi * squared)
    J_point[0, 0], J_point[0, 2] = across * z, -across * x
    down = params[1] / (math.pi * (squared + y * y))
    J_point[1, 0], J_point[1, 1], J_point[1, 2] = -down * y * x / level, down * level, -down * y * z / level
    J_params[0, 0] = 0.5 + math.atan2(x, z) / (2.0 * math.pi)
    J_params[1, 1] = 0.5 + math.atan2(y, level) / math.pi
    return True


@kernel
def equirectangular_unproject(params, uv, bearing):
    """Unit bearing with (w, h)."""
    bearing[:] = 0.0
    width, height = params[0], params[1]
    if not (width > 0.0 and height > 0.0 and abs(uv[0]) < math.inf and 0.0 <= uv[1] <= height):
        return False
    azimuth = 2.0 * math.pi * (uv[0] / width - 0.5)
    down = math.pi * (uv[1] / height - 0.5)
    level = math.cos(down)
    bearing[0], bearing[1], bearing[2] = level * math.sin(azimuth), math.sin(down), level * math.cos(azimuth)
    return True


@kernel
def equirectangular_wrap(params, difference):
    """Take a difference of pixels the short way round."""
    if params[0] > 0.0:
        difference[0] -= params[0] * math.floor(difference[0] / params[0] + 0.5)


# ---------------------------------------------------------------------------------------------------------- Public

EQUIRECTANGULAR = register_camera(
    CameraModel("EQUIRECTANGULAR", ("w", "h"), (), (), (), "EQUIRECTANGULAR", sees_behind=True),
    equirectangular_project,
    equirectangular_project_jacobian,
    equirectangular_unproject,
    wrap=equirectangular_wrap,
)
