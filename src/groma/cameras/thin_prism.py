# SPDX-License-Identifier: BSD-3-Clause
r"""Fisheyes with radial, tangential and thin-prism distortion: THIN_PRISM_FISHEYE and RAD_TAN_THIN_PRISM_FISHEYE.

With :math:`r = \sqrt{x^2 + y^2}`, :math:`\theta = \operatorname{atan2}(r, z)` and
:math:`(a, b) = \theta\,(x, y)/r`, the distorted angles are

.. math::
    (a', b') = g(a^2 + b^2)\,(a, b) + T(e, f), \qquad g(s) = 1 + k_0 s + k_1 s^2 + \dots + k_5 s^6

.. math::
    T(e, f) = \begin{pmatrix}
        2 t_1 e f + t_0 (q + 2 e^2) + s_0 q + s_1 q^2 \\ 2 t_0 e f + t_1 (q + 2 f^2) + s_2 q + s_3 q^2
    \end{pmatrix}, \qquad q = e^2 + f^2

.. math:: (u, v) = (f_x\,a' + c_x,\ f_y\,b' + c_y)

RAD_TAN_THIN_PRISM_FISHEYE (16 parameters; Project Aria's Fisheye624) has :math:`(e, f) = g\,(a, b)` and all of the
coefficients. THIN_PRISM_FISHEYE (12 parameters) has :math:`(e, f) = (a, b)`, four radial coefficients, and
:math:`t_0 = p_2, t_1 = p_1, s_0 = s_{x1}, s_2 = s_{y1}`. Names and parameter order are COLMAP's. Like the other
fisheyes, they are defined for every direction but straight backwards.

**Inverse.** :math:`(a, b)` is followed by Newton's method while the distorted angles move from the centre of the image
to the wanted ones, in steps that become shorter where needed. The determinant of the derivative must stay positive on
the way: at the first fold of the image unprojection refuses.
"""

from __future__ import annotations

import math

from groma._numba import kernel
from groma.cameras.contract import CameraModel
from groma.cameras.fisheye import fisheye_point_jacobian, has_fisheye_image, opencv_fisheye_project
from groma.cameras.pinhole import clear
from groma.cameras.registry import register_camera

# --------------------------------------------------------------------------------------------------------- Kernels

#: The equidistant projection to angles, as OPENCV_FISHEYE's parameters.
_TO_ANGLES = (1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
#: Columns of k0 ... k5, t0, t1, s0 ... s3 among the parameters; -1 where the model has no such coefficient. The format
#: of COLMAP.
_THIN_PRISM_COLUMNS = (4, 5, 8, 9, -1, -1, 7, 6, 10, -1, 11, -1)
#: The format of COLMAP: columns of the same.
_RAD_TAN_COLUMNS = (4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
#: Longest step of the undistorted angles on the way from the centre, radians, and the shortest part of the way (cost:
#: shorter ones reach the same angles).
LONGEST_STEP, SHORTEST_PART = 0.1, 1e-6


@kernel
def _thin_prism(params):
    """THIN_PRISM_FISHEYE's parameters in the order of RAD_TAN_THIN_PRISM_FISHEYE."""
    return (
        params[0], params[1], params[2], params[3], params[4], params[5], params[8], params[9], 0.0, 0.0,
        params[7], params[6], params[10], 0.0, params[11], 0.0,
    )  # fmt: skip


@kernel
def _bend(c, e, f):
    """Return T(e, f), two numbers, and its derivatives Txx, Txy, Tyx, Tyy."""
    q = e * e + f * f
    across, down = c[12] + 2.0 * c[13] * q, c[14] + 2.0 * c[15] * q
    return (
        2.0 * c[11] * e * f + c[10] * (q + 2.0 * e * e) + q * (c[12] + c[13] * q),
        2.0 * c[10] * e * f + c[11] * (q + 2.0 * f * f) + q * (c[14] + c[15] * q),
        2.0 * (c[11] * f + 3.0 * c[10] * e + across * e),
        2.0 * (c[11] * e + c[10] * f + across * f),
        2.0 * (c[10] * f + c[11] * e + down * e),
        2.0 * (c[10] * e + 3.0 * c[11] * f + down * f),
    )


@kernel
def _radial_factor(c, s):
    """Return g(s) and twice its derivative."""
    g = 1.0 + s * (c[4] + s * (c[5] + s * (c[6] + s * (c[7] + s * (c[8] + s * c[9])))))
    slope = c[4] + s * (2.0 * c[5] + s * (3.0 * c[6] + s * (4.0 * c[7] + s * (5.0 * c[8] + s * 6.0 * c[9]))))
    return g, 2.0 * slope


@kernel
def _distort(c, nested, a, b):
    """Return a', b' and their derivatives dxx, dxy, dyx, dyy by (a, b)."""
    g, dg = _radial_factor(c, a * a + b * b)
    gxx, gxy, gyy = g + dg * a * a, dg * a * b, g + dg * b * b
    if nested:
        bent_x, bent_y, txx, txy, tyx, tyy = _bend(c, g * a, g * b)
        txx, txy, tyx, tyy = (
            txx * gxx + txy * gxy, txx * gxy + txy * gyy, tyx * gxx + tyy * gxy, tyx * gxy + tyy * gyy,
        )  # fmt: skip
    else:
        bent_x, bent_y, txx, txy, tyx, tyy = _bend(c, a, b)
    return g * a + bent_x, g * b + bent_y, gxx + txx, gxy + txy, gxy + tyx, gyy + tyy


@kernel
def _project(c, nested, X, uv):
    if not opencv_fisheye_project(_TO_ANGLES, X, uv):
        return False
    a, b, _, _, _, _ = _distort(c, nested, uv[0], uv[1])
    uv[0], uv[1] = c[0] * a + c[2], c[1] * b + c[3]
    return True


@kernel
def _project_jacobian(c, nested, columns, X, uv, J_point, J_params):
    clear(uv, J_point, J_params)
    if not has_fisheye_image(X):
        return False
    fisheye_point_jacobian(_TO_ANGLES, X, uv, J_point)
    a, b, fx, fy = uv[0], uv[1], c[0], c[1]
    x, y, dxx, dxy, dyx, dyy = _distort(c, nested, a, b)
    uv[0], uv[1] = fx * x + c[2], fy * y + c[3]
    for j in range(3):
        p, q = J_point[0, j], J_point[1, j]
        J_point[0, j], J_point[1, j] = fx * (dxx * p + dxy * q), fy * (dyx * p + dyy * q)
    J_params[0, 0], J_params[0, 2], J_params[1, 1], J_params[1, 3] = x, 1.0, y, 1.0
    s = a * a + b * b
    e, f, along_x, along_y = a, b, a, b
    if nested:
        g, _ = _radial_factor(c, s)
        e, f = g * a, g * b
        _, _, txx, txy, tyx, tyy = _bend(c, e, f)
        along_x, along_y = a + txx * a + txy * b, b + tyx * a + tyy * b
    power = 1.0
    for j in range(6):
        power *= s
        if columns[j] >= 0:
            J_params[0, columns[j]], J_params[1, columns[j]] = fx * along_x * power, fy * along_y * power
    q = e * e + f * f
    J_params[0, columns[6]], J_params[1, columns[6]] = fx * (q + 2.0 * e * e), fy * 2.0 * e * f
    J_params[0, columns[7]], J_params[1, columns[7]] = fx * 2.0 * e * f, fy * (q + 2.0 * f * f)
    J_params[0, columns[8]], J_params[1, columns[10]] = fx * q, fy * q
    if columns[9] >= 0:
        J_params[0, columns[9]], J_params[1, columns[11]] = fx * q * q, fy * q * q
    return True


@kernel
def _newton(c, nested, target_x, target_y, a, b):
    """Return whether (a, b) with the given distorted angles was found near the start, without a fold, and a, b."""
    start_a, start_b = a, b
    for _ in range(20):
        x, y, dxx, dxy, dyx, dyy = _distort(c, nested, a, b)
        determinant = dxx * dyy - dxy * dyx
        if not determinant > 0.0:
            return False, a, b
        error_x, error_y = x - target_x, y - target_y
        step_a = (dyy * error_x - dxy * error_y) / determinant
        step_b = (dxx * error_y - dyx * error_x) / determinant
        a, b = a - step_a, b - step_b
        if not abs(a - start_a) + abs(b - start_b) < LONGEST_STEP:
            return False, a, b
        if abs(step_a) + abs(step_b) <= 1e-9:  # the next step would be of the square of it
            return True, a, b
    return False, a, b


@kernel
def _unproject(c, nested, uv, bearing):
    bearing[:] = 0.0
    if c[0] == 0.0 or c[1] == 0.0:
        return False
    target_x, target_y = (uv[0] - c[2]) / c[0], (uv[1] - c[3]) / c[1]
    target = math.sqrt(target_x * target_x + target_y * target_y)
    if not target < math.inf:
        return False
    a, b, done, part = 0.0, 0.0, 0.0, min(1.0, 0.5 * LONGEST_STEP / (target + 1e-300))
    while done < 1.0:
        goal = min(done + part, 1.0)
        found, new_a, new_b = _newton(c, nested, goal * target_x, goal * target_y, a, b)
        if found and new_a * new_a + new_b * new_b < math.pi * math.pi:
            a, b, done, part = new_a, new_b, goal, 2.0 * part
        else:
            part *= 0.5
            if part < SHORTEST_PART:
                return False
    x, y, dxx, dxy, dyx, dyy = _distort(c, nested, a, b)
    regular = dxx * dyy > dxy * dyx
    if not (regular and abs(x - target_x) + abs(y - target_y) <= 1e-12 * (1.0 + target)):
        return False
    theta = math.sqrt(a * a + b * b)
    scale = math.sin(theta) / theta if theta > 0.0 else 1.0
    bearing[0], bearing[1], bearing[2] = scale * a, scale * b, math.cos(theta)
    return True


@kernel
def thin_prism_fisheye_project(params, X, uv):
    """Project with (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1)."""
    return _project(_thin_prism(params), False, X, uv)


@kernel
def thin_prism_fisheye_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1) and differentiate."""
    return _project_jacobian(_thin_prism(params), False, _THIN_PRISM_COLUMNS, X, uv, J_point, J_params)


@kernel
def thin_prism_fisheye_unproject(params, uv, bearing):
    """Unit bearing with (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1)."""
    return _unproject(_thin_prism(params), False, uv, bearing)


@kernel
def rad_tan_thin_prism_fisheye_project(params, X, uv):
    """Project with (fx, fy, cx, cy, k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3)."""
    return _project(params, True, X, uv)


@kernel
def rad_tan_thin_prism_fisheye_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (fx, fy, cx, cy, k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3) and differentiate."""
    return _project_jacobian(params, True, _RAD_TAN_COLUMNS, X, uv, J_point, J_params)


@kernel
def rad_tan_thin_prism_fisheye_unproject(params, uv, bearing):
    """Unit bearing with (fx, fy, cx, cy, k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3)."""
    return _unproject(params, True, uv, bearing)


# ---------------------------------------------------------------------------------------------------------- Public

THIN_PRISM_FISHEYE = register_camera(
    CameraModel(
        "THIN_PRISM_FISHEYE",
        ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
        (0, 1),
        (2, 3),
        tuple(range(4, 12)),
        "THIN_PRISM_FISHEYE",
        sees_behind=True,
    ),
    thin_prism_fisheye_project,
    thin_prism_fisheye_project_jacobian,
    thin_prism_fisheye_unproject,
)
RAD_TAN_THIN_PRISM_FISHEYE = register_camera(
    CameraModel(
        "RAD_TAN_THIN_PRISM_FISHEYE",
        ("fx", "fy", "cx", "cy", *(f"k{j}" for j in range(6)), "p0", "p1", "s0", "s1", "s2", "s3"),
        (0, 1),
        (2, 3),
        tuple(range(4, 16)),
        "RAD_TAN_THIN_PRISM_FISHEYE",
        sees_behind=True,
    ),
    rad_tan_thin_prism_fisheye_project,
    rad_tan_thin_prism_fisheye_project_jacobian,
    rad_tan_thin_prism_fisheye_unproject,
)
