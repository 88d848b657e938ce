# SPDX-License-Identifier: BSD-3-Clause
"""The place of every segment in space: what every neighbour proposes, and what most of them agree on.

One image at a time: proposals from the segments of its neighbours, from known points and vanishing directions
(:mod:`groma.mapping.lines.hypotheses.proposals`), then the choice among them
(:mod:`groma.mapping.lines.hypotheses.consensus`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError
from groma.execution import map_in_threads, map_largest_first, map_work, num_calls
from groma.features.matches import LineMatches
from groma.mapping.groups import distinct_pairs, grouped
from groma.mapping.lines.clusters import Cluster, clusters
from groma.mapping.lines.hypotheses.consensus import choose
from groma.mapping.lines.hypotheses.earlier import Known
from groma.mapping.lines.hypotheses.proposals import WEAK, Proposer, Questions
from groma.mapping.lines.matches import MatchProvider
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.lines.outcomes import Outcome
from groma.mapping.lines.views import LineViews
from groma.scene import Scene


@dataclass(frozen=True, eq=False)
class SegmentPositions:
    """Where the segments (S,) of all images, or of some, lie in space."""

    #: (S,) whether enough neighbours agree on a place.
    found: BoolArray
    #: (S, 2) inverse depths of the end points.
    q: FloatArray
    #: (S, 3) their variances and covariance, c11 c12 c22.
    covariance: FloatArray
    #: (S,) summed support; zero where there is no place.
    score: FloatArray
    #: (S, n) rows of the supporting segments, -1 for none.
    supporters: IntArray
    #: (S,) the :class:`Outcome` of each segment, should it not become part of a line.
    rejection: IntArray

    @staticmethod
    def none(count: int, width: int, rejection: Outcome) -> SegmentPositions:
        """No positions, for this reason, of so many segments with room for so many supporters."""
        return SegmentPositions(
            found=np.zeros(count, bool),
            q=np.zeros((count, 2)),
            covariance=np.zeros((count, 3)),
            score=np.zeros(count),
            supporters=np.full((count, width), -1),
            rejection=np.full(count, rejection, np.int64),
        )

    @staticmethod
    def names() -> tuple[str, ...]:
        """The columns."""
        return tuple(item.name for item in fields(SegmentPositions))

    def where(self, chosen: BoolArray, other: SegmentPositions) -> SegmentPositions:
        """Return these positions where chosen (S,), and those of another elsewhere."""
        columns = {}
        for name in self.names():
            one, two = getattr(self, name), getattr(other, name)
            columns[name] = np.where(chosen.reshape(-1, *[1] * (one.ndim - 1)), one, two)
        return SegmentPositions(**columns)

    def take(self, rows: IntArray) -> SegmentPositions:
        """Return the positions of some segments; supporters keep their numbers."""
        return SegmentPositions(**{name: getattr(self, name)[rows] for name in self.names()})

    @cached_property
    def edges(self) -> IntArray:
        """(E, 2) pairs of segments that have positions, one of which supports the other; the smaller number first."""
        first, which = np.nonzero(self.supporters >= 0)
        second = self.supporters[first, which]
        both = self.found[first] & self.found[second]
        return distinct_pairs(np.minimum(first, second)[both], np.maximum(first, second)[both])[0]

    def ends_in_space(self, views: LineViews) -> FloatArray:
        """(S, 2, 3) end points in the world; meaningless without a place."""
        center = views.center[views.image_idx]
        return center[:, None] + views.ray / np.where(self.found[:, None], self.q, 1.0)[:, :, None]


def find_positions(
    scene: Scene,
    views: LineViews,
    ratios: FloatArray,
    neighbors: list[IntArray],
    matches: Mapping[tuple[int, int], LineMatches] | MatchProvider | None,
    options: MapLinesOptions,
    progress: Callable[[int, int], None],
    known: Sequence[Known] | None = None,
) -> SegmentPositions:
    """Return the place of every segment of every image.

    Parameters
    ----------
    scene, views
        Points with their observations, and the segments.
    ratios : (S, 2) float64
        Change of depth along each segment and its standard deviation; zero where nothing tells it.
    neighbors : list of C arrays
        Neighbours of each image.
    matches
        As for :func:`groma.mapping.lines.build.map_lines`.
    options, progress
        Gates; called with the number of images done and in all.
    known : sequence of C Known, optional
        What an earlier map says of each image.
    """
    points = _points_by_image(scene, views)
    work = list(zip(range(len(neighbors)), neighbors, points, known or [None] * len(neighbors), strict=True))
    proposer, calls = Proposer(views, ratios, options), num_calls()
    if calls and matches is None:
        parts = [_Part.of(cluster, proposer, work) for cluster in clusters(neighbors, calls, views.pointers)]
        in_order = np.argsort(np.concatenate([part.cluster.images for part in parts]))
        by_part = [place for positions in map_work(_positions_of, parts, progress) for place in positions]
        found = [by_part[place] for place in in_order]
    else:
        sizes = [int(own) * len(others) for own, others in zip(np.diff(views.pointers), neighbors, strict=True)]
        found = map_largest_first(partial(_positions_in, proposer, matches), work, sizes, progress)
    found = [SegmentPositions.none(0, max(1, options.num_neighbors), Outcome.NO_MATCH), *found]
    columns = {name: np.concatenate([getattr(one, name) for one in found]) for name in SegmentPositions.names()}
    columns["rejection"][~views.usable] = Outcome.TOO_SHORT
    return SegmentPositions(**columns)


#: Of one image: its number, neighbours, known points, and what else is known.
_Image = tuple[int, IntArray, tuple[FloatArray, FloatArray], Known | None]


@dataclass(frozen=True, eq=False)
class _Part:
    """What is asked of the images of a cluster, in the numbers of the cluster: so much is sent to another process."""

    cluster: Cluster
    proposer: Proposer
    images: list[_Image]

    @staticmethod
    def of(cluster: Cluster, proposer: Proposer, images: Sequence[_Image]) -> _Part:
        """Take the part of a cluster out of the whole."""
        mine = []
        for i in cluster.images:
            _, others, points, known = images[i]
            if known is not None:
                known = replace(known, supporters=cluster.row(known.supporters))
            mine.append((int(cluster.image(i)), cluster.image(others), points, known))
        views = cluster.views(proposer.views)
        return _Part(cluster, replace(proposer, views=views, ratios=proposer.ratios[cluster.rows]), mine)


def _positions_of(part: _Part) -> list[SegmentPositions]:
    """The place of every segment of the images of a cluster."""
    found = (_positions_in(part.proposer, None, image) for image in part.images)
    return [replace(positions, supporters=part.cluster.whole(positions.supporters)) for positions in found]


def _positions_in(
    proposer: Proposer, matches: Mapping[tuple[int, int], LineMatches] | MatchProvider | None, image: _Image
) -> SegmentPositions:
    """The same of one image."""
    views, (i, others, points, known) = proposer.views, image
    rows, width = views.rows(i), max(1, proposer.options.num_neighbors)
    count = rows.stop - rows.start
    if len(others) == 0:
        return SegmentPositions.none(count, width, Outcome.NO_NEIGHBOR)
    if known is None:
        given = [_given(matches, i, int(j)) for j in others]
        for j, pairs in zip(others, given, strict=True):
            _check_pairs(pairs, i, int(j), views)
        return _agreed(proposer, Questions(i, others, given, points), width)
    given = [known.pairs(n, views.rows(int(j)).start) for n, j in enumerate(others)]
    supported = _agreed(proposer, Questions(i, others, given, points), width)
    had_none = known.rejection != Outcome.NOT_LINKED
    supported = replace(supported, rejection=np.where(had_none, known.rejection, supported.rejection))
    if not known.moved:
        return supported
    searched = _agreed(proposer, Questions(i, others, [None] * len(others), points, ~supported.found), width)
    return supported.where(supported.found, searched)


def _agreed(proposer: Proposer, asked: Questions, width: int) -> SegmentPositions:
    """The positions on which proposals agree, with room for so many supporters."""
    options, others = proposer.options, asked.neighbors
    proposals = proposer.propose(asked)
    count = len(proposals.reached)
    # A line of min_images images is this segment and min_images - 1 neighbours; two of them must agree.
    chosen = choose(proposals, count, len(others), max(1, min(2, options.min_images - 1)))
    ambiguous = chosen.found & (chosen.rival > options.max_rival * chosen.score)
    found = chosen.found & ~ambiguous
    supporters = np.full((count, width), -1)
    supporters[found, : len(others)] = chosen.supporters[found]
    rejection = np.select(
        [found, ambiguous, proposals.reached > WEAK, proposals.reached == WEAK],
        [Outcome.NOT_LINKED, Outcome.AMBIGUOUS, Outcome.NO_SUPPORT, Outcome.DEGENERATE],
        Outcome.NO_MATCH,
    )
    return SegmentPositions(
        found, chosen.q, chosen.covariance, np.where(found, chosen.score, 0.0), supporters, rejection
    )


def _given(
    matches: Mapping[tuple[int, int], LineMatches] | MatchProvider | None, i: int, j: int
) -> tuple[IntArray, FloatArray] | None:
    """Pairs and scores between two images; None where every segment is a candidate."""
    if matches is None:
        return None
    if callable(matches):
        found = matches(i, j)
    else:
        found, turned = matches.get((i, j)), matches.get((j, i))
        if found is None and turned is not None:
            return np.ascontiguousarray(turned.pairs[:, ::-1], np.int64), np.asarray(turned.score, float)
    if found is None:
        return np.empty((0, 2), np.int64), np.empty(0)
    return np.ascontiguousarray(found.pairs, np.int64), np.asarray(found.score, float)


def _check_pairs(given: tuple[IntArray, FloatArray] | None, i: int, j: int, views: LineViews) -> None:
    if given is None or len(given[0]) == 0:
        return
    sizes = np.array([views.pointers[i + 1] - views.pointers[i], views.pointers[j + 1] - views.pointers[j]])
    if given[0].min() < 0 or (given[0] >= sizes).any():
        raise InputError(
            f"Matches of images {i} and {j} must refer to their {sizes[0]} and {sizes[1]} segments; got indices up to "
            f"{given[0].max(0).tolist()}. Match the same segments that are mapped."
        )


def _points_by_image(scene: Scene, views: LineViews) -> list[tuple[FloatArray, FloatArray]]:
    """Pixels and inverse depths of the points seen in each image."""
    observations = scene.point_observations
    order, bounds = grouped(observations.image_idx, scene.num_images)

    def near(i: int) -> tuple[FloatArray, FloatArray]:
        xyz = scene.points.xyz[observations.point_idx[order[bounds[i] : bounds[i + 1]]]]
        x = xyz @ views.camera[i, :, :3].T + views.camera[i, :, 3]
        x = x[x[:, 2] > 0.0]
        return x[:, :2] / x[:, 2:], 1.0 / x[:, 2]

    return map_in_threads(near, range(scene.num_images))
