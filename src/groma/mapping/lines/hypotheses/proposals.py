# SPDX-License-Identifier: BSD-3-Clause
r"""Hypotheses for the place of each segment in space, from one other image at a time.

A 3D segment behind a segment of image i is two numbers: the inverse depths :math:`q = (q_1, q_2)` of its end points on
their rays :math:`f_1, f_2`. A segment of image j with line :math:`l` proposes the q at which the reference segment's
plane meets the plane of :math:`l`. With the epipole :math:`a = P_j [c_i; 1]` and :math:`b_k = M_j f_k`,

.. math:: l^\top (q_k a + b_k) = 0 \quad\Rightarrow\quad q_k = -\frac{l^\top b_k}{l^\top a},

which is linear in the image line. Its covariance follows from the distance of the projected end point to l,
:math:`\partial \mathrm{dist}_k / \partial q_k = l^\top a / x_{k,3}`, and from the noise of both segments' end points.
Where the line is parallel to the epipolar line, :math:`l^\top a \to 0` and the covariance grows without bound. Such
proposals are discarded; the segment can still join a line that other segments determine. Where only the change of depth
along the segment is uncertain, because the other image sees a small part of it, the vanishing point of the segment
supplies it (:mod:`groma.mapping.lines.hypotheses.directions`).

Known points on a segment give further proposals, without another segment
(:mod:`groma.mapping.lines.hypotheses.known_points`).

References
----------
Plücker notes, eq. (33) for the two planes. The parametrisation by inverse depths is ours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from groma._numba import kernel, loop
from groma._typing import BoolArray, FloatArray, IntArray
from groma.gates import LINE_MAPS, gate
from groma.geometry.algebra import perpendicular
from groma.mapping.lines.bins import in_bins
from groma.mapping.lines.gates import AGREEMENT
from groma.mapping.lines.hypotheses.known_points import lines_through_points
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.lines.views import LineViews

#: Bins of the angle about the baseline: only how long it takes depends on them (cost: memory against time).
_NUM_BINS = 2048
#: Radians about the baseline from which on it is sure which ray of a segment comes first (derived from rounding).
_SURE = 1e-6
# How far a candidate got; the best of all candidates of a segment is reported.
NOTHING, OUT_OF_BEAM, WEAK, PROPOSED = 0, 1, 2, 3
#: Proposals of a segment by one other image for which there is room at first; what is not written takes no memory
#: (cost: memory, which grows where it is too little).
_ROOM = 64


@dataclass(frozen=True)
class ProposalGates:
    """Which pairs of segments propose a place."""

    end_margin: float = gate(2.0, "1", "by which ends may leave the depths of the middle", LINE_MAPS)

    def limits(self) -> tuple[float, float, float]:
        """Least change over the range of depths, margin of the ends, squared disagreement with a direction."""
        largest = AGREEMENT.max_squared(1)
        return math.sqrt(largest), self.end_margin, largest


@dataclass(frozen=True, eq=False)
class Proposals:
    """Two-view proposals for the segments of one image."""

    #: (M,) segment within the image.
    segment: IntArray
    #: (M,) which neighbour, 0 to n - 1; n stands for known points on the segment, n + 1 for one and a direction.
    neighbor: IntArray
    #: (M,) row of the other segment in the table of all images; -1 for points.
    other: IntArray
    #: (M, 6) q1, q2, their variances and covariance (c11, c12, c22), and the score of the match.
    values: FloatArray
    #: (n,) the furthest that any candidate got.
    reached: IntArray


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _use_direction(ratio, max_squared, out):
    """Fuse out = q1 q2 c11 c12 c22 with q2 = r q1, r of mean and deviation ratio; False where they disagree."""
    r = ratio[0]
    away = out[1] - r * out[0]
    variance = out[4] - 2.0 * r * out[3] + r * r * out[2] + (ratio[1] * out[0]) ** 2
    if not away * away < max_squared * variance:
        return False
    k1, k2 = (out[3] - r * out[2]) / variance, (out[4] - r * out[3]) / variance
    out[0], out[1] = out[0] - k1 * away, out[1] - k2 * away
    out[2], out[3], out[4] = out[2] - k1 * k1 * variance, out[3] - k1 * k2 * variance, out[4] - k2 * k2 * variance
    return True


@kernel
def _carry(M, ray, across, b):
    """The rays of a segment, and their change across it, as the other camera sees them: rows of b (3, 3)."""
    for c in range(3):
        b[0, c] = M[c, 0] * ray[0, 0] + M[c, 1] * ray[0, 1] + M[c, 2] * ray[0, 2]
        b[1, c] = M[c, 0] * ray[1, 0] + M[c, 1] * ray[1, 1] + M[c, 2] * ray[1, 2]
        b[2, c] = M[c, 0] * across[0] + M[c, 1] * across[1] + M[c, 2] * across[2]


@kernel
def _reach(b, line, r, per_gain, q_low, q_high, limits, out):
    """Fill the inverse depths out = q1 q2 that line r gives; False where they are out of range."""
    out[0] = (line[r, 0] * b[0, 0] + line[r, 1] * b[0, 1] + line[r, 2] * b[0, 2]) * per_gain
    out[1] = (line[r, 0] * b[1, 0] + line[r, 1] * b[1, 1] + line[r, 2] * b[1, 2]) * per_gain
    middle, least, most = 0.5 * (out[0] + out[1]), q_low / limits[1], q_high * limits[1]
    if not (middle >= q_low and middle <= q_high):
        return False
    return out[0] >= least and out[0] <= most and out[1] >= least and out[1] <= most


@kernel
def _propose(b, s, r, ratio, line, ends, sigma, gain, a, directed, min_overlap, max_relative, limits, out):
    """Segments s and r, which give out = q1 q2: add c11 c12 c22; return how far the pair got.

    ``b`` are the rays of the first segment by :func:`_carry`. ``limits`` are the least change over the range of depths
    in sigma, the margin of the ends, and the largest squared disagreement with the direction.
    """
    ux, uy = ends[r, 2] - ends[r, 0], ends[r, 3] - ends[r, 1]
    per_length2 = 1.0 / (ux * ux + uy * uy)
    z1, z2 = out[0] * a[2] + b[0, 2], out[1] * a[2] + b[1, 2]
    if z1 <= 0.05 or z2 <= 0.05:
        return OUT_OF_BEAM
    z1, z2 = 1.0 / z1, 1.0 / z2
    x1, y1 = (out[0] * a[0] + b[0, 0]) * z1 - ends[r, 0], (out[0] * a[1] + b[0, 1]) * z1 - ends[r, 1]
    x2, y2 = (out[1] * a[0] + b[1, 0]) * z2 - ends[r, 0], (out[1] * a[1] + b[1, 1]) * z2 - ends[r, 1]
    t1, t2 = (x1 * ux + y1 * uy) * per_length2, (x2 * ux + y2 * uy) * per_length2
    if directed and t2 <= t1:
        return OUT_OF_BEAM
    low, high = min(t1, t2), max(t1, t2)
    overlap = min(high, 1.0) - max(low, 0.0)
    if overlap < min_overlap * min(high - low, 1.0):
        return OUT_OF_BEAM
    shift = line[r, 0] * b[2, 0] + line[r, 1] * b[2, 1] + line[r, 2] * b[2, 2]
    g1, g2, h1, h2 = gain * z1, gain * z2, shift * z1, shift * z2
    s2, r2 = sigma[r] * sigma[r], sigma[s] * sigma[s]
    out[2] = (s2 * ((1.0 - t1) * (1.0 - t1) + t1 * t1) + r2 * h1 * h1) / (g1 * g1)
    out[3] = s2 * ((1.0 - t1) * (1.0 - t2) + t1 * t2) / (g1 * g2)
    out[4] = (s2 * ((1.0 - t2) * (1.0 - t2) + t2 * t2) + r2 * h2 * h2) / (g2 * g2)
    for attempt in range(2):
        if out[2] <= (max_relative * out[0]) ** 2 and out[4] <= (max_relative * out[1]) ** 2:
            return PROPOSED
        if attempt == 1 or ratio[s, 0] <= 0.0 or not _use_direction(ratio[s], limits[2], out):
            return WEAK
    return WEAK


@loop
def _propose_beam(
    rows_i, rows_j, ray, across, sigma, search, ratio, line, ends, beam_i, beams, M, a, directed, min_overlap,
    max_relative, limits, neighbor, out_index, out, reached,
):  # fmt: skip
    """All pairs whose angles about the baseline overlap; return the number written, or needed if out is too short.

    Two intervals overlap if the second contains the beginning of the first, or begins in it; ``beams`` finds both.
    """
    beam_j, bin_pointers, bin_members, order, begins = beams
    gain, count = np.empty(len(rows_j)), 0
    for j in range(len(rows_j)):
        r = rows_j[j]
        gain[j] = line[r, 0] * a[0] + line[r, 1] * a[1] + line[r, 2] * a[2]
    work, b = np.empty(5), np.empty((3, 3))
    num_bins = len(bin_pointers) - 1
    size = 2.0 * math.pi / num_bins
    for i in range(len(rows_i)):
        s = rows_i[i]
        _carry(M, ray[s], across[s], b)
        low, q_low, q_high = beam_i[i, 0], search[s, 0], search[s, 1]
        here = int(np.floor(low / size)) % num_bins
        around = bin_pointers[here + 1] - bin_pointers[here]
        furthest = reached[i]
        for e in range(around + begins[i, 1] - begins[i, 0]):
            if e < around:
                j = bin_members[bin_pointers[here] + e]
                back = low - beam_j[j, 0]
                if back < 0.0:
                    back += 2.0 * math.pi
                if back > beam_j[j, 1] - beam_j[j, 0]:
                    continue
            else:
                after = begins[i, 0] + e - around
                j = order[after - len(order) if after >= len(order) else after]
            r = rows_j[j]
            if not abs(gain[j]) * (q_high - q_low) > limits[0] * sigma[r]:
                furthest = max(furthest, WEAK)  # the whole range of depths lies within the noise
                continue
            if directed and beam_i[i, 2] * beam_j[j, 2] < 0.0:  # one of them is crossed from its end
                furthest = max(furthest, OUT_OF_BEAM)
                continue
            if not _reach(b, line, r, -1.0 / gain[j], q_low, q_high, limits, work):
                furthest = max(furthest, OUT_OF_BEAM)
                continue
            got = _propose(
                b, s, r, ratio, line, ends, sigma, gain[j], a, directed, min_overlap, max_relative, limits, work
            )  # fmt: skip
            furthest = max(furthest, got)
            if got == PROPOSED:
                if count < len(out):
                    out_index[count, 0], out_index[count, 1], out_index[count, 2] = i, neighbor, r
                    out[count, 5] = 1.0
                    for c in range(5):
                        out[count, c] = work[c]
                count += 1
        reached[i] = furthest
    return count


@loop
def _propose_pairs(
    pairs, score, start_i, start_j, ray, across, sigma, search, ratio, line, ends, usable, M, a, min_overlap,
    max_relative, limits, neighbor, out_index, out, reached,
):  # fmt: skip
    """Given pairs of segments; return how many proposals there are."""
    count = 0
    work, b = np.empty(5), np.empty((3, 3))
    for k in range(len(pairs)):
        i, s, r = pairs[k, 0], start_i + pairs[k, 0], start_j + pairs[k, 1]
        if not (usable[s] and usable[r]):
            continue
        _carry(M, ray[s], across[s], b)
        gain, got = line[r, 0] * a[0] + line[r, 1] * a[1] + line[r, 2] * a[2], OUT_OF_BEAM
        if not abs(gain) * (search[1] - search[0]) > limits[0] * sigma[r]:
            got = WEAK
        elif _reach(b, line, r, -1.0 / gain, search[0], search[1], limits, work):
            got = _propose(b, s, r, ratio, line, ends, sigma, gain, a, False, min_overlap, max_relative, limits, work)
        reached[i] = max(reached[i], got)
        if got == PROPOSED:
            out_index[count, 0], out_index[count, 1], out_index[count, 2] = i, neighbor, r
            out[count, 5] = score[k]
            for c in range(5):
                out[count, c] = work[c]
            count += 1
    return count


# ------------------------------------------------------------------------------------------------------------- Public
def angles_about_baseline(ray: FloatArray, baseline: FloatArray) -> FloatArray:
    """Intervals (n, 3) of the angles about a baseline that segments with rays (n, 2, 3) cover, low first.

    The third column is 1 where the first ray has the lower angle, -1 where the second has, 0 where that is not sure.

    The angle of a ray about the baseline is the same for all points of an epipolar plane, whichever of the two images
    they are seen in. Intervals start in [-pi, pi) and are at most pi wide.
    """
    first, second = perpendicular(baseline)
    angle = np.arctan2(ray @ second, ray @ first)
    turn = angle[:, 1] - angle[:, 0]
    turn -= 2 * np.pi * np.floor(turn / (2 * np.pi) + 0.5)
    low = np.where(turn < 0, angle[:, 0] + turn, angle[:, 0])
    low -= 2 * np.pi * np.floor(low / (2 * np.pi) + 0.5)
    width = np.abs(turn)
    return np.column_stack([low, low + width, np.sign(turn) * ((width > _SURE) & (width < np.pi - _SURE))])


@dataclass(frozen=True, eq=False)
class Questions:
    """Of which segments of an image, and from where, there shall be proposals."""

    #: The reference image, and its (n,) neighbours.
    image: int
    neighbors: IntArray
    #: Matched segments (m, 2) and scores (m,) of each neighbour; None takes all segments in the epipolar beam.
    matches: Sequence[tuple[IntArray, FloatArray] | None]
    #: Pixels (p, 2) and inverse depths (p,) of known points seen in the image.
    near_points: tuple[FloatArray, FloatArray]
    #: Segments of the image of which the beam is searched; None: all.
    among: BoolArray | None = None


@dataclass(frozen=True, eq=False)
class Proposer:
    """What makes the proposals of an image, and what it demands of them."""

    views: LineViews
    #: (S, 2) change of depth along each segment and its standard deviation.
    ratios: FloatArray
    options: MapLinesOptions
    gates: ProposalGates = field(default_factory=ProposalGates)

    def propose(self, asked: Questions) -> Proposals:
        """Proposals for the segments of an image."""
        image, neighbors, near_points = asked.image, asked.neighbors, asked.near_points
        views, rows = self.views, self.views.rows(image)
        reached = np.zeros(rows.stop - rows.start, np.int64)
        parts: list[tuple[IntArray, FloatArray]] = [(np.empty((0, 3), np.int64), np.empty((0, 6)))]
        if len(near_points[0]):
            parts.append(lines_through_points(views, rows, self.ratios[rows], near_points, len(neighbors)))
        usable = np.flatnonzero(views.usable[rows] if asked.among is None else views.usable[rows] & asked.among)
        for n, (j, given) in enumerate(zip(neighbors, asked.matches, strict=True)):
            if given is None:
                parts.append(self._beam(image, int(j), n, usable, reached))
            else:
                parts.append(self._pairs(image, int(j), n, given, reached))
        index, values = (np.concatenate(column) for column in zip(*parts, strict=True))
        return Proposals(index[:, 0], index[:, 1], index[:, 2], values, reached)

    def _pairs(
        self, image: int, j: int, n: int, given: tuple[IntArray, FloatArray], reached: IntArray
    ) -> tuple[IntArray, FloatArray]:
        """Index (m, 3) and values (m, 6) of the proposals of matched segments of image j, which is neighbour n."""
        views, (pairs, score) = self.views, given
        index, values = np.empty((len(pairs), 3), np.int64), np.empty((len(pairs), 6))
        count = _propose_pairs(
            pairs, score, views.rows(image).start, views.rows(j).start, views.ray, views.across, views.sigma,
            views.inverse_depth[image], self.ratios, views.line, views.ends, views.usable, *self._camera(image, j),
            self.options.min_overlap, self.options.max_relative_sigma, self.gates.limits(), n, index, values, reached,
        )  # fmt: skip
        return index[:count], values[:count]

    def _beam(self, image: int, j: int, n: int, usable: IntArray, reached: IntArray) -> tuple[IntArray, FloatArray]:
        """The same of all segments of image j in the epipolar beam of each of some segments."""
        views = self.views
        baseline = views.center[j] - views.center[image]
        if not np.linalg.norm(baseline) > 0.0:
            return np.empty((0, 3), np.int64), np.empty((0, 6))
        rows_i, rows_j = views.rows(image).start + usable, views.usable_rows(j)
        beam_i = angles_about_baseline(views.ray[rows_i], baseline)
        beam_j = angles_about_baseline(views.ray[rows_j], baseline)
        beams = _sorted_beams(beam_i, beam_j)
        furthest = np.zeros(len(rows_i), np.int64)
        room = _ROOM * len(rows_i)
        while True:
            index, values = np.empty((room, 3), np.int64), np.empty((room, 6))
            needed = _propose_beam(
                rows_i, rows_j, views.ray, views.across, views.sigma, views.range, self.ratios, views.line, views.ends,
                beam_i, beams, *self._camera(image, j), self.options.directed, self.options.min_overlap,
                self.options.max_relative_sigma, self.gates.limits(), n, index, values, furthest,
            )  # fmt: skip
            if needed <= room:
                break
            room = needed
        index = index[:needed]
        index[:, 0] = usable[index[:, 0]]
        reached[usable] = np.maximum(reached[usable], furthest)
        return index, values[:needed]

    def _camera(self, image: int, j: int) -> tuple[FloatArray, FloatArray]:
        """Image j's camera: for directions, and the epipole of an image."""
        camera = self.views.camera[j]
        return camera[:, :3].copy(), camera @ np.append(self.views.center[image], 1.0)


def _sorted_beams(beam_i: FloatArray, beam_j: FloatArray) -> tuple[FloatArray | IntArray, ...]:
    """Intervals of image j so that those that overlap one of image i are found: the last column is by interval of i.

    Returns the intervals, pointers and members of the bins that each covers, their order by where they begin, and
    which of that order (n, 2), counted on around the circle, begin within each interval of image i.
    """
    members, pointers = in_bins(beam_j, 2.0 * math.pi / _NUM_BINS, _NUM_BINS)
    order = np.argsort(beam_j[:, 0], kind="stable")
    first = beam_j[order, 0]
    return (
        beam_j,
        pointers,
        members,
        order,
        np.searchsorted(np.append(first, first + 2.0 * np.pi), beam_i[:, :2], "right"),
    )
