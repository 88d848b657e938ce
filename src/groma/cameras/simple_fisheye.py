# SPDX-License-Identifier: BSD-3-Clause
r"""Equidistant fisheyes with fewer parameters than OPENCV_FISHEYE, whose kernels they call.

SIMPLE_FISHEYE (f, cx, cy) and FISHEYE (fx, fy, cx, cy) have no distortion, SIMPLE_RADIAL_FISHEYE (f, cx, cy, k) and
RADIAL_FISHEYE (f, cx, cy, k1, k2) have :math:`\theta_d = \theta\,(1 + k_1\theta^2 + k_2\theta^4)`; see
:mod:`groma.cameras.fisheye`. Names and parameter order are COLMAP's.
"""

from __future__ import annotations

from groma._numba import kernel
from groma.cameras.contract import CameraModel
from groma.cameras.fisheye import (
    fisheye_point_jacobian,
    has_fisheye_image,
    opencv_fisheye_project,
    opencv_fisheye_unproject,
)
from groma.cameras.pinhole import clear
from groma.cameras.registry import register_camera

# --------------------------------------------------------------------------------------------------------- Kernels


@kernel
def _eight(fx, fy, cx, cy, k1, k2):
    """Parameters as OPENCV_FISHEYE has them."""
    return fx, fy, cx, cy, k1, k2, 0.0, 0.0


@kernel
def simple_fisheye_project(params, X, uv):
    """Project with (f, cx, cy)."""
    return opencv_fisheye_project(_eight(params[0], params[0], params[1], params[2], 0.0, 0.0), X, uv)


@kernel
def simple_fisheye_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (f, cx, cy) and differentiate."""
    clear(uv, J_point, J_params)
    if not has_fisheye_image(X):
        return False
    eight = _eight(params[0], params[0], params[1], params[2], 0.0, 0.0)
    h, _, _ = fisheye_point_jacobian(eight, X, uv, J_point)
    J_params[0, 0], J_params[0, 1] = h * X[0], 1.0
    J_params[1, 0], J_params[1, 2] = h * X[1], 1.0
    return True


@kernel
def simple_fisheye_unproject(params, uv, bearing):
    """Unit bearing with (f, cx, cy)."""
    return opencv_fisheye_unproject(_eight(params[0], params[0], params[1], params[2], 0.0, 0.0), uv, bearing)


@kernel
def fisheye_project(params, X, uv):
    """Project with (fx, fy, cx, cy)."""
    return opencv_fisheye_project(_eight(params[0], params[1], params[2], params[3], 0.0, 0.0), X, uv)


@kernel
def fisheye_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (fx, fy, cx, cy) and differentiate."""
    clear(uv, J_point, J_params)
    if not has_fisheye_image(X):
        return False
    eight = _eight(params[0], params[1], params[2], params[3], 0.0, 0.0)
    h, _, _ = fisheye_point_jacobian(eight, X, uv, J_point)
    J_params[0, 0], J_params[0, 2] = h * X[0], 1.0
    J_params[1, 1], J_params[1, 3] = h * X[1], 1.0
    return True


@kernel
def fisheye_unproject(params, uv, bearing):
    """Unit bearing with (fx, fy, cx, cy)."""
    return opencv_fisheye_unproject(_eight(params[0], params[1], params[2], params[3], 0.0, 0.0), uv, bearing)


@kernel
def simple_radial_fisheye_project(params, X, uv):
    """Project with (f, cx, cy, k)."""
    return opencv_fisheye_project(_eight(params[0], params[0], params[1], params[2], params[3], 0.0), X, uv)


@kernel
def simple_radial_fisheye_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (f, cx, cy, k) and differentiate."""
    clear(uv, J_point, J_params)
    if not has_fisheye_image(X):
        return False
    f = params[0]
    h, power, _ = fisheye_point_jacobian(_eight(f, f, params[1], params[2], params[3], 0.0), X, uv, J_point)
    J_params[0, 0], J_params[0, 1], J_params[0, 3] = h * X[0], 1.0, f * X[0] * power
    J_params[1, 0], J_params[1, 2], J_params[1, 3] = h * X[1], 1.0, f * X[1] * power
    return True


@kernel
def simple_radial_fisheye_unproject(params, uv, bearing):
    """Unit bearing with (f, cx, cy, k)."""
    return opencv_fisheye_unproject(_eight(params[0], params[0], params[1], params[2], params[3], 0.0), uv, bearing)


@kernel
def radial_fisheye_project(params, X, uv):
    """Project with (f, cx, cy, k1, k2)."""
    return opencv_fisheye_project(_eight(params[0], params[0], params[1], params[2], params[3], params[4]), X, uv)


@kernel
def radial_fisheye_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (f, cx, cy, k1, k2) and differentiate."""
    clear(uv, J_point, J_params)
    if not has_fisheye_image(X):
        return False
    f = params[0]
    eight = _eight(f, f, params[1], params[2], params[3], params[4])
    h, power, square = fisheye_point_jacobian(eight, X, uv, J_point)
    J_params[0, 0], J_params[0, 1] = h * X[0], 1.0
    J_params[1, 0], J_params[1, 2] = h * X[1], 1.0
    J_params[0, 3], J_params[0, 4] = f * X[0] * power, f * X[0] * power * square
    J_params[1, 3], J_params[1, 4] = f * X[1] * power, f * X[1] * power * square
    return True


@kernel
def radial_fisheye_unproject(params, uv, bearing):
    """Unit bearing with (f, cx, cy, k1, k2)."""
    eight = _eight(params[0], params[0], params[1], params[2], params[3], params[4])
    return opencv_fisheye_unproject(eight, uv, bearing)


# ---------------------------------------------------------------------------------------------------------- Public

SIMPLE_FISHEYE = register_camera(
    CameraModel("SIMPLE_FISHEYE", ("f", "cx", "cy"), (0,), (1, 2), (), "SIMPLE_FISHEYE", sees_behind=True),
    simple_fisheye_project,
    simple_fisheye_project_jacobian,
    simple_fisheye_unproject,
)
FISHEYE = register_camera(
    CameraModel("FISHEYE", ("fx", "fy", "cx", "cy"), (0, 1), (2, 3), (), "FISHEYE", sees_behind=True),
    fisheye_project,
    fisheye_project_jacobian,
    fisheye_unproject,
)
SIMPLE_RADIAL_FISHEYE = register_camera(
    CameraModel(
        "SIMPLE_RADIAL_FISHEYE", ("f", "cx", "cy", "k"), (0,), (1, 2), (3,), "SIMPLE_RADIAL_FISHEYE", sees_behind=True
    ),
    simple_radial_fisheye_project,
    simple_radial_fisheye_project_jacobian,
    simple_radial_fisheye_unproject,
)
RADIAL_FISHEYE = register_camera(
    CameraModel(
        "RADIAL_FISHEYE", ("f", "cx", "cy", "k1", "k2"), (0,), (1, 2), (3, 4), "RADIAL_FISHEYE", sees_behind=True
    ),
    radial_fisheye_project,
    radial_fisheye_project_jacobian,
    radial_fisheye_unproject,
)
