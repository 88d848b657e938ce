# SPDX-License-Identifier: BSD-3-Clause
"""Loops of the plane search over points with packed covariances: fit, selection by distance, connected parts.

Covariances are packed as (xx, xy, xz, yy, yz, zz). ``features`` is the tuple of arrays of
:class:`groma.estimators._plane_candidates.Features`, in which near points are together; ``rows`` are the points that
take part, in their order. ``mark`` arrays have an entry per point, -1 on entry and again on return. Each ``BALL``
points share a row of ``balls``: center, radius, and a bound of the variances. Balls that a plane does not come near are
passed over, so that the loops look at what is near it, not at the whole scene.
"""

from __future__ import annotations

import math

import numpy as np

from groma._numba import kernel, loop
from groma._trees import ROUNDING, boxes_loop, nearest_loop

#: Points in a ball (cost: time only).
BALL = 64
#: Sweeps of Jacobi rotations: convergence is quadratic, four are enough (cost: none are made after convergence).
_SWEEPS = 12


@kernel
def variance_kernel(c, n0, n1, n2):
    """Variance along a normal."""
    return n0 * (n0 * c[0] + 2.0 * (n1 * c[1] + n2 * c[2])) + n1 * (n1 * c[3] + 2.0 * n2 * c[4]) + n2 * n2 * c[5]


@kernel
def height_kernel(p, plane):
    return p[0] * plane[0] + p[1] * plane[1] + p[2] * plane[2] + plane[3]


@kernel
def lies_on_kernel(i, places, packed, plane, gate):
    """Whether the squared distance of a point from a plane is below a multiple of its variance."""
    height = height_kernel(places[i], plane)
    return height * height < gate * max(variance_kernel(packed[i], plane[0], plane[1], plane[2]), 1e-300)


@kernel
def least_axis_kernel(A, V):
    """Column of V that is the eigenvector of the least eigenvalue of a symmetric A (3, 3), which is overwritten."""
    for i in range(3):
        for j in range(3):
            V[i, j] = 1.0 if i == j else 0.0
    for step in range(3 * _SWEEPS):
        beside = A[0, 1] ** 2 + A[0, 2] ** 2 + A[1, 2] ** 2
        if not beside > 1e-33 * (A[0, 0] ** 2 + A[1, 1] ** 2 + A[2, 2] ** 2):
            break
        p, q = step % 3 // 2, 1 + (step % 3 + 1) // 2
        if A[p, q] == 0.0:
            continue
        turn = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
        t = 1.0 / (abs(turn) + math.sqrt(turn * turn + 1.0))
        if turn < 0.0:
            t = -t
        c = 1.0 / math.sqrt(t * t + 1.0)
        s = t * c
        for k in range(3):
            a, b = A[k, p], A[k, q]
            A[k, p], A[k, q] = c * a - s * b, s * a + c * b
        for k in range(3):
            a, b = A[p, k], A[q, k]
            A[p, k], A[q, k] = c * a - s * b, s * a + c * b
        for k in range(3):
            a, b = V[k, p], V[k, q]
            V[k, p], V[k, q] = c * a - s * b, s * a + c * b
    least = 0
    for k in range(1, 3):
        if A[k, k] < A[least, least]:
            least = k
    return least


@loop
def fit_loop(places, packed, rows, weight, iterations, plane, center, precision):
    """Plane (4,) of least weighted squares through rows, its centroid (3,), and the weights over variances (M,)."""
    tiny = 2.2250738585072014e-308
    A, V = np.empty((3, 3)), np.empty((3, 3))
    n0 = n1 = n2 = 0.0
    last = False
    for step in range(iterations + 1):
        total = c0 = c1 = c2 = 0.0
        for k in range(len(rows)):
            i = rows[k]
            if step == 0:
                variance = (packed[i, 0] + packed[i, 3] + packed[i, 5]) / 3.0
            else:
                variance = variance_kernel(packed[i], n0, n1, n2)
            p = weight[k] / max(variance, tiny)
            precision[k] = p
            total += p
            c0 += p * places[i, 0]
            c1 += p * places[i, 1]
            c2 += p * places[i, 2]
        center[0], center[1], center[2] = c0 / total, c1 / total, c2 / total
        if last or step == iterations:
            break
        s00 = s01 = s02 = s11 = s12 = s22 = 0.0
        for k in range(len(rows)):
            i, p = rows[k], precision[k]
            x, y, z = places[i, 0] - center[0], places[i, 1] - center[1], places[i, 2] - center[2]
            s00 += p * x * x
            s01 += p * x * y
            s02 += p * x * z
            s11 += p * y * y
            s12 += p * y * z
            s22 += p * z * z
        A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2] = s00, s01, s02, s11, s12, s22
        A[1, 0], A[2, 0], A[2, 1] = s01, s02, s12
        least = least_axis_kernel(A, V)
        last = abs(n0 * V[0, least] + n1 * V[1, least] + n2 * V[2, least]) > 1.0 - 1e-15
        n0, n1, n2 = V[0, least], V[1, least], V[2, least]
    sign = n0
    if abs(n1) > abs(sign):
        sign = n1
    if abs(n2) > abs(sign):
        sign = n2
    if sign < 0.0:
        n0, n1, n2 = -n0, -n1, -n2
    plane[0], plane[1], plane[2] = n0, n1, n2
    plane[3] = -(n0 * center[0] + n1 * center[1] + n2 * center[2])


@loop
def near_loop(places, packed, rows, plane, limit, out):
    """Write the rows whose squared distance from a plane is below ``limit`` variances; return how many."""
    count = 0
    for k in range(len(rows)):
        if lies_on_kernel(rows[k], places, packed, plane, limit):
            out[count] = rows[k]
            count += 1
    return count


@loop
def near_free_loop(places, packed, balls, labels, plane, limit, out):
    """As :func:`near_loop`, of all points without a label."""
    count = 0
    for b in range(len(balls)):
        height = abs(height_kernel(balls[b], plane)) - balls[b, 3]
        if height > 0.0 and height * height >= limit * balls[b, 4]:
            continue
        for i in range(b * BALL, min((b + 1) * BALL, len(places))):
            if labels[i] < 0 and lies_on_kernel(i, places, packed, plane, limit):
                out[count] = i
                count += 1
    return count


@loop
def layer_loop(places, balls, plane, band, out):
    """Write the points nearer to a plane than ``band``; return how many."""
    count = 0
    for b in range(len(balls)):
        if abs(height_kernel(balls[b], plane)) - balls[b, 3] >= band:
            continue
        for i in range(b * BALL, min((b + 1) * BALL, len(places))):
            if abs(height_kernel(places[i], plane)) < band:
                out[count] = i
                count += 1
    return count


@loop
def connected_loop(places, rows, tested, which, spacing, link, plane, out):
    """Whether tested points (N, 3), projected to a plane, are within a multiple of spacings (N,) of rows of places.

    Only those ``which`` (K,) are tested; ``out`` (K,) is filled.
    """
    flat, at = np.empty((len(rows), 3)), np.empty(3)
    nearest, squared = np.empty(1, np.int64), np.empty(1)
    for k in range(len(rows)):
        height = height_kernel(places[rows[k]], plane)
        for c in range(3):
            flat[k, c] = places[rows[k], c] - height * plane[c]
    boxes, first = boxes_loop(flat)
    for k in range(len(which)):
        height, reach = height_kernel(tested[which[k]], plane), link * spacing[which[k]]
        for c in range(3):
            at[c] = tested[which[k], c] - height * plane[c]
        found = nearest_loop(flat, boxes, first, at, reach * reach * ROUNDING, nearest, squared)
        out[k] = found > 0 and math.sqrt(squared[0]) <= reach


@kernel
def _root_kernel(parent, k):
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@kernel
def _join_kernel(parent, k, j):
    a, b = _root_kernel(parent, k), _root_kernel(parent, j)
    parent[max(a, b)] = min(a, b)


@loop
def linked_loop(places, spacing, partner, neighbours, rows, rank, reach, mark, parent):
    """Link rows to their nearest: ``parent`` (M,) gets the first row of the part that each is in.

    Two are linked if one is among the nearest ``rank`` of the other and not farther than ``reach`` times the larger of
    their spacings, and if they are the two ends of a segment. ``mark`` holds the position of each row.
    """
    number, width, widest = len(rows), min(rank + 1, len(rows)), 0.0
    nearest, squared = np.empty(width, np.int64), np.empty(width)
    points, boxes, first = np.empty((number, 3)), np.empty((0, 6)), np.empty(0, np.int64)
    for k in range(number):
        parent[k] = k
        widest = max(widest, spacing[rows[k]])
        for c in range(3):
            points[k, c] = places[rows[k], c]
    for k in range(number):
        i = rows[k]
        if mark[partner[i]] >= 0:
            _join_kernel(parent, k, mark[partner[i]])
        count = 0
        for m in range(neighbours.shape[1]):
            if count < width and mark[neighbours[i, m]] >= 0:
                nearest[count] = mark[neighbours[i, m]]
                count += 1
        if count < width:  # the others among its neighbours do not take part
            if len(boxes) == 0:
                boxes, first = boxes_loop(points)
            bound = (reach * widest) ** 2 * ROUNDING
            count = nearest_loop(points, boxes, first, points[k], bound, nearest, squared)
        for m in range(count):
            j = nearest[m]
            x, y, z = points[j, 0] - points[k, 0], points[j, 1] - points[k, 1], points[j, 2] - points[k, 2]
            if math.sqrt(x * x + y * y + z * z) <= reach * max(spacing[i], spacing[rows[j]]):
                _join_kernel(parent, k, j)
    for k in range(number):
        parent[k] = parent[parent[k]]  # parents come before their children


@loop
def connected_part_loop(places, spacing, partner, carrier, neighbours, rows, held, rank, reach, mark, out):
    """Write the connected part of rows with most of what is ``held`` (K,); its size, and without what segments carry.

    See :func:`linked_loop`. Fewer than three rows are one part with nothing in it.
    """
    number = len(rows)
    if number < 3:  # derived from three that fix a plane
        for k in range(number):
            out[k] = rows[k]
        return number, 0
    parent, size = np.empty(number, np.int64), np.zeros(number, np.int64)
    for k in range(number):
        mark[rows[k]] = k
    linked_loop(places, spacing, partner, neighbours, rows, rank, reach, mark, parent)
    for k in range(len(held)):
        if mark[held[k]] >= 0:
            size[parent[mark[held[k]]]] += 1
    best = 0
    for k in range(1, number):
        if size[k] > size[best]:
            best = k
    if size[best] == 0:
        best = -1
    for k in range(number):
        mark[rows[k]] = k if parent[k] == best else -1
    count = independent = 0
    for k in range(number):
        i = rows[k]
        if parent[k] == best:
            out[count] = i
            count += 1
            if carrier[i] < 0 or mark[carrier[i]] < 0:
                independent += 1
    for k in range(number):
        mark[rows[k]] = -1
    return count, independent
