# SPDX-License-Identifier: BSD-3-Clause
r"""The enhanced unified camera model of wide lenses and mirrors: EUCM (fx, fy, cx, cy, alpha, beta).

.. math::
    d = \sqrt{\beta\,(x^2 + y^2) + z^2}, \qquad n = \alpha d + (1 - \alpha) z, \qquad
    (u, v) = (f_x\, x/n + c_x,\ f_y\, y/n + c_y)

:math:`\alpha = 0` is a pinhole camera. A direction has an image where n is positive and the radius of the image still
grows with the angle, :math:`\alpha z/d + 1 - \alpha > 0`; for :math:`0 < \alpha < 1` these are more than all directions
in front. Name and parameter order are COLMAP's, which gives images to points in front only.

**Inverse.** With :math:`a = (u - c_x)/f_x`, :math:`b = (v - c_y)/f_y`, :math:`s = a^2 + b^2`, the ray is

.. math:: (x, y, z) \sim \Big(a,\; b,\;
          \frac{1 - \alpha^2 \beta s}{\alpha \sqrt{1 - (2\alpha - 1) \beta s} + 1 - \alpha}\Big)

Source: Khomutenko, Garcia and Martinet, *An enhanced unified camera model*, 2016, eq. (9), (13).
"""

from __future__ import annotations

import math

from groma._numba import kernel
from groma.cameras.contract import CameraModel
from groma.cameras.pinhole import MAX_NORM, MIN_DEPTH, MIN_NORM, clear
from groma.cameras.registry import register_camera

# --------------------------------------------------------------------------------------------------------- Kernels


@kernel
def _distances(params, X):
    """Return d and n; n is zero if the point has no image."""
    alpha, squared, z = params[4], X[0] * X[0] + X[1] * X[1], X[2]
    norm = abs(X[0]) + abs(X[1]) + abs(z)
    inside = params[5] * squared + z * z
    if not (MIN_NORM < norm < MAX_NORM and inside > MIN_DEPTH * MIN_DEPTH * norm * norm and inside < math.inf):
        return 1.0, 0.0
    d = math.sqrt(inside)
    n = alpha * d + (1.0 - alpha) * z
    if not (n > MIN_DEPTH * norm and alpha * z + (1.0 - alpha) * d > MIN_DEPTH * d):
        return d, 0.0
    return d, n


@kernel
def eucm_project(params, X, uv):
    """Project with (fx, fy, cx, cy, alpha, beta)."""
    _, n = _distances(params, X)
    if n == 0.0:
        uv[:] = 0.0
        return False
    uv[0], uv[1] = params[0] * X[0] / n + params[2], params[1] * X[1] / n + params[3]
    return True


@kernel
def eucm_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (fx, fy, cx, cy, alpha, beta) and differentiate."""
    clear(uv, J_point, J_params)
    d, n = _distances(params, X)
    if n == 0.0:
        return False
    fx, fy, alpha, beta = params[0], params[1], params[4], params[5]
    a, b = X[0] / n, X[1] / n
    uv[0], uv[1] = fx * a + params[2], fy * b + params[3]
    by_side = alpha * beta / d
    nx, ny, nz = by_side * X[0], by_side * X[1], alpha * X[2] / d + 1.0 - alpha
    J_point[0, 0], J_point[0, 1], J_point[0, 2] = fx * (1.0 - a * nx) / n, -fx * a * ny / n, -fx * a * nz / n
    J_point[1, 0], J_point[1, 1], J_point[1, 2] = -fy * b * nx / n, fy * (1.0 - b * ny) / n, -fy * b * nz / n
    by_alpha, by_beta = (d - X[2]) / n, 0.5 * alpha * (X[0] * X[0] + X[1] * X[1]) / (d * n)
    J_params[0, 0], J_params[0, 2], J_params[0, 4], J_params[0, 5] = a, 1.0, -fx * a * by_alpha, -fx * a * by_beta
    J_params[1, 1], J_params[1, 3], J_params[1, 4], J_params[1, 5] = b, 1.0, -fy * b * by_alpha, -fy * b * by_beta
    return True


@kernel
def eucm_unproject(params, uv, bearing):
    """Unit bearing with (fx, fy, cx, cy, alpha, beta)."""
    bearing[:] = 0.0
    if params[0] == 0.0 or params[1] == 0.0:
        return False
    alpha, beta = params[4], params[5]
    a, b = (uv[0] - params[2]) / params[0], (uv[1] - params[3]) / params[1]
    s = a * a + b * b
    inside = 1.0 - (2.0 * alpha - 1.0) * beta * s
    if not 0.0 <= inside < math.inf:
        return False
    below = alpha * math.sqrt(inside) + 1.0 - alpha
    if not below > MIN_DEPTH:
        return False
    z = (1.0 - alpha * alpha * beta * s) / below
    norm = math.sqrt(s + z * z)
    bearing[0], bearing[1], bearing[2] = a / norm, b / norm, z / norm
    _, n = _distances(params, bearing)
    if n == 0.0 or not norm < math.inf:
        bearing[:] = 0.0
        return False
    return True


# ---------------------------------------------------------------------------------------------------------- Public

EUCM = register_camera(
    CameraModel("EUCM", ("fx", "fy", "cx", "cy", "alpha", "beta"), (0, 1), (2, 3), (4, 5), "EUCM", sees_behind=True),
    eucm_project,
    eucm_project_jacobian,
    eucm_unproject,
)
