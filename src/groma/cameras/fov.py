# SPDX-License-Identifier: BSD-3-Clause
r"""The field-of-view model of a wide lens: FOV (fx, fy, cx, cy, omega).

.. math::
    r = \sqrt{x'^2 + y'^2}, \quad x' = x/z, \; y' = y/z, \qquad
    r_d = \frac{1}{\omega} \arctan\Big(2 r \tan\frac{\omega}{2}\Big), \qquad
    (u, v) = (f_x\, r_d\, x'/r + c_x,\ f_y\, r_d\, y'/r + c_y)

For :math:`\omega \to 0` it is a pinhole camera. Name and parameter order are COLMAP's.

Source: Devernay and Faugeras, *Straight lines have to be straight*, 2001, eq. (13), (14). The formula is evaluated
everywhere. COLMAP takes series of second order where :math:`\omega^2` or :math:`r^2` is below 1e-4: the one in r
differs by less than 1e-7 px at usual focal lengths, the one in :math:`\omega` has the signs of the inverse.

**Inverse.** :math:`r = \tan(\omega r_d) / (2 \tan(\omega/2))`, as long as :math:`|\omega| r_d < \pi/2`.
"""

from __future__ import annotations

import math

from groma._numba import kernel
from groma.cameras.contract import CameraModel
from groma.cameras.pinhole import bearing_from_normalized, clear, has_depth
from groma.cameras.radial import write_point_jacobian
from groma.cameras.registry import register_camera

# --------------------------------------------------------------------------------------------------------- Kernels

#: Below this omega its fourth power is lost in rounding, and series of second order take the place of the formula
#: (derived from the precision of doubles).
SMALL_OMEGA = 1e-5
#: Below this value of (2 r tan(omega / 2))^2 the derivative of r_d / r is taken at the axis.
SMALL_SQUARE = 1e-8


@kernel
def _factor(omega, s):
    """Return r_d / r at r^2 = s."""
    if abs(omega) < SMALL_OMEGA:
        return 1.0 + omega * omega * (1.0 / 12.0 - s / 3.0)
    double = 2.0 * math.tan(0.5 * omega)
    t = double * math.sqrt(s)
    return math.atan(t) / (omega * math.sqrt(s)) if s > 0.0 else double / omega


@kernel
def _slopes(omega, s, g):
    """Return the derivatives of g = r_d / r: twice that by s, and that by omega."""
    if abs(omega) < SMALL_OMEGA:
        return -2.0 / 3.0 * omega * omega, omega * (1.0 / 6.0 - 2.0 / 3.0 * s)
    double = 2.0 * math.tan(0.5 * omega)
    square = double * double * s
    if square < SMALL_SQUARE:
        by_square = -2.0 / 3.0 * double * double * double / omega
    else:
        by_square = (double / (omega * (1.0 + square)) - g) / s
    return by_square, ((1.0 + 0.25 * double * double) / (1.0 + square) - g) / omega


@kernel
def fov_project(params, X, uv):
    """Project with (fx, fy, cx, cy, omega)."""
    if not (has_depth(X) and abs(params[4]) < math.pi):
        uv[:] = 0.0
        return False
    x, y = X[0] / X[2], X[1] / X[2]
    g = _factor(params[4], x * x + y * y)
    uv[0], uv[1] = params[0] * g * x + params[2], params[1] * g * y + params[3]
    return True


@kernel
def fov_project_jacobian(params, X, uv, J_point, J_params):
    """Project with (fx, fy, cx, cy, omega) and differentiate."""
    clear(uv, J_point, J_params)
    if not (has_depth(X) and abs(params[4]) < math.pi):
        return False
    fx, fy, omega = params[0], params[1], params[4]
    inverse = 1.0 / X[2]
    x, y = X[0] * inverse, X[1] * inverse
    s = x * x + y * y
    g = _factor(omega, s)
    dg, by_omega = _slopes(omega, s, g)
    uv[0], uv[1] = fx * g * x + params[2], fy * g * y + params[3]
    write_point_jacobian(fx, fy, x, y, inverse, g + dg * x * x, dg * x * y, g + dg * y * y, J_point)
    J_params[0, 0], J_params[0, 2], J_params[0, 4] = g * x, 1.0, fx * x * by_omega
    J_params[1, 1], J_params[1, 3], J_params[1, 4] = g * y, 1.0, fy * y * by_omega
    return True


@kernel
def fov_unproject(params, uv, bearing):
    """Unit bearing with (fx, fy, cx, cy, omega)."""
    bearing[:] = 0.0
    omega = params[4]
    if params[0] == 0.0 or params[1] == 0.0 or not abs(omega) < math.pi:
        return False
    x, y = (uv[0] - params[2]) / params[0], (uv[1] - params[3]) / params[1]
    s = x * x + y * y
    angle = abs(omega) * math.sqrt(s)
    if not angle < 0.5 * math.pi:
        return False
    if abs(omega) < SMALL_OMEGA:
        scale = 1.0 + omega * omega * (s / 3.0 - 1.0 / 12.0)
    else:
        double = 2.0 * math.tan(0.5 * abs(omega))
        scale = math.tan(angle) / (double * math.sqrt(s)) if s > 0.0 else abs(omega) / double
    return bearing_from_normalized(scale * x, scale * y, bearing)


# ---------------------------------------------------------------------------------------------------------- Public

FOV = register_camera(
    CameraModel("FOV", ("fx", "fy", "cx", "cy", "omega"), (0, 1), (2, 3), (4,), "FOV"),
    fov_project,
    fov_project_jacobian,
    fov_unproject,
)
