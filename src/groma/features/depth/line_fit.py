# SPDX-License-Identifier: BSD-3-Clause
"""The compiled fit of lines to depth beside image segments: samples, a robust fit of each side, what the sides share.

The model is that of :mod:`groma.features.depth.lines`.
"""

from __future__ import annotations

import math

import numpy as np

from groma._numba import inline_kernel, kernel, loop

#: Values of ``DepthLines.support``.
NONE, SURFACE, CREASE, LEFT, RIGHT = range(5)

#: Samples along a segment at most, and across on either side: the size of arrays (cost: memory and time).
_ALONG, _ACROSS = 24, 3


@kernel
def _solve(A, b, solution, inverse):
    """Solve A x = b, A symmetric (3, 3), and invert A; return whether it can be done."""
    c0 = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2]
    c1 = A[0, 2] * A[1, 2] - A[0, 1] * A[2, 2]
    c2 = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    determinant = A[0, 0] * c0 + A[0, 1] * c1 + A[0, 2] * c2
    if not determinant > 1e-9 * A[0, 0] * A[1, 1] * A[2, 2]:
        return False
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = c0, c1, c2
    inverse[1, 1] = A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2]
    inverse[1, 2] = A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2]
    inverse[2, 2] = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    inverse[1, 0], inverse[2, 0], inverse[2, 1] = inverse[0, 1], inverse[0, 2], inverse[1, 2]
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= determinant
        solution[i] = inverse[i, 0] * b[0] + inverse[i, 1] * b[1] + inverse[i, 2] * b[2]
    return True


@kernel
def _median(values, first, last, scratch):
    """Median of values[first:last], which are left as they are."""
    count = last - first
    for i in range(count):
        value, j = values[first + i], i
        while j > 0 and scratch[j - 1] > value:
            scratch[j] = scratch[j - 1]
            j -= 1
        scratch[j] = value
    return scratch[count // 2]


@kernel
def _fit_side(t, d, rho, weight, count, inlier, shares, min_inliers, scratch, A, b, x, inverse):
    """Fit one side robustly; return the number of inliers and their mean squared whitened distance."""
    half = 0
    while half < count and t[half] < 0.5:
        half += 1
    if half < 3 or count - half < 3:
        return 0, 0.0
    early, late = _median(rho, 0, half, scratch), _median(rho, half, count, scratch)
    x[0], x[1], x[2] = 1.5 * early - 0.5 * late, 1.5 * late - 0.5 * early, 0.0
    inliers, chi = 0, 0.0
    for share in shares:
        A[:, :] = 0.0
        b[:] = 0.0
        inliers, chi = 0, 0.0
        for i in range(count):
            a0, a1, a2 = 1.0 - t[i], t[i], d[i]
            predicted = a0 * x[0] + a1 * x[1] + a2 * x[2]
            away = rho[i] - predicted
            w = weight[i]
            if not abs(away) < inlier / math.sqrt(w) + share * rho[i]:
                continue
            inliers += 1
            chi += w * away * away
            A[0, 0] += w * a0 * a0
            A[0, 1] += w * a0 * a1
            A[0, 2] += w * a0 * a2
            A[1, 1] += w * a1 * a1
            A[1, 2] += w * a1 * a2
            A[2, 2] += w * a2 * a2
            b[0] += w * a0 * rho[i]
            b[1] += w * a1 * rho[i]
            b[2] += w * a2 * rho[i]
        A[1, 0], A[2, 0], A[2, 1] = A[0, 1], A[0, 2], A[1, 2]
        if inliers < min_inliers or not _solve(A, b, x, inverse):
            return 0, 0.0
    return inliers, chi / inliers


@inline_kernel
def _sample_side(ends, n, sign, along, length, band, depth, noise, t, d, rho, weight):
    """Sample the depth on one side of a segment; return the number of samples."""
    near, far = band
    dx, dy = ends[n, 2] - ends[n, 0], ends[n, 3] - ends[n, 1]
    left_u, left_v = dy / length, -dx / length
    count = 0
    for i in range(along):
        at = (i + 0.5) / along
        for j in range(_ACROSS):
            across = sign * (near + (far - near) * j / (_ACROSS - 1.0))
            u = math.floor(ends[n, 0] + at * dx + across * left_u)
            v = math.floor(ends[n, 1] + at * dy + across * left_v)
            if u < 0 or v < 0 or u >= depth.shape[1] or v >= depth.shape[0]:
                continue
            z = float(depth[int(v), int(u)])
            if not (z > 0.0 and z <= noise[3]):
                continue
            # Where the pixel's centre really lies.
            pu, pv = u + 0.5 - ends[n, 0], v + 0.5 - ends[n, 1]
            t[count] = (pu * dx + pv * dy) / (length * length)
            d[count] = pu * left_u + pv * left_v
            rho[count] = 1.0 / z
            root = z * z / (noise[0] + noise[1] * (z - noise[2]) * (z - noise[2]))
            weight[count] = root * root
            count += 1
    return count


@inline_kernel
def _agreement(x, inverse, spread, limits):
    """Return what both sides have in common: nothing, a surface or a crease."""
    agree, agree_slope, agree_share, slope_share = limits
    floor = agree_share * max(x[0, 0], x[0, 1], x[1, 0], x[1, 1])
    c00 = spread * (inverse[0, 0, 0] + inverse[1, 0, 0]) + floor * floor
    c01 = spread * (inverse[0, 0, 1] + inverse[1, 0, 1])
    c11 = spread * (inverse[0, 1, 1] + inverse[1, 1, 1]) + floor * floor
    e0, e1 = x[0, 0] - x[1, 0], x[0, 1] - x[1, 1]
    distance = (e0 * e0 * c11 - 2.0 * e0 * e1 * c01 + e1 * e1 * c00) / (c00 * c11 - c01 * c01)
    if not distance < agree:
        return NONE
    floor = slope_share * (x[0, 0] + x[0, 1]) * 0.5
    gap = x[0, 2] - x[1, 2]
    slope = spread * (inverse[0, 2, 2] + inverse[1, 2, 2]) + floor * floor
    return SURFACE if gap * gap < agree_slope * slope else CREASE


@inline_kernel
def _join_sides(kind, A, b, joint, joint_b):
    """Write the normal equations of the line of both sides."""
    if kind == SURFACE:
        for i in range(len(joint_b)):
            joint_b[i] = b[0, i] + b[1, i]
            for j in range(len(joint_b)):
                joint[i, j] = A[0, i, j] + A[1, i, j]
        return
    # Each side keeps its slope: it is eliminated, and the informations on the line are added.
    joint[:, :] = 0.0
    joint_b[:] = 0.0
    for side in range(2):
        for i in range(2):
            ratio = A[side, i, 2] / A[side, 2, 2]
            joint_b[i] += b[side, i] - ratio * b[side, 2]
            for j in range(2):
                joint[i, j] += A[side, i, j] - ratio * A[side, j, 2]
    joint[2, 2] = 1.0


@loop
def fit_all(ends, depth, noise, correlation, gates, shares, inverse_depth, covariance, support, share):
    """Fit segments (N, 4); ``gates`` and ``shares`` are of :class:`DepthLineGates`.

    Writes inverse depths (N, 2), covariances (N, 2, 2), kinds (N,) and shares of inliers (N,).
    """
    band, min_share, min_length, inlier, min_inliers, limits = gates
    size = _ALONG * _ACROSS
    t, d, rho, weight = np.empty((2, size)), np.empty((2, size)), np.empty((2, size)), np.empty((2, size))
    scratch = np.empty(size)
    A, b, x = np.empty((2, 3, 3)), np.empty((2, 3)), np.empty((2, 3))
    inverse = np.empty((2, 3, 3))
    joint, joint_b, joint_x, joint_inverse = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((3, 3))
    good, chi, used = np.empty(2, np.bool_), np.empty(2), np.empty(2)
    for n in range(ends.shape[0]):
        support[n] = NONE
        share[n] = 0.0
        scale = 1.0
        inverse_depth[n, :] = 0.0
        covariance[n, :, :] = 0.0
        dx, dy = ends[n, 2] - ends[n, 0], ends[n, 3] - ends[n, 1]
        length = math.sqrt(dx * dx + dy * dy)
        if not length > min_length:
            continue
        along = min(max(int(length / 2.0), 6), _ALONG)
        for side in range(2):
            sign = 1.0 if side == 0 else -1.0
            count = _sample_side(
                ends, n, sign, along, length, band, depth, noise, t[side], d[side], rho[side], weight[side]
            )
            inliers, chi[side] = _fit_side(
                t[side], d[side], rho[side], weight[side], count, inlier, shares, min_inliers, scratch,
                A[side], b[side], x[side], inverse[side],
            )  # fmt: skip
            used[side] = inliers
            good[side] = inliers >= min_share * along * _ACROSS and inliers > 0.5 * count
            good[side] = good[side] and x[side, 0] > 0.0 and x[side, 1] > 0.0
        if not (good[0] or good[1]):
            continue
        if good[0] and good[1]:
            support[n] = _agreement(x, inverse, correlation * max(chi[0], chi[1], 1.0), limits)
        if support[n] != NONE:
            _join_sides(support[n], A, b, joint, joint_b)
            if not _solve(joint, joint_b, joint_x, joint_inverse):
                support[n] = NONE
                continue
            scale = correlation * max((chi[0] * used[0] + chi[1] * used[1]) / (used[0] + used[1]), 1.0)
            share[n] = (used[0] + used[1]) / (2.0 * along * _ACROSS)
        else:
            side = 0 if good[0] else 1
            if good[0] and good[1] and x[1, 0] + x[1, 1] > x[0, 0] + x[0, 1]:
                side = 1
            support[n] = LEFT + side
            for i in range(len(joint_x)):
                joint_x[i] = x[side, i]
                for j in range(len(joint_x)):
                    joint_inverse[i, j] = inverse[side, i, j]
            scale = correlation * max(chi[side], 1.0)
            share[n] = used[side] / (along * _ACROSS)
        for i in range(2):
            inverse_depth[n, i] = joint_x[i]
            for j in range(2):
                covariance[n, i, j] = scale * joint_inverse[i, j]
