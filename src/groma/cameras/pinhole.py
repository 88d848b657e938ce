# SPDX-License-Identifier: BSD-3-Clause
r"""Pinhole cameras without distortion: SIMPLE_PINHOLE (f, cx, cy) and PINHOLE (fx, fy, cx, cy).

.. math:: u = f_x\, x/z + c_x, \qquad v = f_y\, y/z + c_y

Names and parameter order are COLMAP's.
"""

from __future__ import annotations

import math

from groma._numba import kernel
from groma.cameras.contract import CameraModel
from groma.cameras.registry import register_camera

# --------------------------------------------------------------------------------------------------------- Kernels

#: A point projects if |z| is more than this part of |x| + |y| + |z|.
MIN_DEPTH = 1e-12
#: Points nearer or farther than this are refused: squares and inverses of their coordinates leave the number range.
MIN_NORM, MAX_NORM = 1e-140, 1e140


@kernel
def has_depth(X):
    """Whether a perspective camera can project ``X`` (3,): of representable size, and not in the plane z = 0."""
    norm = abs(X[0]) + abs(X[1]) + abs(X[2])
    return MIN_NORM < norm < MAX_NORM and abs(X[2]) > MIN_DEPTH * norm


@kernel
def clear(uv, J_point, J_params):
    """Write zeros, for a point that has no image."""
    uv[:] = 0.0
    J_point[:, :] = 0.0
    J_params[:, :] = 0.0


@kernel
def bearing_from_normalized(x, y, bearing):
    """Write the unit vector along (x, y, 1); False and zeros if it is not finite."""
    squared = x * x + y * y + 1.0
    if not squared < math.inf:
        bearing[:] = 0.0
        return False
    scale = 1.0 / math.sqrt(squared)
    bearing[0], bearing[1], bearing[2] = scale * x, scale * y, scale
    return True


@kernel
def simple_pinhole_project(params, X, uv):
    """Project with (f, cx, cy)."""
    if not has_depth(X):
        uv[:] = 0.0
        return False
    uv[0] = params[0] * X[0] / X[2] + params[1]
    uv[1] = params[0] * X[1] / X[2] + params[2]
    return True


@kernel
def simple_pinhole_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (f, cx, cy) and differentiate."""
    if not has_depth(X):
        clear(uv, J_point, J_params)
        return False
    inverse = 1.0 / X[2]
    x, y, f = X[0] * inverse, X[1] * inverse, params[0]
    uv[0], uv[1] = f * x + params[1], f * y + params[2]
    J_point[0, 0], J_point[0, 1], J_point[0, 2] = f * inverse, 0.0, -f * x * inverse
    J_point[1, 0], J_point[1, 1], J_point[1, 2] = 0.0, f * inverse, -f * y * inverse
    J_params[0, 0], J_params[0, 1], J_params[0, 2] = x, 1.0, 0.0
    J_params[1, 0], J_params[1, 1], J_params[1, 2] = y, 0.0, 1.0
    return True


@kernel
def simple_pinhole_unproject(params, uv, bearing):
    """Unit bearing with (f, cx, cy)."""
    if params[0] == 0.0:
        bearing[:] = 0.0
        return False
    return bearing_from_normalized((uv[0] - params[1]) / params[0], (uv[1] - params[2]) / params[0], bearing)


@kernel
def simple_pinhole_parameters(params, K):
    """Write fx, fy, cx, cy of (f, cx, cy)."""
    K[0], K[1], K[2], K[3] = params[0], params[0], params[1], params[2]


@kernel
def simple_pinhole_parameters_jacobian(params, J):
    """Derivative (4, 3) of fx, fy, cx, cy by (f, cx, cy)."""
    J[:, :] = 0.0
    J[0, 0] = J[1, 0] = J[2, 1] = J[3, 2] = 1.0


@kernel
def pinhole_project(params, X, uv):
    """Project with (fx, fy, cx, cy)."""
    if not has_depth(X):
        uv[:] = 0.0
        return False
    uv[0] = params[0] * X[0] / X[2] + params[2]
    uv[1] = params[1] * X[1] / X[2] + params[3]
    return True


@kernel
def pinhole_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (fx, fy, cx, cy) and differentiate."""
    if not has_depth(X):
        clear(uv, J_point, J_params)
        return False
    inverse = 1.0 / X[2]
    x, y, fx, fy = X[0] * inverse, X[1] * inverse, params[0], params[1]
    uv[0], uv[1] = fx * x + params[2], fy * y + params[3]
    J_point[0, 0], J_point[0, 1], J_point[0, 2] = fx * inverse, 0.0, -fx * x * inverse
    J_point[1, 0], J_point[1, 1], J_point[1, 2] = 0.0, fy * inverse, -fy * y * inverse
    J_params[0, 0], J_params[0, 1], J_params[0, 2], J_params[0, 3] = x, 0.0, 1.0, 0.0
    J_params[1, 0], J_params[1, 1], J_params[1, 2], J_params[1, 3] = 0.0, y, 0.0, 1.0
    return True


@kernel
def pinhole_unproject(params, uv, bearing):
    """Unit bearing with (fx, fy, cx, cy)."""
    if params[0] == 0.0 or params[1] == 0.0:
        bearing[:] = 0.0
        return False
    return bearing_from_normalized((uv[0] - params[2]) / params[0], (uv[1] - params[3]) / params[1], bearing)


@kernel
def pinhole_parameters(params, K):
    """Write fx, fy, cx, cy."""
    K[0], K[1], K[2], K[3] = params[0], params[1], params[2], params[3]


@kernel
def pinhole_parameters_jacobian(params, J):
    """Derivative (4, 4) of fx, fy, cx, cy by themselves."""
    J[:, :] = 0.0
    J[0, 0] = J[1, 1] = J[2, 2] = J[3, 3] = 1.0


# ---------------------------------------------------------------------------------------------------------- Public

SIMPLE_PINHOLE = register_camera(
    CameraModel("SIMPLE_PINHOLE", ("f", "cx", "cy"), (0,), (1, 2), (), "SIMPLE_PINHOLE"),
    simple_pinhole_project,
    simple_pinhole_project_jacobian,
    simple_pinhole_unproject,
    simple_pinhole_parameters,
    simple_pinhole_parameters_jacobian,
)
PINHOLE = register_camera(
    CameraModel("PINHOLE", ("fx", "fy", "cx", "cy"), (0, 1), (2, 3), (), "PINHOLE"),
    pinhole_project,
    pinhole_project_jacobian,
    pinhole_unproject,
    pinhole_parameters,
    pinhole_parameters_jacobian,
)
