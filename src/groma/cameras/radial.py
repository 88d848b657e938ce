# SPDX-License-Identifier: BSD-3-Clause
r"""Radial distortion: SIMPLE_RADIAL (f, cx, cy, k), RADIAL (f, cx, cy, k1, k2) and BAL (f, k1, k2).

.. math::
    x' = x/z, \quad y' = y/z, \quad s = x'^2 + y'^2, \quad
    (u, v) = f\,(1 + k_1 s + k_2 s^2)\,(x', y') + (c_x, c_y)

SIMPLE_RADIAL has :math:`k_2 = 0`; names and parameter order are COLMAP's. BAL, the model of the *Bundle Adjustment in
the Large* files, has no principal point. Its files let the camera look along -z with y up; here it looks along +z
with y down like every other model, and the reader of those files turns the axes.

**Inverse.** With :math:`r = \sqrt s` the distorted radius :math:`g(r) = r + k_1 r^3 + k_2 r^5` grows up to the first
zero of :math:`g' = 1 + 3 k_1 s + 5 k_2 s^2`, a quadratic in s. Below it, a Newton iteration kept inside a shrinking
bracket finds r for any coefficients; at and beyond it there is no unique bearing, and unprojection refuses.
"""

from __future__ import annotations

import math

from groma._numba import kernel
from groma.cameras.contract import CameraModel
from groma.cameras.pinhole import bearing_from_normalized, clear, has_depth
from groma.cameras.registry import register_camera

# --------------------------------------------------------------------------------------------------------- Kernels


@kernel
def write_point_jacobian(fx, fy, x, y, inverse, dxx, dxy, dyy, J_point):
    """Chain focal lengths, the symmetric derivative of the distortion at (x, y), and the division by depth."""
    J_point[0, 0], J_point[0, 1], J_point[0, 2] = (
        fx * dxx * inverse,
        fx * dxy * inverse,
        -fx * (dxx * x + dxy * y) * inverse,
    )
    J_point[1, 0], J_point[1, 1], J_point[1, 2] = (
        fy * dxy * inverse,
        fy * dyy * inverse,
        -fy * (dxy * x + dyy * y) * inverse,
    )


@kernel
def _project(f, cx, cy, k1, k2, X, uv):
    if not has_depth(X):
        uv[:] = 0.0
        return False
    x, y = X[0] / X[2], X[1] / X[2]
    s = x * x + y * y
    scale = f * (1.0 + s * (k1 + s * k2))
    uv[0], uv[1] = scale * x + cx, scale * y + cy
    return True


@kernel
def _project_jacobian(f, cx, cy, k1, k2, X, uv, J_point):
    """Write pixel and point derivative; return x', y' and s, from which the derivatives by the parameters follow."""
    inverse = 1.0 / X[2]
    x, y = X[0] * inverse, X[1] * inverse
    s = x * x + y * y
    g = 1.0 + s * (k1 + s * k2)
    dg = 2.0 * (k1 + 2.0 * k2 * s)
    uv[0], uv[1] = f * g * x + cx, f * g * y + cy
    write_point_jacobian(f, f, x, y, inverse, g + dg * x * x, dg * x * y, g + dg * y * y, J_point)
    return x, y, s


@kernel
def radial_limit(k1, k2):
    """Radius of the first zero of 1 + 3 k1 r^2 + 5 k2 r^4; infinity if it stays positive."""
    discriminant = 9.0 * k1 * k1 - 20.0 * k2
    if not discriminant > 0.0:
        return math.inf
    root = math.sqrt(discriminant)
    q = -0.5 * (3.0 * k1 + (root if k1 >= 0.0 else -root))
    smallest = math.inf
    if q > 0.0:
        smallest = 1.0 / q
    if k2 != 0.0 and q / (5.0 * k2) > 0.0:  # derived from the derivative of k2 r^5
        smallest = min(smallest, q / (5.0 * k2))
    return math.sqrt(smallest)


@kernel
def radial_inverse(k1, k2, target):
    """Smallest r >= 0 with r + k1 r^3 + k2 r^5 = target >= 0; -1 if target is at or beyond the monotone range."""
    if target == 0.0:
        return 0.0
    if not target < math.inf:
        return -1.0
    low, high = 0.0, radial_limit(k1, k2)
    if high < math.inf:
        s = high * high
        if not high * (1.0 + s * (k1 + s * k2)) > target:
            return -1.0
    else:
        high = target
        for _ in range(64):
            s = high * high
            if high * (1.0 + s * (k1 + s * k2)) >= target:
                break
            high *= 2.0
    r = min(target, 0.5 * high)
    for _ in range(128):
        s = r * r
        error = r * (1.0 + s * (k1 + s * k2)) - target
        if error > 0.0:
            high = r
        else:
            low = r
        slope = 1.0 + s * (3.0 * k1 + s * 5.0 * k2)
        moved = r - error / slope if slope > 0.0 else low
        if not low < moved < high:
            moved = 0.5 * (low + high)
        converged = abs(moved - r) <= 1e-15 * r
        r = moved
        if converged:
            break
    s = r * r
    return r if abs(r * (1.0 + s * (k1 + s * k2)) - target) <= 1e-12 * target else -1.0


@kernel
def _unproject(f, cx, cy, k1, k2, uv, bearing):
    if f == 0.0:
        bearing[:] = 0.0
        return False
    x, y = (uv[0] - cx) / f, (uv[1] - cy) / f
    target = math.sqrt(x * x + y * y)
    r = radial_inverse(k1, k2, target)
    if r < 0.0:
        bearing[:] = 0.0
        return False
    scale = r / target if target > 0.0 else 1.0
    return bearing_from_normalized(scale * x, scale * y, bearing)


@kernel
def simple_radial_project(params, X, uv):
    """Project with (f, cx, cy, k)."""
    return _project(params[0], params[1], params[2], params[3], 0.0, X, uv)


@kernel
def simple_radial_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (f, cx, cy, k) and differentiate."""
    if not has_depth(X):
        clear(uv, J_point, J_params)
        return False
    f, k = params[0], params[3]
    x, y, s = _project_jacobian(f, params[1], params[2], k, 0.0, X, uv, J_point)
    g = 1.0 + k * s
    J_params[0, 0], J_params[0, 1], J_params[0, 2], J_params[0, 3] = g * x, 1.0, 0.0, f * s * x
    J_params[1, 0], J_params[1, 1], J_params[1, 2], J_params[1, 3] = g * y, 0.0, 1.0, f * s * y
    return True


@kernel
def simple_radial_unproject(params, uv, bearing):
    """Unit bearing with (f, cx, cy, k)."""
    return _unproject(params[0], params[1], params[2], params[3], 0.0, uv, bearing)


@kernel
def radial_project(params, X, uv):
    """Project with (f, cx, cy, k1, k2)."""
    return _project(params[0], params[1], params[2], params[3], params[4], X, uv)


@kernel
def radial_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (f, cx, cy, k1, k2) and differentiate."""
    if not has_depth(X):
        clear(uv, J_point, J_params)
        return False
    f = params[0]
    x, y, s = _project_jacobian(f, params[1], params[2], params[3], params[4], X, uv, J_point)
    g = 1.0 + s * (params[3] + s * params[4])
    J_params[0, 0], J_params[0, 1], J_params[0, 2] = g * x, 1.0, 0.0
    J_params[0, 3], J_params[0, 4] = f * s * x, f * s * s * x
    J_params[1, 0], J_params[1, 1], J_params[1, 2] = g * y, 0.0, 1.0
    J_params[1, 3], J_params[1, 4] = f * s * y, f * s * s * y
    return True


@kernel
def radial_unproject(params, uv, bearing):
    """Unit bearing with (f, cx, cy, k1, k2)."""
    return _unproject(params[0], params[1], params[2], params[3], params[4], uv, bearing)


@kernel
def bal_project(params, X, uv):
    """Project with (f, k1, k2)."""
    return _project(params[0], 0.0, 0.0, params[1], params[2], X, uv)


@kernel
def bal_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (f, k1, k2) and differentiate."""
    if not has_depth(X):
        clear(uv, J_point, J_params)
        return False
    f = params[0]
    x, y, s = _project_jacobian(f, 0.0, 0.0, params[1], params[2], X, uv, J_point)
    g = 1.0 + s * (params[1] + s * params[2])
    J_params[0, 0], J_params[0, 1], J_params[0, 2] = g * x, f * s * x, f * s * s * x
    J_params[1, 0], J_params[1, 1], J_params[1, 2] = g * y, f * s * y, f * s * s * y
    return True


@kernel
def bal_unproject(params, uv, bearing):
    """Unit bearing with (f, k1, k2)."""
    return _unproject(params[0], 0.0, 0.0, params[1], params[2], uv, bearing)


# ---------------------------------------------------------------------------------------------------------- Public

SIMPLE_RADIAL = register_camera(
    CameraModel("SIMPLE_RADIAL", ("f", "cx", "cy", "k"), (0,), (1, 2), (3,), "SIMPLE_RADIAL"),
    simple_radial_project,
    simple_radial_project_jacobian,
    simple_radial_unproject,
)
RADIAL = register_camera(
    CameraModel("RADIAL", ("f", "cx", "cy", "k1", "k2"), (0,), (1, 2), (3, 4), "RADIAL"),
    radial_project,
    radial_project_jacobian,
    radial_unproject,
)
BAL = register_camera(
    CameraModel("BAL", ("f", "k1", "k2"), (0,), (), (1, 2), None), bal_project, bal_project_jacobian, bal_unproject
)
