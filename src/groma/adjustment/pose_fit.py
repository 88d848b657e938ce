# SPDX-License-Identifier: BSD-3-Clause
r"""The pose of one pinhole camera before a map that is held, without a problem being laid out for it.

In come tables, one row per measurement of points, lines and planes, and a prior; out comes the pose. Residuals,
weights and losses are those of :mod:`groma.factors.observations` under :mod:`groma.adjustment.assemble`, and so is the
minimum. There, laying out a problem takes ten times as long as solving it, which matters where a camera moves on.

Each row of a residual has a derivative a by the point P in the camera, or g by the moment of the line (m, d) as a
camera displaced by -t sees it, and by the left twist :math:`(\rho, \omega)`

.. math:: [\, a^\top,\; (P \times a)^\top \,], \qquad
          [\, (d \times g)^\top,\; (m \times g + d \times (g \times t))^\top \,].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from groma._numba import kernel, loop
from groma._ordering import copy
from groma._typing import FloatArray
from groma.estimators.batch_least_squares import solve_damped
from groma.factors.losses import Loss, loss_derivatives
from groma.factors.observations.line_reprojection import endpoint_distance, image_line_norm
from groma.factors.priors.pose_prior import compose_with_inverse, inverse_left_jacobian, pose_log
from groma.geometry.charts.chart import perpendicular_kernel
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.quaternion import exp_kernel, multiply_kernel, to_matrix_kernel
from groma.geometry.so3 import left_jacobian_kernel
from groma.solver.independent import STRETCH

#: Steps under one loss, the relative decrease of the cost that ends them, and the first damping.
MAX_STEPS, TOLERANCE, FIRST_DAMPING = 8, 1e-3, 1e-6
_SHORTER, _LONGER, _MOST, _LOWERED = STRETCH.shorter, STRETCH.longer, STRETCH.most, STRETCH.lowered
_SIX = (None,) * 6  # derived from the numbers of a motion
_CHART = POSE_CHARTS["left"]


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _add(r, J, rows, loss_tag, parameters, H, g):
    """Add a measurement of some whitened rows to the lower triangle of H and to g; return its share of the cost."""
    s = 0.0
    for k in range(rows):
        s += r[k] * r[k]
    rho, weight, _ = loss_derivatives(loss_tag, parameters, s)
    for k in range(rows):
        for a in range(6):
            g[a] += weight * J[k, a] * r[k]
            for b in range(a + 1):
                H[a, b] += weight * J[k, a] * J[k, b]
    return rho


@kernel
def _put(a0, a1, a2, P, weight, J, k):
    """Write the row of a derivative ``a`` by the point ``P`` in the camera."""
    J[k, 0], J[k, 1], J[k, 2] = weight * a0, weight * a1, weight * a2
    J[k, 3] = weight * (P[1] * a2 - P[2] * a1)
    J[k, 4] = weight * (P[2] * a0 - P[0] * a2)
    J[k, 5] = weight * (P[0] * a1 - P[1] * a0)


@kernel
def _put_line(L, t, g0, g1, g2, weight, J, k):
    """Write the row of a derivative g by the moment of the line ``L`` in the camera, seen from a camera at -``t``."""
    h0, h1, h2 = g1 * t[2] - g2 * t[1], g2 * t[0] - g0 * t[2], g0 * t[1] - g1 * t[0]
    J[k, 0] = weight * (L[4] * g2 - L[5] * g1)
    J[k, 1] = weight * (L[5] * g0 - L[3] * g2)
    J[k, 2] = weight * (L[3] * g1 - L[4] * g0)
    J[k, 3] = weight * (L[1] * g2 - L[2] * g1 + L[4] * h2 - L[5] * h1)
    J[k, 4] = weight * (L[2] * g0 - L[0] * g2 + L[5] * h0 - L[3] * h2)
    J[k, 5] = weight * (L[0] * g1 - L[1] * g0 + L[3] * h1 - L[4] * h0)


@loop
def _add_points(T, K, baseline, points, loss_tag, parameters, H, g, worst):
    """Sum points (N, 9): place, u, v, u in the right image, weight, depth, its weight; NaN and 0 where not measured."""
    P, r, J, cost = np.empty(3), np.empty(3), np.empty((3, 6)), 0.0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for k in range(3):
            P[k] = T[4 * k] * x + T[4 * k + 1] * y + T[4 * k + 2] * z + T[4 * k + 3]
        worst[i] = np.inf
        if not P[2] > 1e-12 * (abs(P[0]) + abs(P[1])):
            continue
        s, weight, rows = 1.0 / P[2], points[i, 6], 2 if np.isnan(points[i, 5]) else 3
        r[0] = weight * (K[0] * P[0] * s + K[2] - points[i, 3])
        r[1] = weight * (K[1] * P[1] * s + K[3] - points[i, 4])
        _put(K[0] * s, 0.0, -K[0] * P[0] * s * s, P, weight, J, 0)
        _put(0.0, K[1] * s, -K[1] * P[1] * s * s, P, weight, J, 1)
        if rows == 3:
            right = (P[0] - baseline) * s
            r[2] = weight * (K[0] * right + K[2] - points[i, 5])
            _put(K[0] * s, 0.0, -K[0] * right * s, P, weight, J, 2)
        worst[i] = max(abs(r[0]), abs(r[1]), abs(r[rows - 1]))
        cost += _add(r, J, rows, loss_tag, parameters, H, g)
        if points[i, 8] > 0.0:
            r[0] = points[i, 8] * (P[2] - points[i, 7])
            _put(0.0, 0.0, 1.0, P, points[i, 8], J, 0)
            cost += _add(r, J, 1, loss_tag, parameters, H, g)
    return cost


@loop
def _add_lines(T, K, offsets, lines, loss_tag, parameters, H, g, worst):
    """Sum lines (M, 18): (m, d), segment, weight, segment and weights of its ends in a second camera, which of two."""
    L, M, out, r, J, cost = np.empty(6), np.empty(6), np.empty((2, 8)), np.empty(2), np.empty((2, 6)), 0.0
    still = np.zeros(3)
    for i in range(lines.shape[0]):
        for k in range(3):
            L[k] = T[4 * k] * lines[i, 0] + T[4 * k + 1] * lines[i, 1] + T[4 * k + 2] * lines[i, 2]
            L[3 + k] = T[4 * k] * lines[i, 3] + T[4 * k + 1] * lines[i, 4] + T[4 * k + 2] * lines[i, 5]
        L[0] += T[7] * L[5] - T[11] * L[4]
        L[1] += T[11] * L[3] - T[3] * L[5]
        L[2] += T[3] * L[4] - T[7] * L[3]
        worst[i] = np.inf
        for second in range(2):
            if second and not lines[i, 15] > 0.0:
                continue
            t = offsets[np.int64(lines[i, 17])] if second else still
            M[0] = L[0] + t[1] * L[5] - t[2] * L[4]
            M[1] = L[1] + t[2] * L[3] - t[0] * L[5]
            M[2] = L[2] + t[0] * L[4] - t[1] * L[3]
            h = image_line_norm(M[0], M[1], M[2], K)
            if not h > 0.0:
                continue
            for end in range(2):
                u, v = lines[i, 6 + 5 * second + 2 * end], lines[i, 7 + 5 * second + 2 * end]
                weight = lines[i, 15 + end] if second else lines[i, 10]
                endpoint_distance(M[0], M[1], M[2], K, h, u, v, out, end)
                r[end] = weight * out[end, 0]
                _put_line(L, t, out[end, 1], out[end, 2], out[end, 3], weight, J, end)
            if not second:
                worst[i] = max(abs(r[0]), abs(r[1]))
            cost += _add(r, J, 2, loss_tag, parameters, H, g)
    return cost


@loop
def _add_planes(T, planes, loss_tag, parameters, H, g, worst):
    """Sum planes (K, 17): unit normal and offset in the world, the same as measured, square root of the information."""
    c, r, J, B = np.empty(3), np.empty(3), np.zeros((3, 6)), np.empty((2, 3))
    white, W, cost = np.empty(3), np.empty((3, 6)), 0.0
    for i in range(planes.shape[0]):
        sign = 0.0
        for k in range(3):
            c[k] = T[4 * k] * planes[i, 0] + T[4 * k + 1] * planes[i, 1] + T[4 * k + 2] * planes[i, 2]
            sign += c[k] * planes[i, 4 + k]
        sign = -1.0 if sign < 0.0 else 1.0
        for k in range(3):
            c[k] *= sign
        perpendicular_kernel(planes[i, 4], planes[i, 5], planes[i, 6], B)
        r[2] = sign * planes[i, 3] - (T[3] * c[0] + T[7] * c[1] + T[11] * c[2]) - planes[i, 7]
        for k in range(2):
            r[k] = B[k, 0] * c[0] + B[k, 1] * c[1] + B[k, 2] * c[2]
            J[k, 3] = c[1] * B[k, 2] - c[2] * B[k, 1]
            J[k, 4] = c[2] * B[k, 0] - c[0] * B[k, 2]
            J[k, 5] = c[0] * B[k, 1] - c[1] * B[k, 0]
        J[2, 0], J[2, 1], J[2, 2] = -c[0], -c[1], -c[2]
        worst[i] = 0.0
        for k in range(3):
            root = planes[i, 8 + 3 * k : 11 + 3 * k]
            white[k] = root[0] * r[0] + root[1] * r[1] + root[2] * r[2]
            worst[i] = max(worst[i], abs(white[k]))
            for a in range(6):
                W[k, a] = root[0] * J[0, a] + root[1] * J[1, a] + root[2] * J[2, a]
        cost += _add(white, W, 3, loss_tag, parameters, H, g)
    return cost


@loop
def _add_prior(T, prior, weights, H, g):
    """Sum a prior pose (12,) whose twist has independent errors."""
    E, r, J, cost = np.empty(12), np.empty(6), np.empty((6, 6)), 0.0
    compose_with_inverse(T, prior, E)
    pose_log(E, r)
    inverse_left_jacobian(r, J)
    for k in range(6):
        w = weights[k] * weights[k]
        cost += w * r[k] * r[k]
        for a in range(6):
            g[a] += w * J[k, a] * r[k]
            for b in range(a + 1):
                H[a, b] += w * J[k, a] * J[k, b]
    return cost


@loop
def _sum(pose, seen, loss_tag, parameters, H, g, worst):
    """Write the normal equations at a pose (7,), lower triangle; return the cost."""
    K, baseline, offsets, points, lines, planes, prior, prior_weight = seen
    T, R = np.empty(12), np.empty(9)
    to_matrix_kernel(pose, R)
    for i in range(3):
        for j in range(3):
            T[4 * i + j] = R[3 * i + j]
        T[4 * i + 3] = pose[4 + i]
    H[:, :], g[:] = 0.0, 0.0
    cost = _add_points(T, K, baseline, points, loss_tag, parameters, H, g, worst[0])
    if len(lines):
        cost += _add_lines(T, K, offsets, lines, loss_tag, parameters, H, g, worst[1])
    if len(planes):
        cost += _add_planes(T, planes, loss_tag, parameters, H, g, worst[2])
    if prior_weight.any():
        cost += _add_prior(T, prior, prior_weight, H, g)
    return 0.5 * cost


@kernel
def _move(pose, length, step, out):
    """Write the pose (7,) after ``length`` times a left twist (6,)."""
    xi, q, R, J = np.empty(6), np.empty(4), np.empty(9), np.empty((3, 3))
    for k in range(6):
        xi[k] = length * step[k]
    omega = xi[3:6]
    exp_kernel(omega, q)
    multiply_kernel(q, pose[:4], out[:4])
    to_matrix_kernel(q, R)
    left_jacobian_kernel(omega, J)
    for i in range(3):
        out[4 + i] = R[3 * i] * pose[4] + R[3 * i + 1] * pose[5] + R[3 * i + 2] * pose[6]
        out[4 + i] += J[i, 0] * xi[0] + J[i, 1] * xi[1] + J[i, 2] * xi[2]
    size = 1.0 / math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2] + out[3] * out[3])
    for k in range(4):
        out[k] *= size


@loop
def _fit(pose, seen, loss_tag, parameters):
    """Move a pose (7,) to where it fits best."""
    worst = np.empty(len(seen[3])), np.empty(len(seen[4])), np.empty(len(seen[5]))
    H, g, L, step = np.empty((3, 6, 6)), np.empty((3, 6)), np.empty((6, 6)), np.empty(6)
    tried, other = np.empty(7), np.empty(7)
    here, there, beyond = 0, 1, 2
    cost = _sum(pose, seen, loss_tag, parameters, H[here], g[here], worst)
    damping, growth = FIRST_DAMPING, 2.0
    for _ in range(MAX_STEPS):
        fell, promised, found = 0.0, np.inf, np.inf
        if solve_damped(H[here], -g[here], damping, L, step, _SIX):
            promised = 0.0
            for k in range(6):
                promised += 0.5 * step[k] * (damping * step[k] * H[here, k, k] - g[here, k])
            _move(pose, 1.0, step, tried)
            found = _sum(tried, seen, loss_tag, parameters, H[there], g[there], worst)
            ratio = (cost - found) / max(promised, 1e-300)
            if promised > TOLERANCE * cost and not _SHORTER <= ratio <= _LONGER:
                _move(pose, 1.0 / min(max(2.0 - ratio, 1.0 / _MOST), _MOST), step, other)
                farther = _sum(other, seen, loss_tag, parameters, H[beyond], g[beyond], worst)
                if farther < found:
                    copy(other, tried)
                    found = farther
                    there, beyond = beyond, there
            fell = cost - found
        before = cost
        if fell > 0.0:
            copy(tried, pose)
            cost = found
            here, there = there, here
            damping, growth = damping / _LOWERED, 2.0
        else:
            fell, damping, growth = promised, damping * growth, 2.0 * growth
        if fell <= TOLERANCE * before:
            break


# ------------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True)
class SeenMap:
    """What a camera sees of a map that is held, and where it was expected; made by :func:`seen_map`."""

    #: (4,) fx, fy, cx, cy; distance of the right camera along x.
    camera: FloatArray
    baseline: float
    #: (2, 3) displacements from which inverse depths of lines are compared.
    offsets: FloatArray
    #: (N, 9), (M, 18), (K, 17): see the kernels.
    points: FloatArray
    lines: FloatArray
    planes: FloatArray
    #: (12,) pose that was expected, and (6,) inverse standard deviations of its left twist; zeros for none.
    prior: FloatArray
    prior_weight: FloatArray

    @property
    def tables(self) -> tuple:
        """All of them, as compiled loops take them."""
        return tuple(vars(self).values())


@dataclass(frozen=True)
class Equations:
    """Normal equations at a pose: cost, information (6, 6), gradient (6,)."""

    cost: float
    H: FloatArray
    g: FloatArray
    #: Largest row of each point, line and plane, in standard deviations; infinite where the camera cannot see it.
    worst: tuple[FloatArray, FloatArray, FloatArray]


def point_rows(
    xyz: FloatArray, pixel: FloatArray, sigma: FloatArray, right: FloatArray, depth: FloatArray, depth_sigma: FloatArray
) -> FloatArray:
    """Return the table of points: places (N, 3), pixels (N, 2), columns in the right image and depths, or NaN (N,)."""
    weight = np.where(np.isfinite(depth), 1.0 / depth_sigma, 0.0)
    return np.column_stack([xyz, pixel, right, 1.0 / sigma, depth, weight])


def line_rows(
    plucker: FloatArray, ends: FloatArray, sigma: FloatArray, inverse_depth: FloatArray, inverse_sigma: FloatArray,
    camera: FloatArray, baseline: float,
) -> FloatArray:  # fmt: skip
    """Return the table of lines: places (M, 6), segments (M, 4), inverse depths of their ends, or NaN (M, 2).

    A second camera, displaced by ``baseline`` across the segment, sees an end at inverse depth w displaced by f b w.
    """
    way, rows = np.abs(ends[:, 2:] - ends[:, :2]), np.arange(len(ends))
    axis = (way[:, 0] > way[:, 1]).astype(np.int64)
    scale = camera[axis, None] * baseline
    shifted = ends.copy()
    for end in range(2):
        shifted[rows, 2 * end + axis] -= (scale * inverse_depth)[:, end]
    known = np.isfinite(inverse_depth).all(axis=1, keepdims=True)
    weight = np.where(known, 1.0 / np.hypot(scale * inverse_sigma, sigma[:, None]), 0.0)
    return np.column_stack([plucker, ends, 1.0 / sigma, shifted, weight, axis.astype(np.float64)])


def plane_rows(hesse: FloatArray, measured: FloatArray, sqrt_information: FloatArray) -> FloatArray:
    """Return the table of planes: in the world and in the camera (K, 4), unit normals, and (K, 3, 3)."""
    return np.column_stack([hesse, measured, sqrt_information.reshape(-1, 9)])


def seen_map(
    camera: FloatArray, baselines: tuple[float, float], points: FloatArray, lines: FloatArray, planes: FloatArray,
    prior: FloatArray, prior_sigma: FloatArray,
) -> SeenMap:  # fmt: skip
    """Return what a camera sees of a map: its tables, the baselines of pairs and of :func:`line_rows`, a prior (7,)."""
    offsets = np.array([[-baselines[1], 0.0, 0.0], [0.0, -baselines[1], 0.0]])
    pose = _CHART.ambient(prior[None])[0]
    return SeenMap(camera, baselines[0], offsets, points, lines, planes, pose, 1.0 / prior_sigma)


def equations_at(seen: SeenMap, pose: FloatArray, loss: Loss) -> Equations:
    """Return the normal equations of all that is seen, at a pose (7,)."""
    H, g = np.zeros((6, 6)), np.zeros(6)
    worst = np.empty(len(seen.points)), np.empty(len(seen.lines)), np.empty(len(seen.planes))
    cost = _sum(np.asarray(pose, np.float64), seen.tables, loss.tag, loss.parameters, H, g, worst)
    return Equations(cost, H + np.tril(H, -1).T, g, worst)


def without_prior(seen: SeenMap) -> SeenMap:
    """Return what is seen alone."""
    return replace(seen, prior_weight=np.zeros(6))


def fit_pose(seen: SeenMap, start: FloatArray, loss: Loss) -> FloatArray:
    """Return the pose (7,) that fits best from a start: damped least squares, under a robust loss."""
    pose = np.array(start, dtype=np.float64)
    _fit(pose, seen.tables, loss.tag, loss.parameters)
    return pose
