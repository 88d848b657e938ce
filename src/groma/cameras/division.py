# SPDX-License-Identifier: BSD-3-Clause
r"""The division model of radial distortion: SIMPLE_DIVISION (f, cx, cy, k) and DIVISION (fx, fy, cx, cy, k).

The ray of a pixel is rational: with :math:`a = (u - c_x)/f_x`, :math:`b = (v - c_y)/f_y`,

.. math:: (x, y, z) \sim (a,\; b,\; 1 + k\,(a^2 + b^2))

so that :math:`(a, b) = \lambda\,(x, y)` with the root of a quadratic,

.. math:: \lambda = \frac{2}{z + D}, \qquad D = \sqrt{z^2 - 4 k\,(x^2 + y^2)}, \qquad
          \frac{\partial\lambda}{\partial z} = -\frac{\lambda}{D}, \quad
          \frac{\partial\lambda}{\partial (x, y)} = \frac{2 k \lambda^2}{D}\,(x, y), \quad
          \frac{\partial\lambda}{\partial k} = \frac{\lambda^2 (x^2 + y^2)}{D}

With k < 0 (barrel distortion) every direction but straight backwards has an image, those behind the image plane beyond
the radius :math:`1/\sqrt{-k}`. With k > 0 only directions in front with :math:`z > 2 \sqrt{k (x^2 + y^2)}` have one,
and pixels within :math:`1/\sqrt{k}` a ray. Names and parameter order are COLMAP's.

Source: Fitzgibbon, *Simultaneous linear estimation of multiple view geometry and lens distortion*, 2001, eq. (3).
"""

from __future__ import annotations

import math

from groma._numba import kernel
from groma.cameras.contract import CameraModel
from groma.cameras.fisheye import ON_AXIS
from groma.cameras.pinhole import MAX_NORM, MIN_NORM, clear
from groma.cameras.registry import register_camera

# --------------------------------------------------------------------------------------------------------- Kernels

#: D must be more than this part of the largest of the two terms under its root.
MIN_ROOT = 1e-7


@kernel
def _scale(k, X):
    """Return lambda and D; zeros if the point has no image."""
    x, y, z = X[0], X[1], X[2]
    around = abs(x) + abs(y)
    if not MIN_NORM < around + abs(z) < MAX_NORM or (z <= 0.0 and not (k < 0.0 and around > ON_AXIS * abs(z))):
        return 0.0, 0.0
    term = 4.0 * k * (x * x + y * y)
    squared = z * z - term
    if not (squared > MIN_ROOT * MIN_ROOT * (z * z + abs(term)) and squared < math.inf):
        return 0.0, 0.0
    root = math.sqrt(squared)
    return (2.0 / (z + root) if z > 0.0 else 2.0 * (z - root) / term), root


@kernel
def _project(fx, fy, cx, cy, k, X, uv):
    scale, _ = _scale(k, X)
    if not 0.0 < scale < math.inf:
        uv[:] = 0.0
        return False
    uv[0], uv[1] = fx * scale * X[0] + cx, fy * scale * X[1] + cy
    return True


@kernel
def _project_jacobian(fx, fy, cx, cy, k, X, uv, J_point):
    """Write pixel and point derivative; return lambda (zero: no image) and its derivative by k."""
    scale, root = _scale(k, X)
    if not 0.0 < scale < math.inf:
        return 0.0, 0.0
    x, y = X[0], X[1]
    bend, by_depth = 2.0 * k * scale * scale / root, -scale / root
    uv[0], uv[1] = fx * scale * x + cx, fy * scale * y + cy
    J_point[0, 0], J_point[0, 1], J_point[0, 2] = fx * (scale + bend * x * x), fx * bend * x * y, fx * by_depth * x
    J_point[1, 0], J_point[1, 1], J_point[1, 2] = fy * bend * x * y, fy * (scale + bend * y * y), fy * by_depth * y
    return scale, scale * scale * (x * x + y * y) / root


@kernel
def _unproject(fx, fy, cx, cy, k, uv, bearing):
    bearing[:] = 0.0
    if fx == 0.0 or fy == 0.0:
        return False
    a, b = (uv[0] - cx) / fx, (uv[1] - cy) / fy
    s = a * a + b * b
    z = 1.0 + k * s
    norm = math.sqrt(s + z * z)
    if not norm < math.inf or k * s >= 1.0:
        return False
    bearing[0], bearing[1], bearing[2] = a / norm, b / norm, z / norm
    return True


@kernel
def simple_division_project(params, X, uv):
    """Project with (f, cx, cy, k)."""
    return _project(params[0], params[0], params[1], params[2], params[3], X, uv)


@kernel
def simple_division_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (f, cx, cy, k) and differentiate."""
    clear(uv, J_point, J_params)
    f = params[0]
    scale, by_k = _project_jacobian(f, f, params[1], params[2], params[3], X, uv, J_point)
    if scale == 0.0:
        return False
    J_params[0, 0], J_params[0, 1], J_params[0, 3] = scale * X[0], 1.0, f * by_k * X[0]
    J_params[1, 0], J_params[1, 2], J_params[1, 3] = scale * X[1], 1.0, f * by_k * X[1]
    return True


@kernel
def simple_division_unproject(params, uv, bearing):
    """Unit bearing with (f, cx, cy, k)."""
    return _unproject(params[0], params[0], params[1], params[2], params[3], uv, bearing)


@kernel
def division_project(params, X, uv):
    """Project with (fx, fy, cx, cy, k)."""
    return _project(params[0], params[1], params[2], params[3], params[4], X, uv)


@kernel
def division_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (fx, fy, cx, cy, k) and differentiate."""
    clear(uv, J_point, J_params)
    fx, fy = params[0], params[1]
    scale, by_k = _project_jacobian(fx, fy, params[2], params[3], params[4], X, uv, J_point)
    if scale == 0.0:
        return False
    J_params[0, 0], J_params[0, 2], J_params[0, 4] = scale * X[0], 1.0, fx * by_k * X[0]
    J_params[1, 1], J_params[1, 3], J_params[1, 4] = scale * X[1], 1.0, fy * by_k * X[1]
    return True


@kernel
def division_unproject(params, uv, bearing):
    """Unit bearing with (fx, fy, cx, cy, k)."""
    return _unproject(params[0], params[1], params[2], params[3], params[4], uv, bearing)


# ---------------------------------------------------------------------------------------------------------- Public

SIMPLE_DIVISION = register_camera(
    CameraModel("SIMPLE_DIVISION", ("f", "cx", "cy", "k"), (0,), (1, 2), (3,), "SIMPLE_DIVISION", sees_behind=True),
    simple_division_project,
    simple_division_project_jacobian,
    simple_division_unproject,
)
DIVISION = register_camera(
    CameraModel("DIVISION", ("fx", "fy", "cx", "cy", "k"), (0, 1), (2, 3), (4,), "DIVISION", sees_behind=True),
    division_project,
    division_project_jacobian,
    division_unproject,
)
