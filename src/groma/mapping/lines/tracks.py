# SPDX-License-Identifier: BSD-3-Clause
r"""From the places of single segments to lines seen by many images.

link
    Segments whose places support each other are joined, best edges first; two groups are joined only if the places of
    their representatives explain each other's segment in the image.
refine
    Maximum likelihood (:mod:`groma.mapping.lines.fit`); observations whose two distances fail a chi-square test are
    dropped.
recover
    Lines are projected into the images of their neighbourhood. A free segment on a line joins it, also one whose own
    proposals were degenerate; a segment of another line is a vote that both are one.
trim
    The end points of a line bound the part of it that at least two images see; see :mod:`._line_ends`.

Observations of all lines are flat arrays, stored by line: those of line n are ``pointers[n] : pointers[n + 1]``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma._numba import kernel, loop
from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.line_ends import trim
from groma.mapping.distinct import distinct_pairs, num_distinct
from groma.mapping.lines.fit import find_on_lines, fit_lines
from groma.mapping.lines.views import LineViews

#: Sum of squares of an observation's two distances over sigma up to which it belongs to a line: 99.7 %.
GATE = 11.6


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


@loop
def _join_once(pairs, alias, is_target):
    """Join second lines to first ones, best pairs first; return how many. Chains are left to the next round: a line is
    joined once, and only to one that was not joined itself.
    """
    joined = 0
    for e in range(len(pairs)):
        a, b = pairs[e, 0], pairs[e, 1]
        if alias[a] == a and alias[b] == b and not is_target[b]:
            alias[b], is_target[a] = a, True
            joined += 1
    return joined


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
    edges, _ = distinct_pairs(np.minimum(first, second)[keep], np.maximum(first, second)[keep])
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


# ------------------------------------------------------------------------------------------------------------- Tracks
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

    def table(self) -> tuple[IntArray, IntArray]:
        """Rows of the observations by line, and the pointers of each line's."""
        rows = np.flatnonzero(self.line_of >= 0)
        rows = rows[np.argsort(self.line_of[rows], kind="stable")]  # rows are sorted by image, and stay so per line
        return rows, np.searchsorted(self.line_of[rows], np.arange(len(self.X) + 1))

    def num_images(self) -> IntArray:
        """(L,) number of images of each line."""
        rows = np.flatnonzero(self.line_of >= 0)
        return num_distinct(self.line_of[rows], self.views.image_idx[rows], len(self.X))

    def refine(self, rounds: int = 3) -> None:
        """Refine all lines, dropping observations that do not fit, then trim."""
        views = self.views
        rows, pointers = self.table()
        active, squared, front = np.ones(len(rows), bool), np.zeros(len(rows)), np.zeros(len(rows), bool)
        for k in range(rounds):
            fit = fit_lines(views, pointers, rows, active, self.X)
            self.X, squared, self.uncertainty, self.unchecked = fit.X, fit.squared, fit.uncertainty, fit.unchecked
            trim(views.center, views.image_idx, views.ray, views.length, pointers, rows, active, self.X, front)
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
        forward = self.direction() if directed else np.zeros(count)
        hit, distance = self._find(neighbors, views.sigma, forward, GATE)
        num_merged = self._merge(hit)
        merged_line = self._alias[hit[:, 0]]
        is_free = (self.line_of[hit[:, 1]] < 0) & free[hit[:, 1]]
        hit, distance, merged_line = hit[is_free], distance[is_free], merged_line[is_free]
        order = np.argsort(distance, kind="stable")
        segment, best = np.unique(hit[order, 1], return_index=True)
        self.line_of[segment] = merged_line[order][best]
        return len(segment), num_merged

    def near_lines(self, neighbors: list[IntArray], reach: float | None = None) -> IntArray:
        """Lines and segments (M, 2) whose ends lie within ``reach`` pixels of the line, or within their noise."""
        forward = np.zeros(len(self.X))
        if reach is None:
            return self._find(neighbors, self.views.sigma, forward, GATE)[0]
        return self._find(neighbors, np.full(len(self.line_of), reach), forward, 2.0)[0]

    def _find(
        self, neighbors: list[IntArray], sigma: FloatArray, forward: FloatArray, gate: float
    ) -> tuple[IntArray, FloatArray]:
        """Lines and segments on them (M, 2), in the images of the lines and their neighbours; and squared distances."""
        views = self.views
        reach = images_near_lines(self.line_of, views.image_idx, neighbors)
        hits, distances = [np.empty((0, 2), np.int64)], [np.empty(0)]
        room, value = np.empty((4096, 2), np.int64), np.empty(4096)
        for i in range(len(views.camera)):
            rows = np.arange(views.pointers[i], views.pointers[i + 1])
            while True:
                needed = find_on_lines(
                    views.camera[i], self.X, reach[i], rows, views.ends, sigma, views.usable, forward, gate, 0.3, room,
                    value,
                )  # fmt: skip
                if needed <= len(room):
                    break
                room, value = np.empty((2 * needed, 2), np.int64), np.empty(2 * needed)
            hits.append(room[:needed].copy())
            distances.append(value[:needed].copy())
        return np.concatenate(hits), np.concatenate(distances)

    def join(self, alias: IntArray, deviation: FloatArray) -> None:
        """Give the segments of line n, with ``deviation[n]`` more noise, to line ``alias[n]``; refine."""
        member = np.flatnonzero(self.line_of >= 0)
        sigma = self.views.sigma.copy()
        sigma[member] = np.hypot(sigma[member], deviation[self.line_of[member]])
        self.views = replace(self.views, sigma=sigma)
        self.line_of[member] = alias[self.line_of[member]]
        self.refine()
        self.keep(self.num_images() > 0)

    def direction(self) -> FloatArray:
        """(L,) +1 or -1: whether most observations run from the first end point to the second in the image."""
        views = self.views
        rows, _ = self.table()
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
        self._alias = np.arange(len(self.X))
        if not pair.any():
            return 0
        seen, _ = distinct_pairs(hit[pair, 0] * len(self.X) + owner[pair], self.views.image_idx[hit[pair, 1]])
        key, votes = np.unique(seen[:, 0], return_counts=True)
        pairs = np.column_stack([key // len(self.X), key % len(self.X)])
        images = self.num_images()
        good = (votes >= 2) & (votes >= 0.6 * images[pairs[:, 1]])
        pairs, votes = pairs[good], votes[good]
        merged = _join_once(pairs[np.argsort(-votes, kind="stable")], self._alias, np.zeros(len(self.X), np.bool_))
        member = self.line_of >= 0
        self.line_of[member] = self._alias[self.line_of[member]]
        return merged


def images_near_lines(line_of: IntArray, image_idx: IntArray, neighbors: list[IntArray]) -> list[IntArray]:
    """Lines to look for in each image: those seen in it or in a neighbour."""
    num_images = len(neighbors)
    rows = np.flatnonzero(line_of >= 0)
    seen: list[IntArray] = [np.empty(0, np.int64)] * num_images
    order = rows[np.argsort(image_idx[rows], kind="stable")]
    bounds = np.searchsorted(image_idx[order], np.arange(num_images + 1))
    for i in range(num_images):
        seen[i] = np.unique(line_of[order[bounds[i] : bounds[i + 1]]])
    return [np.unique(np.concatenate([seen[i], *(seen[j] for j in neighbors[i])])) for i in range(num_images)]
