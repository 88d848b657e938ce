# SPDX-License-Identifier: BSD-3-Clause
r"""A camera model: the field-of-view lens, COLMAP's FOV (fx, fy, cx, cy, omega).

.. math:: r_d = \frac{1}{\omega} \arctan(2 r \tan\tfrac{\omega}{2}), \qquad (u, v) = (f_x x, f_y y)\,\frac{r_d}{r} + c

with (x, y) = (X, Y) / Z and r their distance from the axis.

Reference: F. Devernay, O. Faugeras, *Straight lines have to be straight*, 2001.
"""

import math

from groma.cameras import CameraModel, register_camera
from groma.compiled import kernel

MIN_DEPTH, MIN_OMEGA, MAX_NORM = 1e-12, 1e-3, 1e140


@kernel
def stretch(r2, omega, out):
    """Write r_d / r and its derivatives by r² and by omega."""
    t = 2.0 * math.tan(0.5 * omega)
    t_omega = 1.0 + 0.25 * t * t
    q = r2 * t * t
    if q < 1e-4:  # the series of arctan
        out[0] = t / omega * (1.0 - q / 3.0 + q * q / 5.0)
        out[1] = t * t * t / omega * (-1.0 / 3.0 + 0.4 * q - 3.0 / 7.0 * q * q)
        out[2] = t_omega / omega * (1.0 - q + q * q) - out[0] / omega
        return
    r = math.sqrt(r2)
    out[0] = math.atan(r * t) / (r * omega)
    out[1] = 0.5 * (t / (omega * (1.0 + q)) - out[0]) / r2
    out[2] = t_omega / (omega * (1.0 + q)) - out[0] / omega


@kernel
def has_image(params, X):
    """Whether a point projects: not in the camera plane, of a size that can be squared."""
    norm = abs(X[0]) + abs(X[1]) + abs(X[2])
    return 1.0 / MAX_NORM < norm < MAX_NORM and abs(X[2]) > MIN_DEPTH * norm and abs(params[4]) > MIN_OMEGA


@kernel
def fov_project(params, X, uv):
    if not has_image(params, X):
        uv[:] = 0.0
        return False
    x, y = X[0] / X[2], X[1] / X[2]
    r2, t = x * x + y * y, 2.0 * math.tan(0.5 * params[4])
    q = r2 * t * t
    if q < 1e-4:
        scale = t / params[4] * (1.0 - q / 3.0 + q * q / 5.0)
    else:
        scale = math.atan(math.sqrt(q)) / (math.sqrt(r2) * params[4])
    uv[0], uv[1] = params[0] * x * scale + params[2], params[1] * y * scale + params[3]
    return True


@kernel
def fov_project_jacobian(params, X, uv, J_point, J_params):
    if not has_image(params, X):
        uv[:] = 0.0
        J_point[:, :] = 0.0
        J_params[:, :] = 0.0
        return False
    inverse = 1.0 / X[2]
    x, y = X[0] * inverse, X[1] * inverse
    # J_params takes what `stretch` writes until its own numbers are known.
    stretch(x * x + y * y, params[4], J_params[0])
    scale, by_r2, by_omega = J_params[0, 0], J_params[0, 1], J_params[0, 2]
    fx, fy = params[0], params[1]
    uv[0], uv[1] = fx * x * scale + params[2], fy * y * scale + params[3]
    u_x, u_y = fx * (scale + 2.0 * x * x * by_r2), fx * 2.0 * x * y * by_r2
    v_x, v_y = fy * 2.0 * x * y * by_r2, fy * (scale + 2.0 * y * y * by_r2)
    J_point[0, 0], J_point[0, 1], J_point[0, 2] = u_x * inverse, u_y * inverse, -(u_x * x + u_y * y) * inverse
    J_point[1, 0], J_point[1, 1], J_point[1, 2] = v_x * inverse, v_y * inverse, -(v_x * x + v_y * y) * inverse
    J_params[:, :] = 0.0
    J_params[0, 0], J_params[0, 2], J_params[0, 4] = x * scale, 1.0, fx * x * by_omega
    J_params[1, 1], J_params[1, 3], J_params[1, 4] = y * scale, 1.0, fy * y * by_omega
    return True


@kernel
def fov_unproject(params, uv, bearing):
    bearing[:] = 0.0
    if params[0] == 0.0 or params[1] == 0.0 or not abs(params[4]) > MIN_OMEGA:
        return False
    x, y, omega = (uv[0] - params[2]) / params[0], (uv[1] - params[3]) / params[1], params[4]
    r = math.sqrt(x * x + y * y)
    if not abs(r * omega) < 0.5 * math.pi:
        return False
    t = 2.0 * math.tan(0.5 * omega)
    scale = math.tan(r * omega) / (t * r) if r > 0.0 else omega / t
    x, y = scale * x, scale * y
    norm = math.sqrt(x * x + y * y + 1.0)
    bearing[0], bearing[1], bearing[2] = x / norm, y / norm, 1.0 / norm
    return True


FOV = register_camera(
    CameraModel("FOV", ("fx", "fy", "cx", "cy", "omega"), (0, 1), (2, 3), (4,), "FOV"),
    fov_project,
    fov_project_jacobian,
    fov_unproject,
)
