# SPDX-License-Identifier: BSD-3-Clause
r"""From the places of single segments to lines seen by many images.

link
    Segments whose places support each other are joined, best edges first; two groups are joined only if the places of
    their representatives explain each other's segment in the image.
refine
    Maximum likelihood. A line is two points that move across it, :math:`X_k = A_k + x_k u + y_k v`, four numbers,
    regular for every finite line. Residuals are the distances of the measured end points to the projected line over
    their sigma, under a Cauchy loss; observations whose two distances fail a chi-square test are dropped.
recover
    Lines are projected into the images of their neighbourhood. A free segment on a line joins it, also one whose own
    proposals were degenerate; a segment of another line is a vote that both are one.
trim
    The end points of a line bound the part of it that at least two images see.

Observations of all lines are flat arrays, stored by line: those of line n are ``pointers[n] : pointers[n + 1]``.
"""

from __future__ import annotations

import math

import numpy as np

from groma._numba import kernel, loop
from groma._typing import BoolArray, FloatArray, IntArray
from groma.pipelines._line_views import LineViews

#: Sum of squares of an observation's two distances over sigma up to which it belongs to a line: 99.7 %.
GATE = 11.6
#: Scale of the Cauchy loss, in sigma.
_CAUCHY = 2.0


# --------------------------------------------------------------------------------------------------------------- Link
@kernel
def _explains(P, center, ray, q, variance1, variance2, sigma_a, line, ends, sigma_b, gate):
    """Whether the place q of one segment projects on another segment's line, within the noise of both."""
    a0 = P[0, 0] * center[0] + P[0, 1] * center[1] + P[0, 2] * center[2] + P[0, 3]
    a1 = P[1, 0] * center[0] + P[1, 1] * center[1] + P[1, 2] * center[2] + P[1, 3]
    a2 = P[2, 0] * center[0] + P[2, 1] * center[1] + P[2, 2] * center[2] + P[2, 3]
    ux, uy = ends[2] - ends[0], ends[3] - ends[1]
    length2 = ux * ux + uy * uy
    for k in range(2):
        x = q[k] * a0 + P[0, 0] * ray[k, 0] + P[0, 1] * ray[k, 1] + P[0, 2] * ray[k, 2]
        y = q[k] * a1 + P[1, 0] * ray[k, 0] + P[1, 1] * ray[k, 1] + P[1, 2] * ray[k, 2]
        z = q[k] * a2 + P[2, 0] * ray[k, 0] + P[2, 1] * ray[k, 1] + P[2, 2] * ray[k, 2]
        if z <= 1e-6:
            return False
        u, v = x / z, y / z
        distance = line[0] * u + line[1] * v + line[2]
        t = ((u - ends[0]) * ux + (v - ends[1]) * uy) / length2
        slope = (line[0] * a0 + line[1] * a1 + line[2] * a2) / z
        variance = variance1 if k == 0 else variance2
        allowed = sigma_b * sigma_b * ((1.0 - t) * (1.0 - t) + t * t) + sigma_a * sigma_a + slope * slope * variance
        if distance * distance > gate * allowed:
            return False
    return True


@kernel
def _agree(s, r, camera, center, image, ray, q, covariance, sigma, line, ends, gate):
    """Whether the places of two segments explain each other."""
    i, j = image[s], image[r]
    if not _explains(
        camera[j], center[i], ray[s], q[s], covariance[s, 0], covariance[s, 2], sigma[s], line[r], ends[r], sigma[r],
        gate,
    ):  # fmt: skip
        return False
    return _explains(
        camera[i], center[j], ray[r], q[r], covariance[r, 0], covariance[r, 2], sigma[r], line[s], ends[s], sigma[s],
        gate,
    )  # fmt: skip


@kernel
def _root(parent, s):
    while parent[s] != s:
        parent[s] = parent[parent[s]]
        s = parent[s]
    return s


@loop
def _mutual(edges, camera, center, image, ray, q, covariance, sigma, line, ends, gate, keep):
    for e in range(len(edges)):
        keep[e] = _agree(
            edges[e, 0], edges[e, 1], camera, center, image, ray, q, covariance, sigma, line, ends, gate
        )  # fmt: skip


@loop
def _join(edges, rank, camera, center, image, ray, q, covariance, sigma, line, ends, gate, parent):
    """Union of segments along edges, best first; a group stands for itself by its member of highest rank."""
    for e in range(len(edges)):
        s, r = _root(parent, edges[e, 0]), _root(parent, edges[e, 1])
        if s == r:
            continue
        if not _agree(s, r, camera, center, image, ray, q, covariance, sigma, line, ends, gate):
            continue
        if rank[s] >= rank[r]:
            parent[r] = s
        else:
            parent[s] = r
    for s in range(len(parent)):
        parent[s] = _root(parent, s)


def link(
    views: LineViews, q: FloatArray, covariance: FloatArray, score: FloatArray, supporters: IntArray, free: BoolArray
) -> tuple[IntArray, IntArray]:
    """Join segments whose places agree.

    Parameters
    ----------
    views : LineViews
        Segments of all images.
    q, covariance, score : (S, 2), (S, 3), (S,)
        Place of each segment and its support; zero support for segments without a place.
    supporters : (S, n) int
        Rows of supporting segments, -1 for none.
    free : (S,) bool
        Segments that may be used.

    Returns
    -------
    members, representative : (m,) int
        Rows of the segments in groups of two and more, and the row that stands for each one's group.
    """
    first, which = np.nonzero(supporters >= 0)
    second = supporters[first, which]
    has_place = free & (score > 0)
    keep = has_place[first] & has_place[second]
    edges = np.column_stack([np.minimum(first, second), np.maximum(first, second)])[keep]
    edges = np.unique(edges, axis=0)
    tables = (
        views.camera, views.center, views.image_idx, views.ray, q, covariance, views.sigma, views.line, views.ends,
    )  # fmt: skip
    keep = np.zeros(len(edges), bool)
    _mutual(edges, *tables, GATE, keep)
    edges = edges[keep]
    rank = score * np.sqrt(views.length)
    edges = edges[np.argsort(-rank[edges].min(1), kind="stable")]
    parent = np.arange(len(free))
    _join(edges, rank, *tables, GATE, parent)
    size = np.bincount(parent, minlength=len(parent))
    members = np.flatnonzero(size[parent] > 1)
    return members, parent[members]


# ------------------------------------------------------------------------------------------------------------- Refine
@kernel
def _residuals(P, ends, sigma, X, U, r, J):
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
def _across_basis(X, U):
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
def _refine(camera, image, ends, sigma, pointers, rows, active, X, squared, uncertainty, unchecked):
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
            _across_basis(X[n], U)
            cost = 0.0
            H[:, :] = 0.0
            g[:] = 0.0
            for m in range(pointers[n], pointers[n + 1]):
                if not active[m]:
                    continue
                s = rows[m]
                _residuals(camera[image[s]], ends[s], sigma[s], X[n], U, r, J)
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
                            _residuals(camera[image[s]], ends[s], sigma[s], trial, U, r, J)
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
        _across_basis(X[n], U)
        H[:, :] = 0.0
        for m in range(pointers[n], pointers[n + 1]):
            s = rows[m]
            _residuals(camera[image[s]], ends[s], sigma[s], X[n], U, r, J)
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
                    _residuals(camera[image[s]], ends[s], sigma[s], X[n], U, r, J)
                    for a in range(4):
                        for b in range(a + 1):
                            without[a, b] -= J[0, a] * J[0, b] + J[1, a] * J[1, b]
            unchecked[n] = max(unchecked[n], _largest_deviation(without, g, inverse))


# ------------------------------------------------------------------------------------------------------ Trim, recover
@kernel
def _along(center, ray, X):
    """Where the ray from a camera comes closest to the line X: position in units of X's length, and depth."""
    d0, d1, d2 = X[1, 0] - X[0, 0], X[1, 1] - X[0, 1], X[1, 2] - X[0, 2]
    w0, w1, w2 = X[0, 0] - center[0], X[0, 1] - center[1], X[0, 2] - center[2]
    dd = d0 * d0 + d1 * d1 + d2 * d2
    ff = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]
    df = d0 * ray[0] + d1 * ray[1] + d2 * ray[2]
    dw = d0 * w0 + d1 * w1 + d2 * w2
    fw = ray[0] * w0 + ray[1] * w1 + ray[2] * w2
    determinant = dd * ff - df * df
    if not determinant > 4e-4 * dd * ff:
        return np.nan, -1.0
    return (df * fw - ff * dw) / determinant, (dd * fw - df * dw) / determinant


@loop
def _trim(center, image, ray, pointers, rows, active, X, front):
    """Move the end points of lines to bound what two images see; front (M,): observation lies before its camera."""
    for n in range(len(pointers) - 1):
        begin, end = pointers[n], pointers[n + 1]
        at, change, owner = np.empty(2 * (end - begin)), np.empty(2 * (end - begin)), np.empty(2 * (end - begin))
        count = 0
        for m in range(begin, end):
            s = rows[m]
            t0, z0 = _along(center[image[s]], ray[s, 0], X[n])
            t1, z1 = _along(center[image[s]], ray[s, 1], X[n])
            front[m] = z0 > 0.0 and z1 > 0.0
            if active[m] and front[m]:
                at[count], change[count], owner[count] = min(t0, t1), 1.0, image[s]
                at[count + 1], change[count + 1], owner[count + 1] = max(t0, t1), -1.0, image[s]
                count += 2
        order = np.argsort(at[:count])
        # The hull of what two images see; of what one sees, if no two overlap.
        depth, low, high = 0, np.inf, -np.inf
        for k in range(count):
            e = order[k]
            if change[e] > 0:
                depth += 1
                if depth == 2:
                    low = min(low, at[e])
            else:
                if depth == 2:
                    high = max(high, at[e])
                depth -= 1
        if low < high:
            a0, a1, a2 = X[n, 0, 0], X[n, 0, 1], X[n, 0, 2]
            d0, d1, d2 = X[n, 1, 0] - a0, X[n, 1, 1] - a1, X[n, 1, 2] - a2
            X[n, 0, 0], X[n, 0, 1], X[n, 0, 2] = a0 + low * d0, a1 + low * d1, a2 + low * d2
            X[n, 1, 0], X[n, 1, 1], X[n, 1, 2] = a0 + high * d0, a1 + high * d1, a2 + high * d2


@loop
def _find_on_lines(P, X, lines, rows, ends, sigma, usable, forward, gate, min_overlap, found, distance):
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
        if length < 5.0:
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
            if overlap < min_overlap * min(abs(t1 - t0), length) or overlap < 5.0:
                continue
            if count < len(found):
                found[count, 0], found[count, 1] = n, s
                distance[count] = (first * first + second * second) / (sigma[s] * sigma[s])
            count += 1
    return count


class Tracks:
    """Lines with their observations while they are being built."""

    def __init__(self, views: LineViews) -> None:
        self.views = views
        #: (S,) line of each segment, -1 for none.
        self.line_of = np.full(len(views.image_idx), -1, np.int64)
        #: (L, 2, 3) two points of each line.
        self.X = np.zeros((0, 2, 3))
        #: (L,) largest standard deviation of the end points across the line.
        self.uncertainty = np.zeros(0)
        #: (L,) the same without the image that tells most: what a wrong match in one image could hide behind.
        self.unchecked = np.zeros(0)
        #: (S,) squared distances over sigma of each observation to its line.
        self.squared = np.full(len(views.image_idx), np.nan)
        #: (S,) segments that were observations and failed the test.
        self.dropped = np.zeros(len(views.image_idx), bool)

    def add(self, members: IntArray, representative: IntArray, places: FloatArray) -> None:
        """Start lines from groups of segments; ``places`` (S, 2, 3) are the 3D segments."""
        reps, group = np.unique(representative, return_inverse=True)
        self.line_of[members] = len(self.X) + group
        self.X = np.concatenate([self.X, places[reps]])

    def _table(self) -> tuple[IntArray, IntArray]:
        rows = np.flatnonzero(self.line_of >= 0)
        rows = rows[np.argsort(self.line_of[rows], kind="stable")]  # rows are sorted by image, and stay so per line
        return rows, np.searchsorted(self.line_of[rows], np.arange(len(self.X) + 1))

    def num_images(self) -> IntArray:
        """(L,) number of images of each line."""
        rows = np.flatnonzero(self.line_of >= 0)
        pairs = np.unique(np.column_stack([self.line_of[rows], self.views.image_idx[rows]]), axis=0)
        return np.bincount(pairs[:, 0], minlength=len(self.X))

    def refine(self, rounds: int = 3) -> None:
        """Refine all lines, dropping observations that do not fit, then trim."""
        views = self.views
        rows, pointers = self._table()
        active, squared, front = np.ones(len(rows), bool), np.zeros(len(rows)), np.zeros(len(rows), bool)
        self.uncertainty, self.unchecked = np.zeros(len(self.X)), np.zeros(len(self.X))
        for k in range(rounds):
            _refine(
                views.camera, views.image_idx, views.ends, views.sigma, pointers, rows, active, self.X, squared,
                self.uncertainty, self.unchecked,
            )  # fmt: skip
            _trim(views.center, views.image_idx, views.ray, pointers, rows, active, self.X, front)
            fits = (squared < GATE) & front
            if k == rounds - 1:
                fits &= active
            if (fits == active).all():
                break
            active = fits
        self.squared[rows] = squared
        self.dropped[rows[~active]] = True
        self.line_of[rows[~active]] = -1

    def noise_scale(self) -> float:
        """By how much the sigmas are too large or too small, from what is left of the lines' own residuals.

        An observation's two squared distances over sigma have 2 - 4/n degrees of freedom where its line has n
        observations. The upper quartile is compared, by the formula of Wilson and Hilferty: detections have heavier
        tails than a normal law, and the gates that follow should keep them.
        """
        rows = np.flatnonzero(self.line_of >= 0)
        number = np.bincount(self.line_of[rows], minlength=len(self.X))[self.line_of[rows]]
        rows, number = rows[number >= 4], number[number >= 4]
        if len(rows) < 30:
            return 1.0
        freedom = 2.0 - 4.0 / number
        spread = 2.0 / (9.0 * freedom)
        expected = freedom * (1.0 - spread + 0.6745 * np.sqrt(spread)) ** 3
        return float(np.sqrt(np.quantile(self.squared[rows] / expected, 0.75)))

    def keep(self, wanted: BoolArray) -> IntArray:
        """Keep some lines; return the segments set free."""
        new = np.append(np.where(wanted, np.cumsum(wanted) - 1, -1), -1)  # the last one stands for no line
        after = new[self.line_of]
        freed = np.flatnonzero((self.line_of >= 0) & (after < 0))
        self.line_of, self.X = after, self.X[wanted]
        self.uncertainty, self.unchecked = self.uncertainty[wanted], self.unchecked[wanted]
        return freed

    def recover(self, neighbors: list[IntArray], free: BoolArray, directed: bool) -> tuple[int, int]:
        """Add free segments that lie on a line, and join lines that are one; return both numbers."""
        views, count = self.views, len(self.X)
        if count == 0:
            return 0, 0
        reach = _images_near_lines(self.line_of, views.image_idx, neighbors, count)
        forward = self.direction() if directed else np.zeros(count)
        hits, distances = [], []
        room, value = np.empty((4096, 2), np.int64), np.empty(4096)
        for i in range(len(views.camera)):
            rows = np.arange(views.pointers[i], views.pointers[i + 1])
            while True:
                needed = _find_on_lines(
                    views.camera[i], self.X, reach[i], rows, views.ends, views.sigma, views.usable, forward, GATE,
                    0.5, room, value,
                )  # fmt: skip
                if needed <= len(room):
                    break
                room, value = np.empty((2 * needed, 2), np.int64), np.empty(2 * needed)
            hits.append(room[:needed].copy())
            distances.append(value[:needed].copy())
        hit, distance = np.concatenate(hits), np.concatenate(distances)
        num_merged = self._merge(hit)
        merged_line = self._alias[hit[:, 0]]
        is_free = (self.line_of[hit[:, 1]] < 0) & free[hit[:, 1]]
        hit, distance, merged_line = hit[is_free], distance[is_free], merged_line[is_free]
        order = np.argsort(distance, kind="stable")
        segment, best = np.unique(hit[order, 1], return_index=True)
        self.line_of[segment] = merged_line[order][best]
        return len(segment), num_merged

    def direction(self) -> FloatArray:
        """(L,) +1 or -1: whether most observations run from the first end point to the second in the image."""
        views = self.views
        rows, _ = self._table()
        P, X = views.camera[views.image_idx[rows]], self.X[self.line_of[rows]]
        x = np.einsum("mij,mkj->mki", P[:, :, :3], X) + P[:, None, :, 3]
        x = x[..., :2] / x[..., 2:]
        along = ((x[:, 1] - x[:, 0]) * (views.ends[rows, 2:] - views.ends[rows, :2])).sum(-1)
        votes = np.zeros(len(self.X))
        np.add.at(votes, self.line_of[rows], np.sign(along))
        return np.sign(votes)

    def _merge(self, hit: IntArray) -> int:
        """Join line B to line A where A explains B's segments in most of B's images; A gives the start."""
        owner = self.line_of[hit[:, 1]]
        pair = (owner >= 0) & (owner != hit[:, 0])
        triples = np.column_stack([hit[pair, 0], owner[pair], self.views.image_idx[hit[pair, 1]]])
        self._alias = np.arange(len(self.X))
        if len(triples) == 0:
            return 0
        triples = np.unique(triples, axis=0)
        pairs, votes = np.unique(triples[:, :2], axis=0, return_counts=True)
        images = self.num_images()
        good = (votes >= 2) & (votes >= 0.6 * images[pairs[:, 1]])
        pairs, votes = pairs[good], votes[good]
        merged, is_target = 0, np.zeros(len(self.X), bool)
        for a, b in pairs[np.argsort(-votes, kind="stable")]:
            # Chains are left to the next round: a line is joined once, and only to one that was not joined itself.
            if self._alias[a] == a and self._alias[b] == b and not is_target[b]:
                self._alias[b], is_target[a] = a, True
                merged += 1
        member = self.line_of >= 0
        self.line_of[member] = self._alias[self.line_of[member]]
        return merged


def _images_near_lines(
    line_of: IntArray, image_idx: IntArray, neighbors: list[IntArray], num_lines: int
) -> list[IntArray]:
    """Lines to look for in each image: those seen in it or in a neighbour."""
    num_images = len(neighbors)
    rows = np.flatnonzero(line_of >= 0)
    seen: list[IntArray] = [np.empty(0, np.int64)] * num_images
    order = rows[np.argsort(image_idx[rows], kind="stable")]
    bounds = np.searchsorted(image_idx[order], np.arange(num_images + 1))
    for i in range(num_images):
        seen[i] = np.unique(line_of[order[bounds[i] : bounds[i + 1]]])
    return [np.unique(np.concatenate([seen[i], *(seen[j] for j in neighbors[i])])) for i in range(num_images)]
