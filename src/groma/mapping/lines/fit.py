# SPDX-License-Identifier: BSD-3-Clause
r"""Lines from their observations: maximum likelihood, and segments that lie on them. Kernels only.

A line is two points that move across it, :math:`X_k = A_k + x_k u + y_k v` with u, v perpendicular to the line: four
numbers, regular for every finite line. Residuals are the distances of the measured end points to the projected line,

.. math:: r = \frac{l^\top x}{\sigma \sqrt{l_1^2 + l_2^2}}, \qquad l = (P X_1) \times (P X_2),

under a Cauchy loss, and the loop is Levenberg-Marquardt on 4x4 systems.

Observations of all lines are flat arrays, stored by line: those of line n are ``pointers[n] : pointers[n + 1]``, and
``rows`` names their segments.
"""

from __future__ import annotations

import math

import numpy as np

from groma._numba import kernel, loop

#: Scale of the Cauchy loss, in sigma.
_CAUCHY = 2.0


# ------------------------------------------------------------------------------------------------------------- Refine
@kernel
def line_residuals(P, ends, sigma, X, U, r, J):
    """Distances over sigma of the two measured end points to the projected line, and their derivatives (2, 4)."""
    x0 = P[0, 0] * X[0, 0] + P[0, 1] * X[0, 1] + P[0, 2] * X[0, 2] + P[0, 3]
    y0 = P[1, 0] * X[0, 0] + P[1, 1] * X[0, 1] + P[1, 2] * X[0, 2] + P[1, 3]
    z0 = P[2, 0] * X[0, 0] + P[2, 1] * X[0, 1] + P[2, 2] * X[0, 2] + P[2, 3]
    x1 = P[0, 0] * X[1, 0] + P[0, 1] * X[1, 1] + P[0, 2] * X[1, 2] + P[0, 3]
    y1 = P[1, 0] * X[1, 0] + P[1, 1] * X[1, 1] + P[1, 2] * X[1, 2] + P[1, 3]
    z1 = P[2, 0] * X[1, 0] + P[2, 1] * X[1, 1] + P[2, 2] * X[1, 2] + P[2, 3]
    a, b, c = y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1
    h2 = a * a + b * b
    if not h2 > 1e-24 * (z0 * z0 + z1 * z1):
        r[0], r[1] = 1e3, 1e3
        J[:, :] = 0.0
        return False
    h = math.sqrt(h2)
    r[0] = (a * ends[0] + b * ends[1] + c) / h
    r[1] = (a * ends[2] + b * ends[3] + c) / h
    for k in range(4):
        w = k % 2
        dx = P[0, 0] * U[w, 0] + P[0, 1] * U[w, 1] + P[0, 2] * U[w, 2]
        dy = P[1, 0] * U[w, 0] + P[1, 1] * U[w, 1] + P[1, 2] * U[w, 2]
        dz = P[2, 0] * U[w, 0] + P[2, 1] * U[w, 1] + P[2, 2] * U[w, 2]
        if k < 2:
            da, db, dc = dy * z1 - dz * y1, dz * x1 - dx * z1, dx * y1 - dy * x1
        else:
            da, db, dc = y0 * dz - z0 * dy, z0 * dx - x0 * dz, x0 * dy - y0 * dx
        dh = (a * da + b * db) / h2
        J[0, k] = ((da * ends[0] + db * ends[1] + dc) / h - r[0] * dh) / sigma
        J[1, k] = ((da * ends[2] + db * ends[3] + dc) / h - r[1] * dh) / sigma
    r[0] /= sigma
    r[1] /= sigma
    return True


@kernel
def _solve4(H, g, damping, x):
    """Solve (H + damping diag H) x = g by Cholesky; False if not positive definite."""
    L = np.zeros((4, 4))
    for m in range(4):
        for n in range(m + 1):
            s = H[m, n]
            if m == n:
                s += damping * H[m, m] + 1e-300
            for k in range(n):
                s -= L[m, k] * L[n, k]
            if m == n:
                if not s > 1e-12 * H[m, m]:
                    return False
                L[m, m] = math.sqrt(s)
            else:
                L[m, n] = s / L[n, n]
    for m in range(4):
        s = g[m]
        for k in range(m):
            s -= L[m, k] * x[k]
        x[m] = s / L[m, m]
    for m in range(3, -1, -1):
        s = x[m]
        for k in range(m + 1, 4):
            s -= L[k, m] * x[k]
        x[m] = s / L[m, m]
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
def _largest_deviation(H, g, x):
    """Root of the largest diagonal entry of the inverse of H; infinite where it has none."""
    worst = 0.0
    for a in range(4):
        g[:] = 0.0
        g[a] = 1.0
        if not _solve4(H, g, 0.0, x):
            return np.inf
        worst = max(worst, x[a])
    return math.sqrt(worst)


@loop
def refine(camera, image, ends, sigma, pointers, rows, active, X, squared, uncertainty, unchecked):
    """Refine the lines through X (L, 2, 3) in place.

    Also the squared distances over sigma of each observation (M,), the largest standard deviation of the end points
    across the line (L,), and the same when the image that tells most is left out.
    """
    r, J, U = np.zeros(2), np.zeros((2, 4)), np.zeros((2, 3))
    H, g, step, inverse = np.zeros((4, 4)), np.zeros(4), np.zeros(4), np.zeros(4)
    trial, without = np.zeros((2, 3)), np.zeros((4, 4))
    for n in range(len(pointers) - 1):
        damping = 1e-4
        cost = np.inf
        for _ in range(20):
            across_basis(X[n], U)
            cost = 0.0
            H[:, :] = 0.0
            g[:] = 0.0
            for m in range(pointers[n], pointers[n + 1]):
                if not active[m]:
                    continue
                s = rows[m]
                line_residuals(camera[image[s]], ends[s], sigma[s], X[n], U, r, J)
                square = (r[0] * r[0] + r[1] * r[1]) / (_CAUCHY * _CAUCHY)
                cost += math.log1p(square)
                weight = 1.0 / (1.0 + square)
                for a in range(4):
                    g[a] -= weight * (J[0, a] * r[0] + J[1, a] * r[1])
                    for b in range(a + 1):
                        H[a, b] += weight * (J[0, a] * J[0, b] + J[1, a] * J[1, b])
            done = better = False
            for _ in range(8):
                better = False
                if _solve4(H, g, damping, step):
                    for c in range(3):
                        trial[0, c] = X[n, 0, c] + step[0] * U[0, c] + step[1] * U[1, c]
                        trial[1, c] = X[n, 1, c] + step[2] * U[0, c] + step[3] * U[1, c]
                    fresh = 0.0
                    for m in range(pointers[n], pointers[n + 1]):
                        if active[m]:
                            s = rows[m]
                            line_residuals(camera[image[s]], ends[s], sigma[s], trial, U, r, J)
                            fresh += math.log1p((r[0] * r[0] + r[1] * r[1]) / (_CAUCHY * _CAUCHY))
                    better = fresh <= cost
                    done = fresh >= cost * (1.0 - 1e-9) - 1e-12
                if better:
                    for c in range(3):
                        X[n, 0, c], X[n, 1, c] = trial[0, c], trial[1, c]
                    damping = max(damping * 0.1, 1e-12)
                    break
                damping *= 10.0
            if done or not better:
                break
        across_basis(X[n], U)
        H[:, :] = 0.0
        for m in range(pointers[n], pointers[n + 1]):
            s = rows[m]
            line_residuals(camera[image[s]], ends[s], sigma[s], X[n], U, r, J)
            squared[m] = r[0] * r[0] + r[1] * r[1]
            if active[m]:
                for a in range(4):
                    for b in range(a + 1):
                        H[a, b] += J[0, a] * J[0, b] + J[1, a] * J[1, b]
        uncertainty[n] = _largest_deviation(H, g, inverse)
        unchecked[n] = 0.0
        for m in range(pointers[n], pointers[n + 1]):
            if not active[m] or (m > pointers[n] and active[m - 1] and image[rows[m]] == image[rows[m - 1]]):
                continue
            for a in range(4):
                for b in range(a + 1):
                    without[a, b] = H[a, b]
            for k in range(m, pointers[n + 1]):
                s = rows[k]
                if image[s] != image[rows[m]]:
                    break
                if active[k]:
                    line_residuals(camera[image[s]], ends[s], sigma[s], X[n], U, r, J)
                    for a in range(4):
                        for b in range(a + 1):
                            without[a, b] -= J[0, a] * J[0, b] + J[1, a] * J[1, b]
            unchecked[n] = max(unchecked[n], _largest_deviation(without, g, inverse))


# ------------------------------------------------------------------------------------------------------------ Recover
@loop
def find_on_lines(P, X, lines, rows, ends, sigma, usable, forward, gate, min_overlap, min_px, found, distance):
    """Segments (rows) of one image that lie on projections of lines; return the number written, or needed."""
    count = 0
    for e in range(len(lines)):
        n = lines[e]
        x0 = P[0, 0] * X[n, 0, 0] + P[0, 1] * X[n, 0, 1] + P[0, 2] * X[n, 0, 2] + P[0, 3]
        y0 = P[1, 0] * X[n, 0, 0] + P[1, 1] * X[n, 0, 1] + P[1, 2] * X[n, 0, 2] + P[1, 3]
        z0 = P[2, 0] * X[n, 0, 0] + P[2, 1] * X[n, 0, 1] + P[2, 2] * X[n, 0, 2] + P[2, 3]
        x1 = P[0, 0] * X[n, 1, 0] + P[0, 1] * X[n, 1, 1] + P[0, 2] * X[n, 1, 2] + P[0, 3]
        y1 = P[1, 0] * X[n, 1, 0] + P[1, 1] * X[n, 1, 1] + P[1, 2] * X[n, 1, 2] + P[1, 3]
        z1 = P[2, 0] * X[n, 1, 0] + P[2, 1] * X[n, 1, 1] + P[2, 2] * X[n, 1, 2] + P[2, 3]
        if z0 <= 1e-6 or z1 <= 1e-6:
            continue
        x0, y0, x1, y1 = x0 / z0, y0 / z0, x1 / z1, y1 / z1
        dx, dy = x1 - x0, y1 - y0
        length = math.sqrt(dx * dx + dy * dy)
        if length < min_px:
            continue
        dx, dy = dx / length, dy / length
        for k in range(len(rows)):
            s = rows[k]
            if not usable[s]:
                continue
            allowed = gate * sigma[s] * sigma[s]
            first = (ends[s, 0] - x0) * dy - (ends[s, 1] - y0) * dx
            if first * first > allowed:
                continue
            second = (ends[s, 2] - x0) * dy - (ends[s, 3] - y0) * dx
            if first * first + second * second > allowed:
                continue
            t0 = (ends[s, 0] - x0) * dx + (ends[s, 1] - y0) * dy
            t1 = (ends[s, 2] - x0) * dx + (ends[s, 3] - y0) * dy
            if forward[n] * (t1 - t0) < 0.0:
                continue
            overlap = min(max(t0, t1), length) - max(min(t0, t1), 0.0)
            if overlap < min_overlap * min(abs(t1 - t0), length) or overlap < min_px:
                continue
            if count < len(found):
                found[count, 0], found[count, 1] = n, s
                distance[count] = (first * first + second * second) / (sigma[s] * sigma[s])
            count += 1
    return count
