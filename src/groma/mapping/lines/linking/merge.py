# SPDX-License-Identifier: BSD-3-Clause
r"""Merging of lines that were mapped along the same edge.

An edge is mapped more than once where its darker side changes with the view, where occlusions separate the images that
see it, and where drift of the poses displaces it around a loop. Two lines are merged if they agree in space,

.. math:: \delta^\top (\Sigma_a + \Sigma_b + \tau^2 I)^{-1} \delta \le \gamma,

with :math:`\delta` the offsets of line b from line a across it at both ends of their overlap (four numbers) and
:math:`\Sigma` their covariances; and if no image shows them as two segments side by side. The deviation :math:`\tau`
accounts for errors of the poses. It is estimated from the disagreement of the candidate pairs, with a lower bound in
pixels at the distance of the lines.

Pairs of mutually best candidates are merged and fitted, and the comparison is repeated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from groma._numba import loop
from groma._rows import numbered, pointers_of, sorted_within
from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.batch_least_squares import Observations, solve_batch
from groma.estimators.two_point_line import TWO_POINT_LINE
from groma.execution import begin
from groma.features.segments import SEGMENTS
from groma.gates import gate
from groma.geometry.algebra import apply, dot
from groma.mapping.lines.bins import in_bins
from groma.mapping.lines.gates import AGREEMENT
from groma.mapping.lines.linking.tracks import Tracks
from groma.mapping.lines.outcomes import Outcome


@dataclass(frozen=True)
class MergeGates:
    """When two lines are one."""

    pose_px: tuple[float, float] = gate((0.3, 2.5), "px", "deviation that poses add", "chosen on fountain, herz")
    min_pairs: int = gate(5, "pairs", "fewer do not tell the deviation of the poses", "chosen on synthetic wireframes")
    max_distance: float = gate(8.0, "px", "between lines that are compared", "chosen on fountain, herz")
    max_angle: float = gate(0.2, "rad", "between lines that are compared", "chosen on fountain, herz")


#: The defaults.
MERGE = MergeGates()
#: Median of the mean of four squared normal numbers, half of them independent.
_MEDIAN_SQUARE = 0.6


# -------------------------------------------------------------------------------------------------------------- Loops
@loop
def _near_pairs(pointers, members, first_bin, low, X, reach, max_angle, min_overlap, pairs, span):
    """Pairs of lines that are nearly parallel, overlap, and are near there; return the number written, or needed.

    Lines come in bins along one axis and, within a bin, in the order of ``low`` (L, 2), their extent along another;
    span (M, 2) is the overlap, as positions on the first line in units of its length.
    """
    count, k = 0, 0
    for i in range(len(members)):
        while i >= pointers[k + 1]:
            k += 1
        a = members[i]
        d0, d1, d2 = X[a, 1, 0] - X[a, 0, 0], X[a, 1, 1] - X[a, 0, 1], X[a, 1, 2] - X[a, 0, 2]
        dd = d0 * d0 + d1 * d1 + d2 * d2
        for j in range(i + 1, pointers[k + 1]):
            b = members[j]
            near = min(reach[a], reach[b])
            if low[b, 0] > low[a, 1] + near:
                break
            if max(first_bin[a], first_bin[b]) != k:
                continue  # a pair that shares several bins counts in the first of them
            e0, e1, e2 = X[b, 1, 0] - X[b, 0, 0], X[b, 1, 1] - X[b, 0, 1], X[b, 1, 2] - X[b, 0, 2]
            ee = e0 * e0 + e1 * e1 + e2 * e2
            de = d0 * e0 + d1 * e1 + d2 * e2
            if not de * de > math.cos(max_angle) ** 2 * dd * ee:
                continue
            w0, w1, w2 = X[b, 0, 0] - X[a, 0, 0], X[b, 0, 1] - X[a, 0, 1], X[b, 0, 2] - X[a, 0, 2]
            t0 = (w0 * d0 + w1 * d1 + w2 * d2) / dd
            t1 = t0 + de / dd
            first, last = max(0.0, min(t0, t1)), min(1.0, max(t0, t1))
            if last - first < min_overlap * min(1.0, abs(t1 - t0)):
                continue
            close = True
            for t in (first, last):
                s = (t - t0) / (t1 - t0)
                x0, x1, x2 = w0 + s * e0 - t * d0, w1 + s * e1 - t * d1, w2 + s * e2 - t * d2
                if x0 * x0 + x1 * x1 + x2 * x2 > near * near:
                    close = False
            if close:
                if count < len(pairs):
                    pairs[count, 0], pairs[count, 1] = a, b
                    span[count, 0], span[count, 1] = first, last
                count += 1
    return count


# ------------------------------------------------------------------------------------------------------------- Public
def merge_agreeing(tracks: Tracks) -> Tracks:
    """Return the tracks with lines joined that agree within their uncertainty and that of the poses.

    The segments of joined lines get the deviation of the poses added to their own, so that the fit keeps them.
    """
    pose_px = None
    while True:  # every round leaves fewer lines
        pairs = _compare(tracks)
        pairs = pairs.take(~seen_apart(tracks, pairs.lines))
        if len(pairs.lines) == 0:
            break
        if pose_px is None:
            pose_px = _pose_deviation(pairs, tracks.num_lines)
        distance = pairs.squared_distance(pose_px)
        good = _preferred(pairs.lines, distance, tracks.num_lines) & (distance < AGREEMENT.max_squared(4))
        if not good.any():
            break
        tracks = _joined(tracks, pairs.take(good), pose_px)
    return tracks.keep(tracks.num_images() >= 2, Outcome.FEW_IMAGES)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of lines that may be one."""

    #: (M, 2) the lines.
    lines: IntArray
    #: (M, 4) offsets of the second from the first, across it, at both ends of their overlap.
    offset: FloatArray
    #: (M, 4, 4) their covariances.
    covariance: FloatArray
    #: (M,) size of a pixel there, scene units.
    unit: FloatArray

    def take(self, rows: BoolArray) -> _Pairs:
        """Return some of the pairs."""
        return _Pairs(self.lines[rows], self.offset[rows], self.covariance[rows], self.unit[rows])

    def squared_distance(self, pose_px: float) -> FloatArray:
        """Squared Mahalanobis distances (M,), with the deviation of the poses in pixels."""
        total = self.covariance + ((pose_px * self.unit) ** 2)[:, None, None] * np.eye(4)
        return np.einsum("mi,mi->m", self.offset, np.linalg.solve(total, self.offset[..., None])[..., 0])


def _compare(tracks: Tracks) -> _Pairs:
    """Pairs of lines that are near each other."""
    views, X = tracks.views, tracks.lines
    unit = begin(partial(_pixel_size, tracks))
    rows, pointers = tracks.table()
    own = np.column_stack([views.ends[rows], tracks.sigma[rows]])
    observations = Observations(views.camera, views.image_idx[rows], own, pointers, np.ones(len(rows), bool))
    known = solve_batch(TWO_POINT_LINE, observations, X, max_steps=0)  # information and bases of the lines as they are
    H, U = known.information, known.frames
    noise = begin(lambda: np.linalg.inv(H + 1e-9 * np.einsum("nii->n", H)[:, None, None] * np.eye(4)))
    pairs, span = _candidates(X, MERGE.max_distance * unit())
    (a, b), covariance = pairs.T, noise()
    along = X[b, 1] - X[b, 0]
    places = X[a, None, 0] + span[:, :, None] * (X[a, 1] - X[a, 0])[:, None]
    on_b = np.einsum("mkc,mc->mk", places - X[b, None, 0], along) / (along**2).sum(-1)[:, None]
    there = X[b, None, 0] + on_b[:, :, None] * along[:, None]
    offset = np.einsum("mjc,mkc->mkj", U[a], there - places).reshape(-1, 4)
    turn = np.einsum("mic,mjc->mij", U[a], U[b])
    spread = np.zeros((len(pairs), 4, 4))
    for n, at, basis in ((a, span, np.broadcast_to(np.eye(2), turn.shape)), (b, on_b, turn)):
        weight = np.stack([1.0 - at, at], axis=-1)  # of both points, at both places
        gain = np.einsum("mkp,mij->mkipj", weight, basis).reshape(-1, 4, 4)
        spread += gain @ covariance[n] @ np.swapaxes(gain, 1, 2)
    return _Pairs(pairs, offset, spread, np.minimum(unit()[a], unit()[b]))


def _candidates(X: FloatArray, reach: FloatArray) -> tuple[IntArray, FloatArray]:
    """Pairs (M, 2) of near, nearly parallel lines and their overlap (M, 2): a sweep along one axis in bins of another.

    Work grows with the number of lines where their density stays the same.
    """
    if len(X) == 0:
        return np.zeros((0, 2), np.int64), np.zeros((0, 2))
    across, along = np.argsort(np.ptp(X.reshape(-1, 3), axis=0), kind="stable")[1:]
    low = np.sort(X[:, :, along], axis=1)
    order = np.argsort(low[:, 0], kind="stable")
    # Bins a few times as wide as the usual line; a line is in all that it may share with another.
    bounds = np.sort(X[:, :, across], axis=1) + reach[:, None] * np.array([-0.5, 0.5])
    start, extent = bounds[:, 0].min(), bounds[:, 1] - bounds[:, 0]
    # (cost: time; pairs are put in the order of one sweep)
    width = max(4.0 * float(np.median(extent)), float(extent.sum()) / (4.0 * len(X)), np.ptp(bounds) / (4.0 * len(X)))
    extents = (bounds - start) / max(width, 1e-300)
    first_bin = np.floor(extents[:, 0]).astype(np.int64)
    members, pointers = in_bins(extents[order], 1.0, int(extents.max()) + 1)
    members = order[members]
    pairs, span = np.empty((4096, 2), np.int64), np.empty((4096, 2))
    while True:
        needed = _near_pairs(
            pointers, members, first_bin, low, X, reach, MERGE.max_angle, SEGMENTS.overlap, pairs, span
        )
        if needed <= len(pairs):
            break
        pairs, span = np.empty((2 * needed, 2), np.int64), np.empty((2 * needed, 2))
    # In the order of one sweep without bins.
    place = np.empty(len(X), np.int64)
    place[order] = np.arange(len(X))
    sorted_ = np.lexsort(place[pairs[:needed]].T[::-1])
    return pairs[:needed][sorted_], span[:needed][sorted_]


def _pixel_size(tracks: Tracks) -> FloatArray:
    """(L,) size of a pixel at the line, scene units: median over its observations."""
    views = tracks.views
    rows, line = tracks.members()
    image, focal = views.image_idx[rows], np.linalg.norm(views.camera[:, 0, :3], axis=1)
    axis = views.camera[:, 2][image]
    depth = np.einsum("mc,mc->m", axis[:, :3], tracks.lines.mean(1)[line]) + axis[:, 3]
    size = np.abs(depth) / focal[image]
    order = sorted_within(size, line, tracks.num_lines)
    pointers = pointers_of(np.bincount(line, minlength=tracks.num_lines))
    middle = (pointers[:-1] + pointers[1:]) // 2
    return size[order][np.minimum(middle, len(rows) - 1)]


def seen_apart(tracks: Tracks, pairs: IntArray) -> BoolArray:
    """Whether an image shows both lines of a pair as segments side by side."""
    views, (rows, pointers) = tracks.views, tracks.table()
    count, image = np.diff(pointers), views.image_idx[rows]
    pair, number = numbered(count[pairs[:, 0]])
    at = pointers[pairs[pair, 0]] + number  # segments of the first line, and those of the second in the same image
    size = np.int64(image.max(initial=0)) + 1
    keys, wanted = np.repeat(np.arange(len(count)), count) * size + image, pairs[pair, 1] * size + image[at]
    begin = np.searchsorted(keys, wanted)
    one, number = numbered(np.searchsorted(keys, wanted, "right") - begin)
    first, second = rows[at[one]], rows[begin[one] + number]
    start, other = views.ends[first, None, :2], views.ends[second].reshape(-1, 2, 2)
    along, line = views.ends[first, 2:] - start[:, 0], views.line[first]
    place = np.sort(apply(other - start, along) / dot(along, along)[:, None], axis=1)
    away = np.abs(apply(other, line[:, :2]) + line[:, 2:]).max(axis=1)
    overlap = np.minimum(place[:, 1], 1.0) - np.maximum(place[:, 0], 0.0)
    side_by_side = (overlap > SEGMENTS.overlap * np.minimum(place[:, 1] - place[:, 0], 1.0)) & (away > SEGMENTS.edge)
    return np.bincount(pair[one[side_by_side]], minlength=len(pairs)) > 0


def _preferred(pairs: IntArray, distance: FloatArray, count: int) -> BoolArray:
    """Pairs that are the best of both their lines."""
    best = np.full(count, np.inf)
    for side in (0, 1):
        np.minimum.at(best, pairs[:, side], distance)
    return (distance <= best[pairs[:, 0]]) & (distance <= best[pairs[:, 1]])


def _pose_deviation(pairs: _Pairs, count: int) -> float:
    """Deviation of the poses in pixels: what pairs that prefer each other disagree by beyond their own noise."""
    floor = MERGE.pose_px[0]
    good = pairs.take(_preferred(pairs.lines, pairs.squared_distance(floor), count))
    excess = (good.offset**2).mean(1) - np.einsum("mii->m", good.covariance) / 4.0
    if len(excess) < MERGE.min_pairs:
        return floor
    return float(np.clip(np.sqrt(max(np.median(excess / good.unit**2), 0.0) / _MEDIAN_SQUARE), *MERGE.pose_px))


def _joined(tracks: Tracks, pairs: _Pairs, pose_px: float) -> Tracks:
    """Join disjoint pairs, the line seen in fewer images to the other, and fit them anew."""
    excess = np.sqrt((pairs.offset**2).mean(1)) / pairs.unit
    images, lines = tracks.num_images(), pairs.lines
    turned = images[lines[:, 0]] < images[lines[:, 1]]
    lines = np.where(turned[:, None], lines[:, ::-1], lines)
    alias, deviation = np.arange(tracks.num_lines), np.zeros(tracks.num_lines)
    alias[lines[:, 1]] = lines[:, 0]
    deviation[lines] = np.where(excess > MERGE.pose_px[0], pose_px, 0.0)[:, None]
    return tracks.joined(alias, deviation)
