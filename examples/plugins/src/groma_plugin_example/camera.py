# SPDX-License-Identifier: BSD-3-Clause
r"""A camera model: the equisolid fisheye EQUISOLID (f, cx, cy), which keeps areas of the view.

.. math:: r = 2 f \sin\tfrac{\theta}{2}, \qquad (u, v) = f g\,(X, Y) + c, \qquad g = \sqrt{\frac{2}{d\,(d + Z)}}

with the angle :math:`\theta` from the axis and d = |(X, Y, Z)|.
"""

import math

from groma.cameras import CameraModel, register_camera
from groma.compiled import kernel

MIN_SHARE, MAX_NORM = 1e-12, 1e140


@kernel
def distance(X):
    """The distance d of a point; zero if it has no image: straight behind, or of a size that cannot be squared."""
    norm = abs(X[0]) + abs(X[1]) + abs(X[2])
    if not 1.0 / MAX_NORM < norm < MAX_NORM:
        return 0.0
    d = math.sqrt(X[0] * X[0] + X[1] * X[1] + X[2] * X[2])
    return d if d + X[2] > MIN_SHARE * d else 0.0


@kernel
def equisolid_project(params, X, uv):
    d = distance(X)
    if d == 0.0:
        uv[:] = 0.0
        return False
    scale = params[0] * math.sqrt(2.0 / (d * (d + X[2])))
    uv[0], uv[1] = scale * X[0] + params[1], scale * X[1] + params[2]
    return True


@kernel
def equisolid_project_jacobian(params, X, uv, J_point, J_params):
    uv[:] = 0.0
    J_point[:, :] = 0.0
    J_params[:, :] = 0.0
    d = distance(X)
    if d == 0.0:
        return False
    f, g = params[0], math.sqrt(2.0 / (d * (d + X[2])))
    bend = -0.25 * g * g * g
    for row in range(2):
        uv[row] = f * g * X[row] + params[1 + row]
        for j in range(3):
            by_j = (2.0 + X[2] / d) * X[j] + (d if j == 2 else 0.0)
            J_point[row, j] = f * (bend * by_j * X[row] + (g if j == row else 0.0))
        J_params[row, 0], J_params[row, 1 + row] = g * X[row], 1.0
    return True


@kernel
def equisolid_unproject(params, uv, bearing):
    bearing[:] = 0.0
    if params[0] == 0.0:
        return False
    x, y = (uv[0] - params[1]) / params[0], (uv[1] - params[2]) / params[0]
    square = x * x + y * y
    if not square < 4.0:
        return False
    scale = math.sqrt(1.0 - 0.25 * square)
    bearing[0], bearing[1], bearing[2] = scale * x, scale * y, 1.0 - 0.5 * square
    return True


EQUISOLID = register_camera(
    CameraModel("EQUISOLID", ("f", "cx", "cy"), (0,), (1, 2), (), sees_behind=True),
    equisolid_project,
    equisolid_project_jacobian,
    equisolid_unproject,
)
