# SPDX-License-Identifier: BSD-3-Clause
"""Matches of segments between two images, and how rivals are settled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError, ShapeError
from groma.features.segments import SEGMENTS, Segments


@dataclass(frozen=True)
class LineMatches:
    """Pairs of segments that may show the same edge."""

    #: (M, 2) index of the segment in the first and in the second image.
    pairs: IntArray

    #: (M,) between 0 and 1, higher is better.
    score: FloatArray

    def __post_init__(self) -> None:
        pairs = np.asarray(self.pairs)
        if pairs.ndim != 2 or pairs.shape[1] != 2:
            raise ShapeError(f"pairs must have shape (M, 2); got {pairs.shape}. Reshape it to (-1, 2).")
        if len(pairs) and not np.issubdtype(pairs.dtype, np.integer):
            raise InputError(f"pairs must be integers, segment indices; got {pairs.dtype}. Convert them with astype.")
        score = np.asarray(self.score, dtype=np.float64)
        if score.shape != (len(pairs),):
            raise ShapeError(f"score must have shape ({len(pairs)},), one a pair; got {score.shape}.")
        object.__setattr__(self, "pairs", pairs.astype(np.int64))
        object.__setattr__(self, "score", score)

    def __len__(self) -> int:
        return len(self.pairs)

    def select(self, rows: IntArray | BoolArray) -> LineMatches:
        """Matches of the given rows: indices or a mask."""
        return LineMatches(self.pairs[rows], self.score[rows])

    def swapped(self) -> LineMatches:
        """The same matches, second image first."""
        return LineMatches(self.pairs[:, ::-1], self.score)

    def check(self, num_first: int, num_second: int) -> None:
        """Raise InputError unless all indices are below the numbers of segments of the images."""
        if len(self) and (self.pairs.min() < 0 or (self.pairs.max(axis=0) >= (num_first, num_second)).any()):
            low, high = self.pairs.min(axis=0), self.pairs.max(axis=0)
            raise InputError(
                f"Matches must refer to segments 0 to {num_first - 1} and 0 to {num_second - 1}; got indices from "
                f"{low.tolist()} to {high.tolist()}. Were they made from other segments?"
            )

    @staticmethod
    def empty() -> LineMatches:
        """No matches."""
        return LineMatches(np.zeros((0, 2), dtype=np.int64), np.zeros(0))


def mutual_best(
    first: IntArray,
    second: IntArray,
    score: FloatArray,
    evidence: FloatArray,
    segments_1: Segments,
    segments_2: Segments,
    margin: float,
) -> LineMatches:
    """Candidates that are best for both their segments, by a margin over every rival that is another line.

    Parameters
    ----------
    first, second : (C,) int
        Candidate pairs, each at most once.
    score : (C,) float64
        Between 0 and 1.
    evidence : (C,) float64
        What is compared, rising with the score: a logarithm of odds or of the score, in which differences count.
    segments_1, segments_2 : Segments
        A rival collinear with the best (a piece of the same edge) does not count as a rival.
    margin : float
        A rival's evidence must be less than the best's by at least this much.
    """
    if not len(score):
        return LineMatches.empty()
    best_1, rival_1 = _best_and_rival(first, second, evidence, segments_2)
    best_2, rival_2 = _best_and_rival(second, first, evidence, segments_1)
    rows = np.arange(len(score))
    limit = evidence - margin
    keep = (best_1[first] == rows) & (best_2[second] == rows) & (rival_1[first] <= limit) & (rival_2[second] <= limit)
    return LineMatches(np.stack([first[keep], second[keep]], axis=1), score[keep])


def _best_and_rival(
    owner: IntArray, other: IntArray, evidence: FloatArray, segments: Segments
) -> tuple[IntArray, FloatArray]:
    """For each owner: row of its best candidate (-1 without), and the most evidence for another line (-inf without)."""
    order = np.lexsort((other, -evidence, owner))
    head = np.ones(len(order), dtype=bool)
    head[1:] = owner[order][1:] != owner[order][:-1]
    best = np.full(int(owner.max()) + 1, -1, dtype=np.int64)
    best[owner[order][head]] = order[head]
    chosen = other[best[owner]]
    line, ends = segments.line[chosen], segments.ends[other]
    distance = np.maximum(
        np.abs((line[:, :2] * ends[:, :2]).sum(axis=1) + line[:, 2]),
        np.abs((line[:, :2] * ends[:, 2:]).sum(axis=1) + line[:, 2]),
    )
    is_rival = (other != chosen) & (distance > SEGMENTS.on + SEGMENTS.collinear * segments.length[other])
    rival = np.full(len(best), -np.inf)
    np.maximum.at(rival, owner[is_rival], evidence[is_rival])
    return best, rival
