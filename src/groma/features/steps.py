# SPDX-License-Identifier: BSD-3-Clause
r"""Steps under a common blur, fitted to the grey levels across a segment by damped least squares.

.. math:: g(r, s) = c + \sum_k A_k\, \Phi\!\left(\frac{r - e_k - t_k\,s}{\beta}\right),

over the distance r from the segment and the place s along it, :math:`-1/2 \le s \le 1/2`. Pixels are not interpolated,
but averaged in bins: the mean of n pixels has the variance :math:`\nu^2 / n + (\mu A)^2`, noise and what the model
leaves out. The logarithm of the blur :math:`\beta` is known beforehand with a deviation.

Unknowns are the grey level, the logarithm of the blur, and height, offset and tilt of each step. ``given`` is what is
known: logarithm of the blur and its deviation, both terms of the variance, and which pixels take part: the distance of
their middle from the segment, and their greatest distance from there.
"""

from __future__ import annotations

import math

import numpy as np

from groma._numba import kernel, loop

#: Pixels up to this distance take part, in this many bins of half a pixel, for either half of a segment: sizes of an
#: array. Edges farther away than this displace no segment.
REACH = 3
BINS = 4 * REACH
#: Places at which steps are looked for, half a pixel apart.
_PLACES = BINS + 1
#: Unknowns: grey level, logarithm of the blur; height, offset and tilt of each step.
ONE, TWO = 5, 8


@kernel
def _step(z):
    return 0.5 * (1.0 + math.erf(z * math.sqrt(0.5)))


@loop
def profile(image, u1, v1, u2, v2, bins):
    """Write number of pixels and mean place along, distance and grey level of the bins (2 BINS, 4), half by half."""
    for k in range(2 * BINS):
        for c in range(4):
            bins[k, c] = 0.0
    height, width = image.shape
    length = math.hypot(u2 - u1, v2 - v1)
    dx, dy = (u2 - u1) / length, (v2 - v1) / length
    steep = abs(dy) > abs(dx)
    # Along the axis that the segment follows, and across it.
    begin, end, count, across = (v1, v2, height, width) if steep else (u1, u2, width, height)
    lead, slope = (dy, dx / dy) if steep else (dx, dy / dx)
    start, reach = (u1 if steep else v1), REACH / abs(lead)
    for k in range(max(math.ceil(min(begin, end) - 0.5), 0), min(int(max(begin, end) + 0.5), count)):
        center = start + (k + 0.5 - begin) * slope
        low, high = math.ceil(center - reach - 0.5), math.floor(center + reach - 0.5)
        for m in range(max(low, 0), min(high, across - 1) + 1):
            i, j = (k, m) if steep else (m, k)
            x, y = j + 0.5 - u1, i + 0.5 - v1
            distance, along = dx * y - dy * x, (dx * x + dy * y) / length - 0.5
            row = min(max(int((distance + REACH) * (BINS / (2.0 * REACH))), 0), BINS - 1)
            row += BINS if along > 0.0 else 0
            bins[row, 0] += 1.0
            bins[row, 1] += along
            bins[row, 2] += distance
            bins[row, 3] += image[i, j]
    for k in range(2 * BINS):
        for c in range(1, 4):
            bins[k, c] /= max(bins[k, 0], 1.0)


@kernel
def merge(bins, whole):
    """Merge the halves of a segment: write the bins (BINS, 4) of it whole, at its middle."""
    for k in range(BINS):
        n, m = bins[k, 0], bins[k + BINS, 0]
        whole[k, 0], whole[k, 1] = n + m, 0.0
        for c in (2, 3):
            whole[k, c] = (n * bins[k, c] + m * bins[k + BINS, c]) / max(n + m, 1.0)


@kernel
def beside(whole, side):
    """Mean grey level one to three pixels from a segment, on its left (-1) or right (1); NaN where there is none."""
    total, count = 0.0, 0
    for k in range(BINS):
        if whole[k, 0] > 0.0 and 1.0 <= side * whole[k, 2] <= 3.0:
            total += whole[k, 3]
            count += 1
    return total / count if count else math.nan


@kernel
def _weight(n, noise2, misfit2):
    """Inverse variance of the mean of n pixels."""
    return n / (noise2 + n * misfit2) if n > 0.0 else 0.0


@loop
def _normal_equations(bins, p, unknowns, given, H, g):
    """Linearise twice the negative log likelihood of the bins at p; write H and g, return it."""
    log_blur, spread, noise2, misfit2, center, reach = given
    J = np.zeros(TWO)
    H[:, :] = 0.0
    g[:] = 0.0
    blur, J[0] = math.exp(min(max(p[1], log_blur - 4.0), log_blur + 4.0)), 1.0
    off, lean = (p[1] - log_blur) / spread, p[4]
    cost = off * off + lean * lean
    H[1, 1], g[1] = 1.0 / spread**2, -off / spread
    # Edges are parallel up to about a pixel over the length of a segment.
    H[4, 4], g[4] = 1.0, -lean
    if unknowns == TWO:
        lean = p[7] - p[4]
        cost += lean * lean
        H[4, 4] += 1.0
        H[7, 7], H[7, 4] = 1.0, -1.0
        g[4] += lean
        g[7] = -lean
    for k in range(bins.shape[0]):
        w = _weight(bins[k, 0], noise2, misfit2)
        if w == 0.0 or abs(bins[k, 2] - center) > reach:
            continue
        residual, J[1] = bins[k, 3] - p[0], 0.0
        for first in range(2, unknowns, 3):
            z = (bins[k, 2] - p[first + 1] - p[first + 2] * bins[k, 1]) / blur
            density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
            J[first] = _step(z)
            residual -= p[first] * J[first]
            J[first + 1] = -p[first] * density / blur
            J[first + 2] = J[first + 1] * bins[k, 1]
            J[1] -= p[first] * density * z
        cost += w * residual * residual
        for i in range(unknowns):
            g[i] += w * J[i] * residual
            for j in range(i + 1):
                H[i, j] += w * J[i] * J[j]
    return cost


@loop
def _solve(H, damping, b, n, x):
    """Write the solution of (H + damping diag H) x = b for the lower triangle of H; False where it is singular."""
    L = np.zeros((TWO, TWO))
    for i in range(n):
        for j in range(i + 1):
            rest = H[i, j] + (damping * H[i, i] if i == j else 0.0)
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = rest / L[j, j]
            elif rest > 1e-12 * H[i, i]:
                L[i, i] = math.sqrt(rest)
            else:
                return False
    for i in range(n):
        rest = b[i]
        for k in range(i):
            rest -= L[i, k] * x[k]
        x[i] = rest / L[i, i]
    for i in range(n - 1, -1, -1):
        rest = x[i]
        for k in range(i + 1, n):
            rest -= L[k, i] * x[k]
        x[i] = rest / L[i, i]
    return True


@kernel
def variance(H, index, unit, x):
    """Variance of one of two steps' unknowns; infinite where it is not determined."""
    for k in range(TWO):
        unit[k] = 1.0 if k == index else 0.0
    return x[index] if _solve(H, 0.0, unit, TWO, x) else math.inf


@loop
def fit(bins, p, unknowns, given, H):
    """Minimise by damped least squares, in place; write the information H, return the cost."""
    g, trial_g, x, trial = np.zeros(TWO), np.zeros(TWO), np.zeros(TWO), np.zeros(TWO)
    trial_H = np.zeros((TWO, TWO))
    cost, damping = _normal_equations(bins, p, unknowns, given, H, g), 1e-3
    for _ in range(20):
        gain = -1.0
        if _solve(H, damping, g, unknowns, x):
            for i in range(unknowns):
                trial[i] = p[i] + x[i]
            gain = cost - _normal_equations(bins, trial, unknowns, given, trial_H, trial_g)
        if gain >= 0.0:
            cost -= gain
            damping *= 0.1
            for i in range(unknowns):
                p[i], g[i] = trial[i], trial_g[i]
                for j in range(i + 1):
                    H[i, j] = trial_H[i, j]
            if gain < 0.01 + 0.01 * cost:
                break
        else:
            damping = 10.0 * damping
            if damping > 1e3:
                break
    return cost


@loop
def two_steps(whole, given, max_shift, p):
    """Write the best pair of steps on a grid, the first of them an ascent near the segment; False if there is none."""
    log_blur, _, noise2, misfit2, _, _ = given
    blur = math.exp(log_blur)
    row, G = np.zeros(_PLACES + 2), np.zeros((_PLACES + 2, _PLACES + 2))
    ones, data = _PLACES, _PLACES + 1
    for k in range(BINS):
        w = _weight(whole[k, 0], noise2, misfit2)
        if w == 0.0:
            continue
        for i in range(_PLACES):
            row[i] = _step((whole[k, 2] + REACH - 0.5 * i) / blur)
        row[ones], row[data] = 1.0, whole[k, 3]
        for i in range(_PLACES + 2):
            for j in range(i + 1):
                G[i, j] += w * row[i] * row[j]
    # Without the common grey level.
    for i in range(_PLACES):
        for j in range(i + 1):
            G[i, j] -= G[ones, i] * G[ones, j] / G[ones, ones]
        G[data, i] -= G[ones, i] * G[data, ones] / G[ones, ones]
    best = 0.0
    for i in range(_PLACES):
        for j in range(_PLACES):
            # Nearer than a pixel two steps are one.
            if abs(0.5 * i - REACH) > max_shift or abs(i - j) < 2:
                continue
            cross = G[max(i, j), min(i, j)]
            determinant = G[i, i] * G[j, j] - cross * cross
            if not determinant > 1e-9 * G[i, i] * G[j, j]:
                continue
            first = (G[j, j] * G[data, i] - cross * G[data, j]) / determinant
            second = (G[i, i] * G[data, j] - cross * G[data, i]) / determinant
            gain = first * G[data, i] + second * G[data, j]
            if first > 0.0 and gain > best:
                best = gain
                p[0] = (G[data, ones] - first * G[ones, i] - second * G[ones, j]) / G[ones, ones]
                p[1], p[2], p[3], p[4] = log_blur, first, 0.5 * i - REACH, 0.0
                p[5], p[6], p[7] = second, 0.5 * j - REACH, 0.0
    return best > 0.0
