# SPDX-License-Identifier: BSD-3-Clause
r"""Segments whose positions agree are joined into groups, the first form of a line.

In come the positions of single segments and the segments that support each of them. An edge links two segments if the
place of each projects onto the other's line within

.. math:: d^2 \le \chi^2\,\big(\sigma_b^2 ((1 - t)^2 + t^2) + \sigma_a^2 + (\partial d/\partial q)^2 \sigma_q^2\big)

at both ends, with t the position along the other segment. Edges are taken best first (union-find); two groups are
joined only if their representatives, the members of highest rank, pass the same test. Out come the members of all
groups and the representative of each.
"""

from __future__ import annotations

import numpy as np

from groma._numba import kernel, loop
from groma._typing import BoolArray, FloatArray, IntArray
from groma.execution import map_ranges
from groma.mapping.lines.hypotheses.positions import SegmentPositions
from groma.mapping.lines.views import LineViews

#: Pairs of segments compared by one piece of work (cost: time only).
_EDGES_AT_ONCE = 8192


# ------------------------------------------------------------------------------------------------------------ Kernels
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
    """Whether the positions of two segments explain each other."""
    for _ in range(2):
        if not _explains(
            camera[image[r]], center[image[s]], ray[s], q[s], covariance[s, 0], covariance[s, 2], sigma[s], line[r],
            ends[r], sigma[r], gate,
        ):  # fmt: skip
            return False
        s, r = r, s
    return True


@kernel
def _root(parent, s):
    while parent[s] != s:
        parent[s] = parent[parent[s]]
        s = parent[s]
    return s


@loop
def _join(edges, camera, center, image, ray, q, covariance, sigma, line, ends, gate, agree, rank, parent):
    """Whether the positions at both ends of each edge explain each other.

    With ``parent``, those of the groups that both ends are in, which are then joined, best edges first; a group stands
    for itself by its member of highest rank.
    """
    for e in range(len(edges)):
        s, r = edges[e, 0], edges[e, 1]
        if len(parent):
            s, r = _root(parent, s), _root(parent, r)
        agree[e] = s != r and _agree(s, r, camera, center, image, ray, q, covariance, sigma, line, ends, gate)
        if len(parent) and agree[e]:
            if rank[s] >= rank[r]:
                parent[r] = s
            else:
                parent[s] = r
    for s in range(len(parent)):
        parent[s] = _root(parent, s)


# ------------------------------------------------------------------------------------------------------------- Public
def link(
    views: LineViews, sigma: FloatArray, positions: SegmentPositions, free: BoolArray, max_squared: float
) -> tuple[IntArray, IntArray]:
    """Join segments whose positions agree.

    Parameters
    ----------
    views : LineViews
        Segments of all images.
    sigma : (S,) float64
        Standard deviations of the segments across, pixels.
    positions : SegmentPositions
        Place of each segment, its support, and the segments that support it.
    free : (S,) bool
        Segments that may be used.
    max_squared : float
        Largest squared distance of an end point over its variance.

    Returns
    -------
    members, representative : (m,) int
        Rows of the segments in groups of two and more, and the row that stands for each one's group.
    """
    first, second = positions.edges.T
    edges = positions.edges[free[first] & free[second]]
    tables = (
        views.camera, views.center, views.image_idx, views.ray, positions.q, positions.covariance, sigma, views.line,
        views.ends,
    )  # fmt: skip
    agree, rank = np.zeros(len(edges), bool), positions.score * np.sqrt(views.length)

    def compare(part: slice) -> None:
        _join(edges[part], *tables, max_squared, agree[part], rank, np.empty(0, np.int64))

    map_ranges(compare, len(edges), _EDGES_AT_ONCE)
    edges = edges[agree]
    edges = edges[np.argsort(-np.minimum(*rank[edges.T]), kind="stable")]
    parent = np.arange(len(free))
    _join(edges, *tables, max_squared, np.empty(len(edges), bool), rank, parent)
    size = np.bincount(parent, minlength=len(parent))
    members = np.flatnonzero(size[parent] > 1)
    return members, parent[members]
