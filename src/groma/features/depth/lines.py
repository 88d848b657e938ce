# SPDX-License-Identifier: BSD-3-Clause
r"""Lines in space from image segments and a depth image.

Along an image segment from t = 0 to t = 1 the inverse depth of a line is linear, and on a flat surface beside it, at
the signed distance d across, it is

.. math:: \rho(t, d) = (1 - t)\,\rho_1 + t\,\rho_2 + \gamma\, d .

Depth at the edge itself is the worst there is: a mixture of both sides, or a hole. It is therefore sampled at some
distances on either side, each side is fitted on its own, and :math:`\rho_1, \rho_2` extrapolate to the segment.

* Both sides agree in :math:`\rho_1, \rho_2`, and in the slope across: the line is drawn on a surface, and all samples
  are used.
* They agree, but not in the slope: a crease; its two surfaces share the line.
* They do not agree: an edge where one surface hides another. It belongs to the nearer one.
* One side has no depth: the other is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._numba import kernel, loop
from groma._typing import BoolArray, FloatArray
from groma.errors import InputError, ShapeError
from groma.features.depth.noise import DepthNoise, as_depth, as_pinhole
from groma.gates import gate

#: Values of ``DepthLines.support``.
NONE, SURFACE, CREASE, LEFT, RIGHT = range(5)

# --------------------------------------------------------------------------------------------------------- Kernels

#: Samples along a segment at most, and across on either side: the size of arrays.
_ALONG, _ACROSS = 24, 3


@dataclass(frozen=True)
class DepthLineGates:
    """Where depth is sampled beside a segment, and what the samples must agree on."""

    near: float = gate(
        1.5, "px", "depth is sampled from this distance on", "chosen on Kinect images: edges are smeared"
    )
    far: float = gate(6.5, "px", "and up to this distance", "chosen on Kinect images")
    min_share: float = gate(0.35, "share", "share of the samples of a side on its fit", "chosen on Kinect images")
    max_relative_sigma: float = gate(
        0.05, "share", "noise of the depth at an end, of the depth", "chosen on Kinect images"
    )
    inlier: float = gate(3.0, "sigma", "samples within are on the fit", "derived from normal noise: 1 in 370")
    shares: tuple[float, ...] = gate(
        (0.04, 0.015, 0.006, 0.0),
        "share",
        "added to it from round to round, of the inverse depth",
        "chosen on Kinect images",
    )
    agree: float = gate(
        -2.0 * math.log(1e-3),
        "sigma squared",
        "two sides agree in a line",
        "derived from chi-square, 2 numbers: 1 in 1000",
    )
    agree_slope: float = gate(9.0, "sigma squared", "they agree in the slope", "derived from normal noise: 1 in 370")
    agree_share: float = gate(0.006, "share", "on top of noise, of the inverse depth", "chosen on Kinect images")
    slope_share: float = gate(0.0015, "share / px", "the same for the slope", "chosen on Kinect images")
    min_length: float = gate(4.0, "px", "shorter segments have no line", "derived from two samples a half")
    min_inliers: int = gate(8, "samples", "samples on the fit of a side", "derived from 3 unknowns")


#: The defaults.
DEPTH_LINES = DepthLineGates()


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


@loop
def _fit_all(ends, depth, noise, correlation, gates, shares, inverse_depth, covariance, support, share):
    """Fit segments (N, 4); ``gates`` and ``shares`` are of :class:`DepthLineGates`.

    Writes inverse depths (N, 2), covariances (N, 2, 2), kinds (N,) and shares of inliers (N,).
    """
    near, far, min_share, min_length, inlier, min_inliers, agree, agree_slope, agree_share, slope_share = gates
    size = _ALONG * _ACROSS
    t, d, rho, weight = np.empty((2, size)), np.empty((2, size)), np.empty((2, size)), np.empty((2, size))
    scratch = np.empty(size)
    A, b, x = np.empty((2, 3, 3)), np.empty((2, 3)), np.empty((2, 3))
    inverse = np.empty((2, 3, 3))
    joint, joint_b, joint_x, joint_inverse = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((3, 3))
    good, chi, used = np.empty(2, np.bool_), np.empty(2), np.empty(2)
    for n in range(ends.shape[0]):
        support[n] = 0
        share[n] = 0.0
        scale = 1.0
        inverse_depth[n, :] = 0.0
        covariance[n, :, :] = 0.0
        dx, dy = ends[n, 2] - ends[n, 0], ends[n, 3] - ends[n, 1]
        length = math.sqrt(dx * dx + dy * dy)
        if not length > min_length:
            continue
        along = min(max(int(length / 2.0), 6), _ALONG)
        left_u, left_v = dy / length, -dx / length
        for side in range(2):
            sign = 1.0 if side == 0 else -1.0
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
                    t[side, count] = (pu * dx + pv * dy) / (length * length)
                    d[side, count] = pu * left_u + pv * left_v
                    rho[side, count] = 1.0 / z
                    root = z * z / (noise[0] + noise[1] * (z - noise[2]) * (z - noise[2]))
                    weight[side, count] = root * root
                    count += 1
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
            # Do the sides agree in the line?
            spread = correlation * max(chi[0], chi[1], 1.0)
            floor = agree_share * max(x[0, 0], x[0, 1], x[1, 0], x[1, 1])
            c00 = spread * (inverse[0, 0, 0] + inverse[1, 0, 0]) + floor * floor
            c01 = spread * (inverse[0, 0, 1] + inverse[1, 0, 1])
            c11 = spread * (inverse[0, 1, 1] + inverse[1, 1, 1]) + floor * floor
            e0, e1 = x[0, 0] - x[1, 0], x[0, 1] - x[1, 1]
            distance = (e0 * e0 * c11 - 2.0 * e0 * e1 * c01 + e1 * e1 * c00) / (c00 * c11 - c01 * c01)
            if distance < agree:
                floor = slope_share * (x[0, 0] + x[0, 1]) * 0.5
                gap = x[0, 2] - x[1, 2]
                slope = spread * (inverse[0, 2, 2] + inverse[1, 2, 2]) + floor * floor
                if gap * gap < agree_slope * slope:
                    support[n] = 1
                    joint[:] = A[0] + A[1]
                    joint_b[:] = b[0] + b[1]
                else:
                    # Each side keeps its slope: it is eliminated, and the informations on the line are added.
                    support[n] = 2
                    joint[:, :] = 0.0
                    joint_b[:] = 0.0
                    for side in range(2):
                        for i in range(2):
                            ratio = A[side, i, 2] / A[side, 2, 2]
                            joint_b[i] += b[side, i] - ratio * b[side, 2]
                            for j in range(2):
                                joint[i, j] += A[side, i, j] - ratio * A[side, j, 2]
                    joint[2, 2] = 1.0
                if not _solve(joint, joint_b, joint_x, joint_inverse):
                    support[n] = 0
                    continue
                scale = correlation * max((chi[0] * used[0] + chi[1] * used[1]) / (used[0] + used[1]), 1.0)
                share[n] = (used[0] + used[1]) / (2.0 * along * _ACROSS)
        if support[n] == 0:
            side = 0 if good[0] else 1
            if good[0] and good[1] and x[1, 0] + x[1, 1] > x[0, 0] + x[0, 1]:
                side = 1
            support[n] = 3 + side
            joint_x[:] = x[side]
            joint_inverse[:] = inverse[side]
            scale = correlation * max(chi[side], 1.0)
            share[n] = used[side] / (along * _ACROSS)
        for i in range(2):
            inverse_depth[n, i] = joint_x[i]
            for j in range(2):
                covariance[n, i, j] = scale * joint_inverse[i, j]


# ---------------------------------------------------------------------------------------------------------- Public


@dataclass(frozen=True, eq=False)
class DepthLines:
    """Lines in the camera frame, one row per segment; rows without depth are zero."""

    #: (N,) whether there is a line.
    good: BoolArray
    #: (N,) what it was fitted to: ``NONE``, ``SURFACE``, ``CREASE``, or one side of the segment, ``LEFT``, ``RIGHT``.
    support: npt.NDArray[np.int8]
    #: (N, 2, 3) the points of the line at the ends of the segment, metres.
    end_points: FloatArray
    #: (N, 6, 6) their covariance, of rank 4: depth at both ends, and the position of the segment across itself.
    covariances: FloatArray
    #: (N, 2) inverse depths at the ends and (N, 2, 2) their covariance, one over metres.
    inverse_depth: FloatArray
    inverse_depth_covariances: FloatArray
    #: (N,) share of the samples, of one side or of both, that lie on the fit.
    inlier_share: FloatArray

    def __len__(self) -> int:
        return len(self.good)

    @property
    def plucker(self) -> FloatArray:
        """(N, 6) lines (m, d), d from the first to the second end point, of any scale; zero where there is none."""
        first, second = self.end_points[:, 0], self.end_points[:, 1]
        return np.hstack([np.cross(first, second), second - first])


def fit_depth_lines(
    ends: npt.ArrayLike,
    depth: npt.NDArray[np.floating],
    pinhole: npt.ArrayLike,
    noise: DepthNoise | None = None,
    sigma: npt.ArrayLike = 0.3,
    gates: DepthLineGates = DEPTH_LINES,
) -> DepthLines:
    r"""Fit lines in space to image segments by the depth on both of their sides.

    .. math:: X_i = r_i / \rho_i, \qquad
        \mathrm{d}X_i = -\frac{r_i}{\rho_i^2}\, \mathrm{d}\rho_i + \frac{\nu}{\rho_i}\, \mathrm{d}s_i

    with the rays :math:`r_i` of the ends, and :math:`\nu` the change of a ray for a pixel across the segment.

    Parameters
    ----------
    ends : (N, 4) float
        Segments u1 v1 u2 v2, pixels; the first pixel's centre is (0.5, 0.5).
    depth : (H, W) float
        Depth, metres; 0 where unknown.
    pinhole : (4,) float
        fx, fy, cx, cy.
    noise : DepthNoise, optional
        Errors of depth.
    sigma : float or (N,) float
        Standard deviation of the ends across the segments, pixels.
    gates : DepthLineGates
        Where depth is sampled, and what the samples must agree on.

    Returns
    -------
    DepthLines
        One row per segment.

    Raises
    ------
    ShapeError, InputError
        If arguments are not usable.

    Notes
    -----
    A segment whose nearer side has no depth takes that of the farther one; nothing in one image tells.
    """
    segments = np.ascontiguousarray(ends, np.float64)
    if segments.ndim != 2 or segments.shape[1] != 4:
        raise ShapeError(f"ends must have shape (N, 4): u1 v1 u2 v2; got {segments.shape}.")
    if not np.isfinite(segments).all() or not 0 <= gates.near < gates.far:
        raise InputError(f"ends must be finite and 0 <= near < far; got near {gates.near}, far {gates.far}.")
    image, camera, noise = as_depth(depth), as_pinhole(pinhole), noise or DepthNoise()
    across = np.broadcast_to(np.asarray(sigma, np.float64), (len(segments),))
    count = len(segments)
    inverse_depth, covariance = np.empty((count, 2)), np.empty((count, 2, 2))
    support, share = np.empty(count, np.int8), np.empty(count)
    own = (
        gates.near, gates.far, gates.min_share, gates.min_length, gates.inlier, float(gates.min_inliers), gates.agree,
        gates.agree_slope, gates.agree_share, gates.slope_share,
    )  # fmt: skip
    _fit_all(
        segments, image, noise.numbers, noise.correlation, own, np.array(gates.shares), inverse_depth, covariance,
        support, share,
    )  # fmt: skip
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    good = (support > 0) & (inverse_depth > 1.0 / noise.max_depth).all(axis=1)
    good &= (variance < (gates.max_relative_sigma * inverse_depth) ** 2).all(axis=1)
    support[~good] = NONE
    for values in (inverse_depth, covariance, share):
        values[~good] = 0.0

    z = np.where(good[:, None], 1.0 / np.where(good[:, None], inverse_depth, 1.0), 0.0)
    pixels = segments.reshape(-1, 2, 2)
    rays = np.concatenate([(pixels - camera[2:]) / camera[:2], np.ones((count, 2, 1))], axis=2)
    points = rays * z[:, :, None]
    # What is common to all depths: a shift of both ends, and a tilt about the middle; both zero where there is no line.
    half = 0.5 * np.linalg.norm(points[:, 1] - points[:, 0], axis=1, keepdims=True)
    for common in (noise.shift * inverse_depth**2, noise.tilt * half * inverse_depth**2 * [-1.0, 1.0]):
        covariance += common[:, :, None] * common[:, None, :]
    direction = pixels[:, 1] - pixels[:, 0]
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    normal = np.column_stack([direction[:, 1], -direction[:, 0]]) / camera[:2]
    motion = np.zeros((count, 2, 3, 4))  # of an end by both inverse depths and by both shifts across
    for end in range(2):
        motion[:, end, :, end] = -rays[:, end] * (z[:, end] ** 2)[:, None]
        motion[:, end, :2, 2 + end] = normal * (z[:, end] * across)[:, None]
    flat = motion.reshape(count, 6, 4)
    inner = np.zeros((count, 4, 4))
    inner[:, :2, :2] = covariance
    inner[:, 2, 2] = inner[:, 3, 3] = 1.0
    return DepthLines(
        good=good,
        support=support,
        end_points=points,
        covariances=flat @ inner @ flat.transpose(0, 2, 1),
        inverse_depth=inverse_depth,
        inverse_depth_covariances=covariance,
        inlier_share=share,
    )


__all__ = ["CREASE", "LEFT", "NONE", "RIGHT", "SURFACE", "DepthLineGates", "DepthLines", "fit_depth_lines"]
