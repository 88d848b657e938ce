# SPDX-License-Identifier: BSD-3-Clause
r"""Equidistant fisheye with polynomial distortion: OPENCV_FISHEYE (fx, fy, cx, cy, k1, k2, k3, k4).

.. math::
    r = \sqrt{x^2 + y^2}, \quad \theta = \operatorname{atan2}(r, z), \quad
    \theta_d = \theta\,(1 + k_1\theta^2 + k_2\theta^4 + k_3\theta^6 + k_4\theta^8)

.. math:: (u, v) = (f_x\,\theta_d\,x/r + c_x,\ f_y\,\theta_d\,y/r + c_y)

Defined for every direction, those behind the image plane included, except straight backwards (r = 0, z < 0), where the
image of one direction is a whole circle. Names and parameter order are COLMAP's. Models with fewer parameters
(:mod:`groma.cameras.simple_fisheye`) call the kernels below with a tuple of the eight.

**Derivative.** With :math:`h = \theta_d / r` and :math:`\rho^2 = r^2 + z^2`,

.. math::
    \frac{\partial h}{\partial (x, y)} = \frac{1}{r^2}\Big(\frac{z\,\theta_d'}{\rho^2} - h\Big)\,(x, y), \qquad
    \frac{\partial h}{\partial z} = -\frac{\theta_d'}{\rho^2}

and on the axis :math:`h \to 1/z`, with a first factor of :math:`2 (k_1 - 1/3)/z^3`.

**Inverse.** A walk from :math:`\theta = 0` to :math:`\pi` stops where :math:`\theta_d` no longer grows, or has passed
the wanted value; a Newton iteration inside that last interval finishes.
"""

from __future__ import annotations

import math

from groma._numba import kernel
from groma.cameras.contract import CameraModel
from groma.cameras.pinhole import MAX_NORM, MIN_NORM, clear
from groma.cameras.registry import register_camera

# --------------------------------------------------------------------------------------------------------- Kernels

#: Directions with r below this part of |z| count as on the axis; the error is of the square of it.
ON_AXIS = 1e-10
#: Intervals from 0 to pi in which the walk looks for the wanted angle (cost: of a start value that Newton refines).
WALK_STEPS = 128


@kernel
def has_fisheye_image(X):
    """Whether the point is of representable size and not straight behind."""
    r = abs(X[0]) + abs(X[1])
    norm = r + abs(X[2])
    return MIN_NORM < norm < MAX_NORM and (X[2] > 0.0 or r > ON_AXIS * norm)


@kernel
def _distorted_angle(params, theta):
    s = theta * theta
    return theta * (1.0 + s * (params[4] + s * (params[5] + s * (params[6] + s * params[7]))))


@kernel
def _distorted_angle_slope(params, theta):
    s = theta * theta
    return 1.0 + s * (3.0 * params[4] + s * (5.0 * params[5] + s * (7.0 * params[6] + s * 9.0 * params[7])))


@kernel
def opencv_fisheye_project(params, X, uv):
    """Project with (fx, fy, cx, cy, k1, k2, k3, k4)."""
    if not has_fisheye_image(X):
        uv[:] = 0.0
        return False
    r = math.sqrt(X[0] * X[0] + X[1] * X[1])
    h = _distorted_angle(params, math.atan2(r, X[2])) / r if r > ON_AXIS * abs(X[2]) else 1.0 / X[2]
    uv[0], uv[1] = params[0] * h * X[0] + params[2], params[1] * h * X[1] + params[3]
    return True


@kernel
def fisheye_point_jacobian(params, X, uv, J_point):
    """Write pixel and point derivative; return h, theta^3 / r and theta^2, from which those by the parameters follow.

    The point must have an image.
    """
    fx, fy, x, y, z = params[0], params[1], X[0], X[1], X[2]
    squared = x * x + y * y
    r = math.sqrt(squared)
    if r > ON_AXIS * abs(z):
        theta = math.atan2(r, z)
        slope = _distorted_angle_slope(params, theta) / (squared + z * z)
        h = _distorted_angle(params, theta) / r
        gradient = (z * slope - h) / squared
        power = theta * theta * theta / r
        square = theta * theta
    else:
        h = 1.0 / z
        slope, gradient = h * h, 2.0 * (params[4] - 1.0 / 3.0) * h * h * h
        power = square = 0.0
    uv[0], uv[1] = fx * h * x + params[2], fy * h * y + params[3]
    J_point[0, 0], J_point[0, 1], J_point[0, 2] = fx * (h + gradient * x * x), fx * gradient * x * y, -fx * slope * x
    J_point[1, 0], J_point[1, 1], J_point[1, 2] = fy * gradient * x * y, fy * (h + gradient * y * y), -fy * slope * y
    return h, power, square


@kernel
def opencv_fisheye_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (fx, fy, cx, cy, k1, k2, k3, k4) and differentiate."""
    clear(uv, J_point, J_params)
    if not has_fisheye_image(X):
        return False
    h, power, square = fisheye_point_jacobian(params, X, uv, J_point)
    J_params[0, 0], J_params[0, 2] = h * X[0], 1.0
    J_params[1, 1], J_params[1, 3] = h * X[1], 1.0
    for j in range(4, 8):
        J_params[0, j], J_params[1, j] = params[0] * X[0] * power, params[1] * X[1] * power
        power *= square
    return True


@kernel
def _undistorted_angle(params, target):
    """Smallest theta in [0, pi) with the distorted angle ``target`` >= 0; -1 if theta_d stops growing before."""
    if target == 0.0:
        return 0.0
    low = high = 0.0
    for i in range(1, WALK_STEPS + 1):
        low, high = high, math.pi * i / WALK_STEPS
        growing = _distorted_angle_slope(params, high) > 0.0
        if growing and _distorted_angle(params, high) > target:
            break
        if not growing:
            # theta_d turns inside this interval: find where, and see whether it gets far enough before.
            left, right = low, high
            for _ in range(60):
                middle = 0.5 * (left + right)
                if _distorted_angle_slope(params, middle) > 0.0:
                    left = middle
                else:
                    right = middle
            high = left
            break
    if not _distorted_angle(params, high) > target:
        return -1.0
    theta = 0.5 * (low + high)
    for _ in range(128):
        error = _distorted_angle(params, theta) - target
        if error > 0.0:
            high = theta
        else:
            low = theta
        slope = _distorted_angle_slope(params, theta)
        moved = theta - error / slope if slope > 0.0 else low
        if not low < moved < high:
            moved = 0.5 * (low + high)
        converged = abs(moved - theta) <= 1e-15 * theta
        theta = moved
        if converged:
            break
    return theta if abs(_distorted_angle(params, theta) - target) <= 1e-12 * target else -1.0


@kernel
def opencv_fisheye_unproject(params, uv, bearing):
    """Unit bearing with (fx, fy, cx, cy, k1, k2, k3, k4)."""
    bearing[:] = 0.0
    if params[0] == 0.0 or params[1] == 0.0:
        return False
    x, y = (uv[0] - params[2]) / params[0], (uv[1] - params[3]) / params[1]
    target = math.sqrt(x * x + y * y)
    theta = _undistorted_angle(params, target)
    if theta < 0.0:
        return False
    scale = math.sin(theta) / target if target > 0.0 else 1.0
    bearing[0], bearing[1], bearing[2] = scale * x, scale * y, math.cos(theta)
    return True


# ---------------------------------------------------------------------------------------------------------- Public

OPENCV_FISHEYE = register_camera(
    CameraModel(
        "OPENCV_FISHEYE",
        ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
        (0, 1),
        (2, 3),
        (4, 5, 6, 7),
        "OPENCV_FISHEYE",
        sees_behind=True,
    ),
    opencv_fisheye_project,
    opencv_fisheye_project_jacobian,
    opencv_fisheye_unproject,
)
