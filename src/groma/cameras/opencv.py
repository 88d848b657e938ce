# SPDX-License-Identifier: BSD-3-Clause
r"""Radial and tangential distortion: OPENCV (8 parameters) and FULL_OPENCV (12 parameters).

.. math::
    s = x'^2 + y'^2, \quad g(s) = \frac{1 + k_1 s + k_2 s^2 + k_3 s^3}{1 + k_4 s + k_5 s^2 + k_6 s^3}

.. math::
    x_d = g\,x' + 2 p_1 x' y' + p_2 (s + 2 x'^2), \qquad y_d = g\,y' + 2 p_2 x' y' + p_1 (s + 2 y'^2)

.. math:: u = f_x x_d + c_x, \qquad v = f_y y_d + c_y

OPENCV has (fx, fy, cx, cy, k1, k2, p1, p2), with the other coefficients zero; FULL_OPENCV has (fx, fy, cx, cy, k1, k2,
p1, p2, k3, k4, k5, k6). Names and parameter order are COLMAP's.

**Inverse.** The derivative of :math:`(x_d, y_d)` by :math:`(x', y')` is a symmetric 2x2 matrix, the identity at the
centre; as long as it is positive definite the image does not fold. A walk outwards along the radius, tangential terms
left out, gives the start value. From there, Newton steps are halved until they lower the error and stay where the
matrix is positive definite. Unprojection refuses what this does not reach, and what lies beyond a fold: the matrix
must be positive definite all the way from the centre.
"""

from __future__ import annotations

import math

import numpy as np

from groma._numba import kernel
from groma.cameras.contract import CameraModel
from groma.cameras.pinhole import bearing_from_normalized, clear, has_depth
from groma.cameras.radial import write_point_jacobian
from groma.cameras.registry import register_camera

# --------------------------------------------------------------------------------------------------------- Kernels

#: The smallest denominator of FULL_OPENCV that is divided by.
MIN_DENOMINATOR = 1e-12
#: Steps of the walk to the start value; each moves by (1 + r) / 32, so they reach a radius of about 2600 (cost: of a
#: start value that Newton refines).
WALK_STEPS = 256


@kernel
def _distort(k1, k2, p1, p2, x, y):
    """Return x_d, y_d and their derivatives dxx, dxy = dyx, dyy by (x, y)."""
    s = x * x + y * y
    g = 1.0 + s * (k1 + s * k2)
    dg = 2.0 * (k1 + 2.0 * s * k2)
    xd = g * x + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
    yd = g * y + 2.0 * p2 * x * y + p1 * (s + 2.0 * y * y)
    dxx = g + dg * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    dxy = dg * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    dyy = g + dg * y * y + 2.0 * p2 * x + 6.0 * p1 * y
    return xd, yd, dxx, dxy, dyy


@kernel
def _denominator(params, s):
    return 1.0 + s * (params[9] + s * (params[10] + s * params[11]))


@kernel
def _numerator(params, s):
    return 1.0 + s * (params[4] + s * (params[5] + s * params[8]))


@kernel
def _ratio_slope(params, s, numerator, denominator):
    """Twice the derivative of numerator / denominator by s; its product with (x, y) is the gradient."""
    by_numerator = params[4] + s * (2.0 * params[5] + s * 3.0 * params[8])
    by_denominator = params[9] + s * (2.0 * params[10] + s * 3.0 * params[11])
    return 2.0 * (by_numerator - numerator / denominator * by_denominator) / denominator


@kernel
def _full_distort(params, x, y):
    """Like :func:`_distort`, for twelve parameters; the denominator must not be zero."""
    s = x * x + y * y
    p1, p2 = params[6], params[7]
    numerator, denominator = _numerator(params, s), _denominator(params, s)
    g = numerator / denominator
    dg = _ratio_slope(params, s, numerator, denominator)
    xd = g * x + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
    yd = g * y + 2.0 * p2 * x * y + p1 * (s + 2.0 * y * y)
    dxx = g + dg * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    dxy = dg * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    dyy = g + dg * y * y + 2.0 * p2 * x + 6.0 * p1 * y
    return xd, yd, dxx, dxy, dyy


@kernel
def _start_radius(params, target):
    """Radius whose distortion, tangential terms left out, reaches ``target``, or the last before it folds."""
    r, reached = 0.0, 0.0
    for _ in range(WALK_STEPS):
        following = r + (1.0 + r) / 32.0
        s = following * following
        numerator, denominator = _numerator(params, s), _denominator(params, s)
        if not denominator > MIN_DENOMINATOR:
            break
        g = numerator / denominator
        if not g + _ratio_slope(params, s, numerator, denominator) * s > 0.0:
            break
        value = g * following
        if value >= target:
            return r + (following - r) * (target - reached) / (value - reached)
        r, reached = following, value
    return r


@kernel
def _regular_from_centre(params, x, y):
    """Whether the image does not fold anywhere on the way from the centre to (x, y)."""
    radius = math.sqrt(x * x + y * y)
    r = 0.0
    while r < radius:
        r = min(r + (1.0 + r) / 32.0, radius)
        a, b = x * r / radius, y * r / radius
        if not _denominator(params, a * a + b * b) > MIN_DENOMINATOR:
            return False
        _, _, dxx, dxy, dyy = _full_distort(params, a, b)
        if not (dxx + dyy > 0.0 and dxx * dyy > dxy * dxy):
            return False
    return True


@kernel
def _undistort(params, target_x, target_y):
    """Return whether (x, y) with the given distorted coordinates was found, and x, y."""
    target = math.sqrt(target_x * target_x + target_y * target_y)
    if not target < math.inf:
        return False, 0.0, 0.0
    if target == 0.0:
        return True, 0.0, 0.0
    start = _start_radius(params, target) / target
    x, y = start * target_x, start * target_y
    xd, yd, dxx, dxy, dyy = _full_distort(params, x, y)
    if not (dxx + dyy > 0.0 and dxx * dyy > dxy * dxy):
        x, y = 0.0, 0.0
        xd, yd, dxx, dxy, dyy = _full_distort(params, x, y)
    ex, ey = xd - target_x, yd - target_y
    for _ in range(64):
        determinant = dxx * dyy - dxy * dxy
        step_x, step_y = (dyy * ex - dxy * ey) / determinant, (dxx * ey - dxy * ex) / determinant
        improved = False
        for _ in range(24):
            new_x, new_y = x - step_x, y - step_y
            if _denominator(params, new_x * new_x + new_y * new_y) > MIN_DENOMINATOR:
                xd, yd, new_dxx, new_dxy, new_dyy = _full_distort(params, new_x, new_y)
                new_ex, new_ey = xd - target_x, yd - target_y
                regular = new_dxx + new_dyy > 0.0 and new_dxx * new_dyy > new_dxy * new_dxy
                if regular and new_ex * new_ex + new_ey * new_ey < ex * ex + ey * ey:
                    x, y, ex, ey = new_x, new_y, new_ex, new_ey
                    dxx, dxy, dyy = new_dxx, new_dxy, new_dyy
                    improved = True
                    break
            step_x *= 0.5
            step_y *= 0.5
        if not improved:
            break
    found = math.sqrt(ex * ex + ey * ey) <= 1e-12 * (1.0 + target) and _regular_from_centre(params, x, y)
    return found, x, y


@kernel
def opencv_project(params, X, uv):
    """Project with (fx, fy, cx, cy, k1, k2, p1, p2)."""
    if not has_depth(X):
        uv[:] = 0.0
        return False
    xd, yd, _, _, _ = _distort(params[4], params[5], params[6], params[7], X[0] / X[2], X[1] / X[2])
    uv[0], uv[1] = params[0] * xd + params[2], params[1] * yd + params[3]
    return True


@kernel
def opencv_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (fx, fy, cx, cy, k1, k2, p1, p2) and differentiate."""
    if not has_depth(X):
        clear(uv, J_point, J_params)
        return False
    fx, fy = params[0], params[1]
    inverse = 1.0 / X[2]
    x, y = X[0] * inverse, X[1] * inverse
    xd, yd, dxx, dxy, dyy = _distort(params[4], params[5], params[6], params[7], x, y)
    uv[0], uv[1] = fx * xd + params[2], fy * yd + params[3]
    write_point_jacobian(fx, fy, x, y, inverse, dxx, dxy, dyy, J_point)
    s, xy = x * x + y * y, 2.0 * x * y
    J_params[0, 0], J_params[0, 1], J_params[0, 2], J_params[0, 3] = xd, 0.0, 1.0, 0.0
    J_params[1, 0], J_params[1, 1], J_params[1, 2], J_params[1, 3] = 0.0, yd, 0.0, 1.0
    J_params[0, 4], J_params[0, 5] = fx * s * x, fx * s * s * x
    J_params[1, 4], J_params[1, 5] = fy * s * y, fy * s * s * y
    J_params[0, 6], J_params[0, 7] = fx * xy, fx * (s + 2.0 * x * x)
    J_params[1, 6], J_params[1, 7] = fy * (s + 2.0 * y * y), fy * xy
    return True


@kernel
def full_opencv_project(params, X, uv):
    """Project with (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6)."""
    uv[:] = 0.0
    if not has_depth(X):
        return False
    x, y = X[0] / X[2], X[1] / X[2]
    if not abs(_denominator(params, x * x + y * y)) > MIN_DENOMINATOR:
        return False
    xd, yd, _, _, _ = _full_distort(params, x, y)
    uv[0], uv[1] = params[0] * xd + params[2], params[1] * yd + params[3]
    return True


@kernel
def full_opencv_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6) and differentiate."""
    clear(uv, J_point, J_params)
    if not has_depth(X):
        return False
    fx, fy = params[0], params[1]
    inverse = 1.0 / X[2]
    x, y = X[0] * inverse, X[1] * inverse
    s, xy = x * x + y * y, 2.0 * x * y
    numerator, denominator = _numerator(params, s), _denominator(params, s)
    if not abs(denominator) > MIN_DENOMINATOR:
        return False
    xd, yd, dxx, dxy, dyy = _full_distort(params, x, y)
    uv[0], uv[1] = fx * xd + params[2], fy * yd + params[3]
    write_point_jacobian(fx, fy, x, y, inverse, dxx, dxy, dyy, J_point)
    J_params[0, 0], J_params[0, 2] = xd, 1.0
    J_params[1, 1], J_params[1, 3] = yd, 1.0
    J_params[0, 6], J_params[0, 7] = fx * xy, fx * (s + 2.0 * x * x)
    J_params[1, 6], J_params[1, 7] = fy * (s + 2.0 * y * y), fy * xy
    above, below = s / denominator, -s * numerator / (denominator * denominator)
    J_params[0, 4], J_params[0, 5], J_params[0, 8] = fx * x * above, fx * x * above * s, fx * x * above * s * s
    J_params[1, 4], J_params[1, 5], J_params[1, 8] = fy * y * above, fy * y * above * s, fy * y * above * s * s
    J_params[0, 9], J_params[0, 10], J_params[0, 11] = fx * x * below, fx * x * below * s, fx * x * below * s * s
    J_params[1, 9], J_params[1, 10], J_params[1, 11] = fy * y * below, fy * y * below * s, fy * y * below * s * s
    return True


@kernel
def full_opencv_unproject(params, uv, bearing):
    """Unit bearing with (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6)."""
    bearing[:] = 0.0
    if params[0] == 0.0 or params[1] == 0.0:
        return False
    found, x, y = _undistort(params, (uv[0] - params[2]) / params[0], (uv[1] - params[3]) / params[1])
    return found and bearing_from_normalized(x, y, bearing)


@kernel
def opencv_unproject(params, uv, bearing):
    """Unit bearing with (fx, fy, cx, cy, k1, k2, p1, p2)."""
    full = np.zeros(12)
    for k in range(8):
        full[k] = params[k]
    return full_opencv_unproject(full, uv, bearing)


# ---------------------------------------------------------------------------------------------------------- Public

_EIGHT = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
OPENCV = register_camera(
    CameraModel("OPENCV", _EIGHT, (0, 1), (2, 3), (4, 5, 6, 7), "OPENCV"),
    opencv_project,
    opencv_project_jacobian,
    opencv_unproject,
)
FULL_OPENCV = register_camera(
    CameraModel("FULL_OPENCV", (*_EIGHT, "k3", "k4", "k5", "k6"), (0, 1), (2, 3), tuple(range(4, 12)), "FULL_OPENCV"),
    full_opencv_project,
    full_opencv_project_jacobian,
    full_opencv_unproject,
)
