# SPDX-License-Identifier: BSD-3-Clause
r"""Lines that meet: corners and branches of edges.

Two lines meet where the distance between them, measured where they come nearest, is within the noise of both there, and
where both are seen up to that place. As lines pass each other by chance, too, distances are a mixture of those of lines
that meet and of evenly spread ones (:mod:`groma.estimators.membership`); a pair is kept if it is none by chance. How
far ends deviate from where lines meet is estimated in the same way: inner edges of a window end farther before the
outer ones than the ends of edges before their corners.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from groma._trees import kd_tree, nearest
from groma._typing import FloatArray, IntArray
from groma.estimators.membership import Candidates, memberships
from groma.gates import SEARCH, STRUCTURE, chi_square_gate, gate
from groma.geometry.algebra import dot, norm, unit
from groma.mapping.groups import distinct_pairs
from groma.mapping.structure.relations import Landmarks, Pairs, samples_of


@dataclass(frozen=True)
class JunctionGates:
    """Which lines may meet."""

    reach_px: float = gate(8.0, "px", "from the end of a line to the place of meeting", STRUCTURE)
    end_px: float = gate(0.29, "px", "least deviation of the end of a line", "derived from a place within a pixel")
    freedom: float = gate(4.0, "1", "degrees of freedom of Student's distribution of line ends", STRUCTURE)
    most_px: float = gate(1.0, "px", "that lines that meet may miss each other", "chosen on benchmarks/structure.py")
    min_sine: float = gate(0.17, "1", "of the angle of two lines that meet", "convention: ten degrees")
    nearest: int = gate(24, "samples", "of lines that an end of a line is compared with", SEARCH)
    max_samples: int = gate(256, "samples", "of a line", "cost: memory")


GATES = JunctionGates()


def meetings(marks: Landmarks, level: float, least: float) -> Pairs:
    """Pairs (first, second) of usable lines that meet, the smaller number first."""
    rows = np.flatnonzero(marks.line_usable)
    if len(rows) < 2:
        return Pairs.empty()
    pairs = rows[_neighbours(marks.segments[rows], marks.line_pixel[rows])]
    first, second = pairs.T
    ends = marks.segments
    start = ends[first, 0], ends[second, 0]
    along = ends[first, 1] - start[0], ends[second, 1] - start[1]
    crossed = np.cross(unit(along[0]), unit(along[1]))
    sine = norm(crossed)
    normal = crossed / np.maximum(sine, 1e-12)[:, None]
    between = start[1] - start[0]
    # Shares of the segments at which the lines come nearest to each other.
    scale = np.maximum(sine, 1e-12) ** 2
    share = tuple(
        dot(np.asarray(np.cross(between, unit(other)), np.float64), crossed) / (scale * norm(own))
        for own, other in ((along[0], along[1]), (along[1], along[0]))
    )
    pixel = 0.5 * (marks.line_pixel[first] + marks.line_pixel[second])
    near = (sine > GATES.min_sine) & (np.abs(dot(between, normal)) < GATES.reach_px * pixel)
    gap = []
    for line, place in ((first, share[0]), (second, share[1])):
        length_px = norm(ends[line, 1] - ends[line, 0]) / marks.line_pixel[line]
        gap.append((np.abs(place - 0.5) - 0.5) * length_px)  # beyond the nearer end, below zero before it
        near &= marks.intervals.covers(line, np.clip(place, 0.0, 1.0), 1e-9) & (gap[-1] < GATES.reach_px)
    # Lines that both go on cross in front of each other, or on a surface.
    kept = np.flatnonzero(near & (np.maximum(*gap) > -GATES.reach_px))
    if len(kept) == 0:
        return Pairs.empty()
    variance = np.zeros(len(kept))
    for line, place in ((first[kept], share[0][kept]), (second[kept], share[1][kept])):
        slope = np.einsum("nai,ni->na", marks.own_line_noise.across[line], normal[kept])
        variance += np.einsum("na,nab,nb->n", slope, marks.own_line_noise.at(place, place, line), slope)
    distance = (dot(between, normal) / pixel)[kept]
    candidates = _candidates(distance, variance / pixel[kept] ** 2, np.column_stack(gap)[kept])
    told = memberships(candidates, np.array([GATES.most_px]))
    deviation = told.deviation[0]
    passed = distance**2 < chi_square_gate(1.0 - level, 1) * (candidates.variance[:, 0] + deviation**2)
    passed &= told.probability > least
    return Pairs(pairs[kept], told.probability, np.full(len(kept), deviation)).take(passed)


def _candidates(distance: FloatArray, variance: FloatArray, gap: FloatArray) -> Candidates:
    """Distances with their variances (N,) and gaps at the ends (N, 2), all in pixels, as one mixture.

    The gap at the end of a line tells something where the line ends, with the deviation that the ends of the scene
    have; where it goes on it is as likely either way.
    """
    even, num = 0.5 / GATES.reach_px, len(distance)
    ending = gap > -GATES.reach_px
    end_variance = np.where(ending, GATES.end_px**2, 0.5 / (np.pi * even**2))
    candidates = Candidates(
        owner=np.zeros(num, np.int64),
        offset=np.column_stack([distance, np.where(ending, gap, 0.0)]),
        variance=np.column_stack([variance, end_variance]),
        unit=np.column_stack([np.zeros(num), ending.astype(np.float64)]),
        clutter=np.full(num, 0.5 / GATES.reach_px * even**2),
        counted=np.ones(num, bool),
        group=np.zeros(num, np.int64),
    )
    scale = memberships(candidates, np.array([GATES.reach_px])).deviation[0] * candidates.unit
    square = candidates.variance + scale**2
    # Errors of ends have heavy tails: offsets at which a normal density falls as Student's does.
    tailed = np.sqrt((GATES.freedom + 1) * square * np.log1p(candidates.offset**2 / (GATES.freedom * square)))
    return replace(
        candidates,
        offset=np.where(candidates.unit > 0.0, tailed, candidates.offset),
        variance=square,
        unit=np.tile([1.0, 0.0, 0.0], (num, 1)),
    )


def _neighbours(segments: FloatArray, pixel: FloatArray) -> IntArray:
    """Pairs (M, 2) of segments, one of which ends near the other; the smaller number first."""
    length = norm(segments[:, 1] - segments[:, 0])
    count = np.clip(np.ceil(length / (GATES.reach_px * pixel)), 2, GATES.max_samples).astype(np.int64)
    samples, owner = samples_of(segments, count)
    ends = segments.reshape(-1, 3)
    number = min(GATES.nearest, len(samples))
    _, index = nearest(kd_tree(samples), ends, number)
    one, other = np.repeat(np.arange(len(ends)) // 2, number), owner[index].ravel()
    different = one != other
    low, high = np.minimum(one, other)[different], np.maximum(one, other)[different]
    return distinct_pairs(low, high)[0]
