# SPDX-License-Identifier: BSD-3-Clause
r"""Lines as two points that move across them: residuals, and the kind of small problem that finds them.

A line is two points that move across it, :math:`X_k = A_k + x_k u + y_k v` with u, v perpendicular to the line: four
numbers, regular for every finite line. Residuals are the distances of the measured end points to the projected line,

.. math:: r = \frac{l^\top x}{\sigma \sqrt{l_1^2 + l_2^2}}, \qquad l = (P X_1) \times (P X_2) .
"""

from __future__ import annotations

import math

from groma._numba import kernel
from groma.estimators.batch_least_squares import problem_kind

# ---------------------------------------------------------------------------------------------------------- Kernels


@kernel
def line_residuals(cameras, i, segments, s, X, U, r, J):
    """Distances over sigma of the ends of segment ``s`` to the line seen by camera ``i``, and derivatives (2, 4).

    Segments (S, 5) are two end points and sigma.
    """
    sigma = segments[s, 4]
    x0 = cameras[i, 0, 0] * X[0, 0] + cameras[i, 0, 1] * X[0, 1] + cameras[i, 0, 2] * X[0, 2] + cameras[i, 0, 3]
    y0 = cameras[i, 1, 0] * X[0, 0] + cameras[i, 1, 1] * X[0, 1] + cameras[i, 1, 2] * X[0, 2] + cameras[i, 1, 3]
    z0 = cameras[i, 2, 0] * X[0, 0] + cameras[i, 2, 1] * X[0, 1] + cameras[i, 2, 2] * X[0, 2] + cameras[i, 2, 3]
    x1 = cameras[i, 0, 0] * X[1, 0] + cameras[i, 0, 1] * X[1, 1] + cameras[i, 0, 2] * X[1, 2] + cameras[i, 0, 3]
    y1 = cameras[i, 1, 0] * X[1, 0] + cameras[i, 1, 1] * X[1, 1] + cameras[i, 1, 2] * X[1, 2] + cameras[i, 1, 3]
    z1 = cameras[i, 2, 0] * X[1, 0] + cameras[i, 2, 1] * X[1, 1] + cameras[i, 2, 2] * X[1, 2] + cameras[i, 2, 3]
    a, b, c = y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1
    h2 = a * a + b * b
    if not h2 > 1e-24 * (z0 * z0 + z1 * z1):
        r[0], r[1] = 1e3, 1e3
        J[:, :] = 0.0
        return False
    h = math.sqrt(h2)
    r[0] = (a * segments[s, 0] + b * segments[s, 1] + c) / h
    r[1] = (a * segments[s, 2] + b * segments[s, 3] + c) / h
    for k in range(4):
        w = k % 2
        dx = cameras[i, 0, 0] * U[w, 0] + cameras[i, 0, 1] * U[w, 1] + cameras[i, 0, 2] * U[w, 2]
        dy = cameras[i, 1, 0] * U[w, 0] + cameras[i, 1, 1] * U[w, 1] + cameras[i, 1, 2] * U[w, 2]
        dz = cameras[i, 2, 0] * U[w, 0] + cameras[i, 2, 1] * U[w, 1] + cameras[i, 2, 2] * U[w, 2]
        if k < 2:
            da, db, dc = dy * z1 - dz * y1, dz * x1 - dx * z1, dx * y1 - dy * x1
        else:
            da, db, dc = y0 * dz - z0 * dy, z0 * dx - x0 * dz, x0 * dy - y0 * dx
        dh = (a * da + b * db) / h2
        J[0, k] = ((da * segments[s, 0] + db * segments[s, 1] + dc) / h - r[0] * dh) / sigma
        J[1, k] = ((da * segments[s, 2] + db * segments[s, 3] + dc) / h - r[1] * dh) / sigma
    r[0] /= sigma
    r[1] /= sigma
    return True


@kernel
def across_basis(X, U):
    """Write two unit vectors across the line through the points X (2, 3)."""
    d0, d1, d2 = X[1, 0] - X[0, 0], X[1, 1] - X[0, 1], X[1, 2] - X[0, 2]
    n = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    d0, d1, d2 = d0 / n, d1 / n, d2 / n
    if abs(d0) <= abs(d1) and abs(d0) <= abs(d2):
        u0, u1, u2 = 0.0, d2, -d1
    elif abs(d1) <= abs(d2):
        u0, u1, u2 = -d2, 0.0, d0
    else:
        u0, u1, u2 = d1, -d0, 0.0
    n = math.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
    u0, u1, u2 = u0 / n, u1 / n, u2 / n
    U[0, 0], U[0, 1], U[0, 2] = u0, u1, u2
    U[1, 0], U[1, 1], U[1, 2] = d1 * u2 - d2 * u1, d2 * u0 - d0 * u2, d0 * u1 - d1 * u0


@kernel
def _move(X, U, step, out):
    for c in range(3):
        out[0, c] = X[0, c] + step[0] * U[0, c] + step[1] * U[1, c]
        out[1, c] = X[1, c] + step[2] * U[0, c] + step[3] * U[1, c]


# ----------------------------------------------------------------------------------------------------------- Public

#: Lines through points (2, 3). Observations share cameras (3, 4); their own are two end points and sigma (5,). The
#: frame (2, 3) is what :func:`across_basis` writes.
TWO_POINT_LINE = problem_kind(1, 4, 2, (2, 3), across_basis, line_residuals, _move)
