# SPDX-License-Identifier: BSD-3-Clause
r"""Where each segment may lie in space.

A 3D segment behind a segment of image i is two numbers: the inverse depths :math:`q = (q_1, q_2)` of its end points on
their rays :math:`f_1, f_2`. A segment of image j with line :math:`l` proposes the q at which the reference segment's
plane meets the plane of :math:`l`. With the epipole :math:`a = P_j [c_i; 1]` and :math:`b_k = M_j f_k`,

.. math:: l^\top (q_k a + b_k) = 0 \quad\Rightarrow\quad q_k = -\frac{l^\top b_k}{l^\top a},

linear, without an intersection to solve. Its covariance follows from the distance of the projected end point to l,
:math:`\partial \mathrm{dist}_k / \partial q_k = l^\top a / x_{k,3}`, and from the noise of both segments' end points.
Where the line runs along the epipolar line, :math:`l^\top a \to 0`: the covariance explodes, and the proposal is left
out of the decision; the track picks such segments up again when others have fixed the line. Where only the change of
depth along the segment is uncertain, because the other image sees a small part of it, its vanishing point supplies it.

The image itself proposes, too: the line through known points that lie on the segment, and the line through one of them
in the direction of the segment's vanishing point (:mod:`groma.mapping.lines.directions`).

References
----------
Plücker notes, eq. (33) for the two planes. The parametrisation by inverse depths is ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from groma._numba import kernel, loop
from groma._typing import FloatArray, IntArray
from groma.mapping.lines.views import LineViews

#: The depth range holds for the middle of a segment; its ends may leave it by this factor.
END_MARGIN = 2.0
#: Bins of the angle about the baseline.
NUM_BINS = 2048
# Why a candidate was refused; the furthest any candidate of a segment got is reported.
NOTHING, OUT_OF_BEAM, WEAK, PROPOSED = 0, 1, 2, 3


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
    #: (n_segments,) the furthest that any candidate got.
    reached: IntArray


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _use_direction(ratio, out):
    """Fuse out = q1 q2 c11 c12 c22 with q2 = r q1, r of mean and deviation ratio; False where they disagree."""
    r = ratio[0]
    away = out[1] - r * out[0]
    variance = out[4] - 2.0 * r * out[3] + r * r * out[2] + (ratio[1] * out[0]) ** 2
    if not away * away < 9.0 * variance:
        return False
    k1, k2 = (out[3] - r * out[2]) / variance, (out[4] - r * out[3]) / variance
    out[0], out[1] = out[0] - k1 * away, out[1] - k2 * away
    out[2], out[3], out[4] = out[2] - k1 * k1 * variance, out[3] - k1 * k2 * variance, out[4] - k2 * k2 * variance
    return True


@kernel
def _propose(
    ray, across, sigma, q_low, q_high, ratio, line, ends, sigma_j, M, a, directed, min_overlap, max_relative, out
):
    """One pair of segments: fill out = q1 q2 c11 c12 c22; return how far it got."""
    gain = line[0] * a[0] + line[1] * a[1] + line[2] * a[2]
    if not abs(gain) * (q_high - q_low) > 3.0 * sigma_j:
        return WEAK  # the whole range of depths lies within the noise
    ux, uy = ends[2] - ends[0], ends[3] - ends[1]
    length2 = ux * ux + uy * uy
    n0 = M[0, 0] * across[0] + M[0, 1] * across[1] + M[0, 2] * across[2]
    n1 = M[1, 0] * across[0] + M[1, 1] * across[1] + M[1, 2] * across[2]
    n2 = M[2, 0] * across[0] + M[2, 1] * across[1] + M[2, 2] * across[2]
    shift = line[0] * n0 + line[1] * n1 + line[2] * n2
    t1 = t2 = g1 = g2 = h1 = h2 = 0.0
    for k in range(2):
        b0 = M[0, 0] * ray[k, 0] + M[0, 1] * ray[k, 1] + M[0, 2] * ray[k, 2]
        b1 = M[1, 0] * ray[k, 0] + M[1, 1] * ray[k, 1] + M[1, 2] * ray[k, 2]
        b2 = M[2, 0] * ray[k, 0] + M[2, 1] * ray[k, 1] + M[2, 2] * ray[k, 2]
        q = -(line[0] * b0 + line[1] * b1 + line[2] * b2) / gain
        if not (q >= q_low / END_MARGIN and q <= q_high * END_MARGIN):
            return OUT_OF_BEAM
        z = q * a[2] + b2
        if z <= 0.05:
            return OUT_OF_BEAM
        x, y = (q * a[0] + b0) / z, (q * a[1] + b1) / z
        t = ((x - ends[0]) * ux + (y - ends[1]) * uy) / length2
        out[k] = q
        if k == 0:
            t1, g1, h1 = t, gain / z, shift / z
        else:
            t2, g2, h2 = t, gain / z, shift / z
    if directed and t2 <= t1:
        return OUT_OF_BEAM
    middle = 0.5 * (out[0] + out[1])
    if not (middle >= q_low and middle <= q_high):
        return OUT_OF_BEAM
    low, high = min(t1, t2), max(t1, t2)
    overlap = min(high, 1.0) - max(low, 0.0)
    if overlap < min_overlap * min(high - low, 1.0):
        return OUT_OF_BEAM
    s2, r2 = sigma_j * sigma_j, sigma * sigma
    out[2] = (s2 * ((1.0 - t1) * (1.0 - t1) + t1 * t1) + r2 * h1 * h1) / (g1 * g1)
    out[3] = s2 * ((1.0 - t1) * (1.0 - t2) + t1 * t2) / (g1 * g2)
    out[4] = (s2 * ((1.0 - t2) * (1.0 - t2) + t2 * t2) + r2 * h2 * h2) / (g2 * g2)
    for attempt in range(2):
        if out[2] <= (max_relative * out[0]) ** 2 and out[4] <= (max_relative * out[1]) ** 2:
            return PROPOSED
        if attempt == 1 or ratio[0] <= 0.0 or not _use_direction(ratio, out):
            return WEAK
    return WEAK


@loop
def _propose_beam(
    rows_i, rows_j, ray, across, sigma, search, ratio, line, ends, beam_i, beam_j, bin_pointers, bin_members, M, a,
    directed, min_overlap, max_relative, first, neighbor, out_index, out, reached,
):  # fmt: skip
    """All pairs whose angles about the baseline overlap; return the number written, or needed if out is too short."""
    count = first
    work = np.empty(5)
    size = 2.0 * math.pi / NUM_BINS
    for i in range(len(rows_i)):
        s = rows_i[i]
        low, high = beam_i[i, 0], beam_i[i, 1]
        bin_low, bin_high = int(np.floor(low / size)), int(np.floor(high / size))
        for k in range(bin_low, min(bin_high, bin_low + NUM_BINS - 1) + 1):
            b = k % NUM_BINS
            for e in range(bin_pointers[b], bin_pointers[b + 1]):
                j = bin_members[e]
                # A pair that shares several bins counts in the first of them.
                if k != bin_low and int(np.floor(beam_j[j, 0] / size)) % NUM_BINS != b:
                    continue
                away = 0.5 * (low + high) - 0.5 * (beam_j[j, 0] + beam_j[j, 1])
                away -= 2.0 * math.pi * math.floor(away / (2.0 * math.pi) + 0.5)
                if abs(away) > 0.5 * (high - low + beam_j[j, 1] - beam_j[j, 0]):
                    continue
                r = rows_j[j]
                got = _propose(
                    ray[s], across[s], sigma[s], search[s, 0], search[s, 1], ratio[s], line[r], ends[r], sigma[r], M, a,
                    directed, min_overlap, max_relative, work,
                )  # fmt: skip
                reached[i] = max(reached[i], got)
                if got == PROPOSED:
                    if count < len(out):
                        out_index[count, 0], out_index[count, 1], out_index[count, 2] = i, neighbor, r
                        out[count, 5] = 1.0
                        for c in range(5):
                            out[count, c] = work[c]
                    count += 1
    return count


@loop
def _propose_pairs(
    pairs, score, start_i, start_j, ray, across, sigma, search, ratio, line, ends, usable, M, a, min_overlap,
    max_relative, first, neighbor, out_index, out, reached,
):  # fmt: skip
    """Given pairs of segments; return the number written, or needed if out is too short."""
    count = first
    work = np.empty(5)
    for k in range(len(pairs)):
        i, s, r = pairs[k, 0], start_i + pairs[k, 0], start_j + pairs[k, 1]
        if not (usable[s] and usable[r]):
            continue
        got = _propose(
            ray[s], across[s], sigma[s], search[0], search[1], ratio[s], line[r], ends[r], sigma[r], M, a,
            False, min_overlap, max_relative, work,
        )  # fmt: skip
        reached[i] = max(reached[i], got)
        if got == PROPOSED:
            if count < len(out):
                out_index[count, 0], out_index[count, 1], out_index[count, 2] = i, neighbor, r
                out[count, 5] = score[k]
                for c in range(5):
                    out[count, c] = work[c]
            count += 1
    return count


@loop
def _bin_beams(beams, pointers, members):
    """Members of every bin of the angle about the baseline; members is None-sized on the first call (counts only)."""
    size = 2.0 * math.pi / NUM_BINS
    fill = np.zeros(NUM_BINS, np.int64)
    for j in range(len(beams)):
        low, high = int(np.floor(beams[j, 0] / size)), int(np.floor(beams[j, 1] / size))
        for k in range(low, min(high, low + NUM_BINS - 1) + 1):
            b = k % NUM_BINS
            if len(members):
                members[pointers[b] + fill[b]] = j
            fill[b] += 1
    if not len(members):
        for b in range(NUM_BINS):
            pointers[b + 1] = pointers[b] + fill[b]


@loop
def _point_lines(ends, line, near, search, ratio, pixel, inverse, tolerance, neighbor, out_index, out):
    """Lines through known points that lie on a segment in the image: inverse depth affine along the segment.

    Through several, with slot ``neighbor``; through one, in the segment's own direction, with slot ``neighbor + 1``.
    """
    count = 0
    t, q = np.empty(16), np.empty(16)
    for i in range(len(ends)):
        if near[i] == 0:
            continue
        ux, uy = ends[i, 2] - ends[i, 0], ends[i, 3] - ends[i, 1]
        length2 = ux * ux + uy * uy
        reach = 4.0 / math.sqrt(length2)
        number = 0
        for p in range(len(pixel)):
            if abs(line[i, 0] * pixel[p, 0] + line[i, 1] * pixel[p, 1] + line[i, 2]) > 2.0:
                continue
            at = ((pixel[p, 0] - ends[i, 0]) * ux + (pixel[p, 1] - ends[i, 1]) * uy) / length2
            if -reach <= at <= 1.0 + reach and number < 16:
                t[number], q[number] = at, inverse[p]
                number += 1
        if ratio[i, 0] > 0.0 and number > 0:
            # Scale q1 by the point that most others agree with.
            change, most, middle = ratio[i, 0] - 1.0, 0, 0.0
            for m in range(number):
                scale = q[m] / (1.0 + change * t[m])
                agree = 0
                for p in range(number):
                    if abs(scale * (1.0 + change * t[p]) - q[p]) < tolerance * q[p]:
                        agree += 1
                if agree > most:
                    most, middle = agree, scale
            q1, q2 = middle, ratio[i, 0] * middle
            if min(q1, q2) >= search[i, 0] and max(q1, q2) <= search[i, 1]:
                variance = (0.5 * tolerance * q1) ** 2
                out_index[count, 0], out_index[count, 1], out_index[count, 2] = i, neighbor + 1, -1
                out[count, 0], out[count, 1], out[count, 5] = q1, q2, 0.5
                out[count, 2], out[count, 3] = variance, ratio[i, 0] * variance
                out[count, 4] = ratio[i, 0] ** 2 * variance + (ratio[i, 1] * q1) ** 2 + 0.01 * variance
                count += 1
        best, first, second = 2, -1, -1
        for m in range(number):
            for n in range(m):
                if abs(t[m] - t[n]) < 0.3:
                    continue
                slope = (q[m] - q[n]) / (t[m] - t[n])
                agree = 0
                for p in range(number):
                    if abs(q[n] + slope * (t[p] - t[n]) - q[p]) < tolerance * q[p]:
                        agree += 1
                if agree > best:
                    best, first, second = agree, m, n
        if first < 0:
            continue
        slope = (q[first] - q[second]) / (t[first] - t[second])
        s0 = s1 = s2 = y0 = y1 = 0.0
        for p in range(number):
            if abs(q[second] + slope * (t[p] - t[second]) - q[p]) < tolerance * q[p]:
                u, v = 1.0 - t[p], t[p]
                s0, s1, s2 = s0 + u * u, s1 + u * v, s2 + v * v
                y0, y1 = y0 + u * q[p], y1 + v * q[p]
        determinant = s0 * s2 - s1 * s1
        if not determinant > 1e-6:
            continue
        q1, q2 = (s2 * y0 - s1 * y1) / determinant, (s0 * y1 - s1 * y0) / determinant
        if min(q1, q2) < search[i, 0] or max(q1, q2) > search[i, 1]:
            continue
        variance = (0.5 * tolerance * max(q1, q2)) ** 2
        out_index[count, 0], out_index[count, 1], out_index[count, 2] = i, neighbor, -1
        out[count, 0], out[count, 1], out[count, 5] = q1, q2, 0.5
        out[count, 2], out[count, 3] = variance * s2 / determinant, -variance * s1 / determinant
        out[count, 4] = variance * s0 / determinant
        count += 1
    return count


# ------------------------------------------------------------------------------------------------------------- Public
def angles_about_baseline(ray: FloatArray, baseline: FloatArray) -> FloatArray:
    """Intervals (n, 2) of the angles about a baseline that segments with rays (n, 2, 3) cover, low first.

    The angle of a ray about the baseline is the same for all points of an epipolar plane, whichever of the two images
    they are seen in. Intervals start in [-pi, pi) and are at most pi wide.
    """
    unit = baseline / np.linalg.norm(baseline)
    u = np.cross(unit, np.eye(3)[np.abs(unit).argmin()])
    u /= np.linalg.norm(u)
    angle = np.arctan2(ray @ np.cross(unit, u), ray @ u)
    turn = angle[:, 1] - angle[:, 0]
    turn -= 2 * np.pi * np.floor(turn / (2 * np.pi) + 0.5)
    low = np.where(turn < 0, angle[:, 0] + turn, angle[:, 0])
    return np.column_stack([low, low + np.abs(turn)])


class Proposer:
    """Makes the proposals of one image at a time; keeps the room for them between images."""

    def __init__(
        self, views: LineViews, ratios: FloatArray, directed: bool, min_overlap: float, max_relative_sigma: float
    ) -> None:
        self.views, self.ratios, self.directed = views, ratios, directed
        self.min_overlap, self.max_relative = min_overlap, max_relative_sigma
        self._index, self._values = np.empty((1 << 14, 3), np.int64), np.empty((1 << 14, 6))

    def propose(self, image: int, neighbors: IntArray, matches: list, near_points: tuple | None) -> Proposals:
        """Proposals for the segments of an image.

        Parameters
        ----------
        image : int
            The reference image.
        neighbors : (n,) int
            Its neighbours.
        matches : list of n (pairs, score) or None
            Matched segments (m, 2) and scores (m,); None for a neighbour takes all segments in the epipolar beam.
        near_points : (pixel (p, 2), inverse depth (p,)) or None
            Known points seen in the image.
        """
        views, rows = self.views, self.views.rows(image)
        usable = np.flatnonzero(views.usable[rows])
        reached = np.zeros(rows.stop - rows.start, np.int64)
        count = 0
        if near_points is not None and len(near_points[0]):
            self._reserve(0, 2 * reached.size)
            count = _point_lines(
                views.ends[rows], views.line[rows], views.usable[rows], views.range[rows], self.ratios[rows],
                *near_points, 0.01, len(neighbors), self._index, self._values,
            )  # fmt: skip
        for n, (j, given) in enumerate(zip(neighbors, matches, strict=True)):
            M, a = views.camera[j, :, :3].copy(), views.camera[j] @ np.append(views.center[image], 1.0)
            while True:
                if given is None:
                    needed = self._beam(image, int(j), n, count, rows, usable, reached, M, a)
                else:
                    search = views.inverse_depth[image]
                    needed = _propose_pairs(
                        given[0], given[1], rows.start, views.rows(j).start, views.ray, views.across, views.sigma,
                        search, self.ratios, views.line, views.ends, views.usable, M, a, self.min_overlap,
                        self.max_relative, count, n, self._index, self._values, reached,
                    )  # fmt: skip
                if needed <= len(self._values):
                    break
                self._reserve(count, needed)
            count = needed
        index = self._index[:count].copy()
        return Proposals(index[:, 0], index[:, 1], index[:, 2], self._values[:count].copy(), reached)

    def _reserve(self, keep: int, needed: int) -> None:
        if needed > len(self._values):
            index, values = np.empty((2 * needed, 3), np.int64), np.empty((2 * needed, 6))
            index[:keep], values[:keep] = self._index[:keep], self._values[:keep]
            self._index, self._values = index, values

    def _beam(self, image, j, n, count, rows, usable, reached, M, a) -> int:
        views = self.views
        baseline = views.center[j] - views.center[image]
        if not np.linalg.norm(baseline) > 0.0:
            return count
        rows_i, rows_j = rows.start + usable, views.rows(j).start + np.flatnonzero(views.usable[views.rows(j)])
        beam_i = angles_about_baseline(views.ray[rows_i], baseline)
        beam_j = angles_about_baseline(views.ray[rows_j], baseline)
        pointers = np.zeros(NUM_BINS + 1, np.int64)
        _bin_beams(beam_j, pointers, np.empty(0, np.int64))
        members = np.empty(pointers[-1], np.int64)
        if len(members):
            _bin_beams(beam_j, pointers, members)
        local = np.zeros(len(rows_i), np.int64)
        needed = _propose_beam(
            rows_i, rows_j, views.ray, views.across, views.sigma, views.range, self.ratios, views.line, views.ends,
            beam_i, beam_j, pointers, members, M, a, self.directed, self.min_overlap, self.max_relative, count, n,
            self._index, self._values, local,
        )  # fmt: skip
        self._index[count : min(needed, len(self._index)), 0] = usable[
            self._index[count : min(needed, len(self._index)), 0]
        ]
        reached[usable] = np.maximum(reached[usable], local)
        return needed
