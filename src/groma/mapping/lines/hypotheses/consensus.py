# SPDX-License-Identifier: BSD-3-Clause
r"""The place of a segment on which most of its neighbours agree.

Proposals q, q' of different neighbours with covariances support each other by
:math:`(q - q')^\top (\Sigma + \Sigma')^{-1} (q - q')`. The best supported ones are fused in information form,

.. math:: \Sigma_f^{-1} = \sum w_j \Sigma_j^{-1}, \qquad \Sigma_f^{-1} q_f = \sum w_j \Sigma_j^{-1} q_j,

with one proposal per neighbour, and compared with all proposals again; the place with the largest support is kept.
Proposals from points and vanishing directions take part like those of a neighbour, but do not replace one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from groma._numba import inline_kernel, kernel, loop
from groma._ordering import ascending
from groma._typing import BoolArray, FloatArray, IntArray
from groma.gates import LINE_MAPS, gate
from groma.mapping.lines.gates import AGREEMENT
from groma.mapping.lines.hypotheses.proposals import Proposals


@dataclass(frozen=True)
class ConsensusGates:
    """When proposals agree."""

    num_seeds: int = gate(3, "proposals", "of a segment, fused and compared", "cost: one of them is the best")
    fusing_rounds: int = gate(3, "rounds", "of fusing and comparing again", "cost: the second changes little")
    half_weight: float = gate(4.0, "sigma^2", "squared distance at which a proposal counts half", LINE_MAPS)


GATES = ConsensusGates()


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _distance(d1, d2, c11, c12, c22):
    """Squared Mahalanobis distance."""
    return (c22 * d1 * d1 - 2.0 * c12 * d1 * d2 + c11 * d2 * d2) / max(c11 * c22 - c12 * c12, 1e-300)


@loop
def _sort(segment, neighbor, other, values, pointers, sorted_neighbor, sorted_other, sorted_values):
    """Write proposals by segment and, within one, by their first inverse depth; and where each segment's begin."""
    for k in range(len(segment)):
        pointers[segment[k] + 1] += 1
    for i in range(len(pointers) - 1):
        pointers[i + 1] += pointers[i]
    fill, order = pointers[:-1].copy(), np.empty(len(segment), np.int64)
    for k in range(len(segment)):
        order[fill[segment[k]]] = k
        fill[segment[k]] += 1
    for i in range(len(pointers) - 1):
        begin, end = pointers[i], pointers[i + 1]
        first = np.empty(end - begin)
        for k in range(begin, end):
            first[k - begin] = values[order[k], 0]
        by_depth = ascending(first)
        for k in range(begin, end):
            p = order[begin + by_depth[k - begin]]
            sorted_neighbor[k], sorted_other[k] = neighbor[p], other[p]
            for c in range(6):
                sorted_values[k, c] = values[p, c]


@inline_kernel
def _nearest_proposals(begin, end, neighbor, values, place, gate, used, nearest, chosen):
    """Write each neighbour's proposal that is nearest to a place, and mark all that agree with it as used."""
    q1, q2, c11, c12, c22 = place
    nearest[:] = gate
    chosen[:] = -1
    for r in range(begin, end):
        d1, d2 = values[r, 0] - q1, values[r, 1] - q2
        v11, v22 = values[r, 2] + c11, values[r, 4] + c22
        if d1 * d1 > gate * v11 or d2 * d2 > gate * v22:
            continue
        distance = _distance(d1, d2, v11, values[r, 3] + c12, v22)
        if distance < gate:
            used[r - begin] = True
        if distance < nearest[neighbor[r]]:
            nearest[neighbor[r]], chosen[neighbor[r]] = distance, r


@inline_kernel
def _sum_up(values, chosen, nearest, num_neighbors, gate, half_weight):
    """Return how many neighbours and whether points agree, their support, and their information on the place."""
    number, points, value = 0, 0, 0.0
    i11 = i12 = i22 = y1 = y2 = 0.0
    for n in range(num_neighbors + 2):
        r = chosen[n]
        if r < 0:
            continue
        if n >= num_neighbors:
            points = 1
        else:
            number += 1
        weight = 1.0 / (1.0 + nearest[n] / half_weight)
        value += values[r, 5] * (1.0 - nearest[n] / gate)
        determinant = values[r, 2] * values[r, 4] - values[r, 3] * values[r, 3]
        if not determinant > 0.0:
            continue
        w11, w12, w22 = values[r, 4] / determinant, -values[r, 3] / determinant, values[r, 2] / determinant
        i11, i12, i22 = i11 + weight * w11, i12 + weight * w12, i22 + weight * w22
        y1 += weight * (w11 * values[r, 0] + w12 * values[r, 1])
        y2 += weight * (w12 * values[r, 0] + w22 * values[r, 1])
    return number, points, value, (i11, i12, i22), (y1, y2)


@loop
def _support(pointers, neighbor, values, num_neighbors, gate, total):
    """Support of every proposal of every segment by the proposals of other neighbours: total (M,)."""
    for i in range(len(pointers) - 1):
        begin, end = pointers[i], pointers[i + 1]
        largest = 0.0
        best = np.zeros((end - begin, num_neighbors + 2))  # by each neighbour
        for k in range(begin, end):
            largest = max(largest, values[k, 2])
            best[k - begin, neighbor[k]] = values[k, 5]
        for k in range(begin, end):
            reach = math.sqrt(gate * (values[k, 2] + largest))
            for m in range(k + 1, end):
                d1 = values[m, 0] - values[k, 0]
                if d1 > reach:
                    break
                d2 = values[m, 1] - values[k, 1]
                c11, c22 = values[m, 2] + values[k, 2], values[m, 4] + values[k, 4]
                if d1 * d1 > gate * c11 or d2 * d2 > gate * c22 or neighbor[m] == neighbor[k]:
                    continue
                distance = _distance(d1, d2, c11, values[m, 3] + values[k, 3], c22)
                if distance < gate:
                    share = 1.0 - distance / gate
                    best[k - begin, neighbor[m]] = max(best[k - begin, neighbor[m]], values[m, 5] * share)
                    best[m - begin, neighbor[k]] = max(best[m - begin, neighbor[k]], values[k, 5] * share)
        for k in range(begin, end):
            total[k] = best[k - begin].sum()


@loop
def _choose(pointers, neighbor, other, values, total, num_neighbors, gate, half_weight, num_seeds, num_rounds,
            min_support, q, covariance, score, supporters, rival):  # fmt: skip
    """Fuse the best supported proposals of each segment and keep the one that most neighbours agree on."""
    chosen = np.empty(num_neighbors + 2, np.int64)
    nearest = np.empty(num_neighbors + 2)
    for i in range(len(pointers) - 1):
        begin, end = pointers[i], pointers[i + 1]
        used = np.zeros(end - begin, np.bool_)
        for _ in range(num_seeds):
            seed, top = -1, 0.0
            for k in range(begin, end):
                if not used[k - begin] and total[k] > top:
                    seed, top = k, total[k]
            if seed < 0 or top <= score[i] - 1.0:
                break
            p = seed
            q1, q2, c11, c12, c22 = values[p, 0], values[p, 1], values[p, 2], values[p, 3], values[p, 4]
            number, points, value = 0, 0, 0.0
            for _ in range(num_rounds):  # fuse, compare again
                _nearest_proposals(begin, end, neighbor, values, (q1, q2, c11, c12, c22), gate, used, nearest, chosen)
                number, points, value, information, y = _sum_up(
                    values, chosen, nearest, num_neighbors, gate, half_weight
                )
                i11, i12, i22 = information
                y1, y2 = y
                determinant = i11 * i22 - i12 * i12
                if not determinant > 0.0:
                    break
                c11, c12, c22 = i22 / determinant, -i12 / determinant, i11 / determinant
                q1, q2 = c11 * y1 + c12 * y2, c12 * y1 + c22 * y2
            if number < min_support or number + points < 2:
                continue
            if value > score[i]:
                rival[i] = score[i]
                score[i] = value
                q[i, 0], q[i, 1] = q1, q2
                covariance[i, 0], covariance[i, 1], covariance[i, 2] = c11, c12, c22
                for n in range(num_neighbors):
                    supporters[i, n] = other[chosen[n]] if chosen[n] >= 0 else -1
            elif value > rival[i]:
                rival[i] = value


# ------------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, eq=False)
class Choice:
    """The place chosen for each segment of an image."""

    #: (n,) whether enough neighbours agree on one.
    found: BoolArray
    #: (n, 2) inverse depths of the end points.
    q: FloatArray
    #: (n, 3) their variances and covariance, c11 c12 c22.
    covariance: FloatArray
    #: (n,) summed support.
    score: FloatArray
    #: (n,) support of the best place that disagrees.
    rival: FloatArray
    #: (n, num_neighbors) rows of the supporting segments, -1 for none.
    supporters: IntArray


def choose(proposals: Proposals, num_segments: int, num_neighbors: int, min_support: int) -> Choice:
    """Choose the place of each segment by the summed support of distinct neighbours."""
    neighbor, other = np.empty_like(proposals.neighbor), np.empty_like(proposals.other)
    values, pointers = np.empty_like(proposals.values), np.zeros(num_segments + 1, np.int64)
    _sort(proposals.segment, proposals.neighbor, proposals.other, proposals.values, pointers, neighbor, other, values)
    total, max_squared = np.zeros(len(values)), AGREEMENT.max_squared(2)
    _support(pointers, neighbor, values, num_neighbors, max_squared, total)
    q, covariance = np.zeros((num_segments, 2)), np.zeros((num_segments, 3))
    score, rival = np.zeros(num_segments), np.zeros(num_segments)
    supporters = np.full((num_segments, num_neighbors), -1, np.int64)
    _choose(
        pointers, neighbor, other, values, total, num_neighbors, max_squared, GATES.half_weight, GATES.num_seeds,
        GATES.fusing_rounds, min_support, q, covariance, score, supporters, rival,
    )  # fmt: skip
    return Choice(score > 0.0, q, covariance, score, rival, supporters)
