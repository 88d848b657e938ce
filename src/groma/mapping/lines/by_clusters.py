# SPDX-License-Identifier: BSD-3-Clause
"""Lines of very many images: mapped cluster by cluster, and joined across borders.

Images are divided into clusters of covisibility, each with a ring of neighbours around it
(:mod:`groma.mapping.lines.clusters`). A cluster is two pieces of work, which any process may do:

1. the positions in space of the segments of its images, for which the segments of the ring are needed as well;
2. lines of these and of the ring: linked, fitted, merged and filtered as the lines of a whole scene are. Positions of
   the segments of the ring come from the clusters that these belong to.

A line that runs across a border is found by the clusters on both sides, each with the segments that it knows. Versions
of one line are joined and fitted anew (:mod:`groma.mapping.lines.linking.borders`). Noise, texture and what is usual
are estimated by each cluster from its own segments.

The result depends on the size of clusters, not on who works on them. A process needs memory for one cluster and its
ring; the one that puts lines together for all segments, their positions and the lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar, overload

import numpy as np

from groma._rows import pointers_of
from groma._typing import BoolArray, FloatArray, IntArray
from groma.execution import map_work
from groma.features.segments import Segments
from groma.mapping.lines.clusters import Cluster, clusters, rows_of_images
from groma.mapping.lines.collect import line_map_of
from groma.mapping.lines.filtering.filters import NEARBY, Evidence, SegmentKinds, filtered, is_edge
from groma.mapping.lines.filtering.texture import num_expected
from groma.mapping.lines.hypotheses.directions import depth_ratios
from groma.mapping.lines.hypotheses.earlier import EarlierMap
from groma.mapping.lines.hypotheses.positions import SegmentPositions, find_positions
from groma.mapping.lines.line_map import LineMap
from groma.mapping.lines.linking.borders import Borders, Found, joined
from groma.mapping.lines.linking.growth import grow
from groma.mapping.lines.linking.merge import merge_agreeing
from groma.mapping.lines.linking.tracks import Tracks
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.lines.outcomes import Outcome
from groma.mapping.lines.views import build_views, views_of_rows
from groma.scene import Scene

_Item = TypeVar("_Item")


def map_lines_by_clusters(
    scene: Scene,
    segments: Sequence[Segments],
    neighbors: list[IntArray],
    options: MapLinesOptions,
    progress: Callable[[str, int, int], None],
    earlier: EarlierMap | None = None,
) -> LineMap:
    """Build lines cluster by cluster; arguments and result as of :func:`groma.mapping.lines.build.map_lines`.

    ``neighbors`` are those of each image; ``options.cluster_size`` says how many images a cluster has at most.
    """
    pointers = pointers_of([len(one) for one in segments])
    count = -(-scene.num_images // options.cluster_size)
    whole = _Whole(scene, segments, neighbors, options)
    without_points = replace(whole, scene=scene.keep(points=[]))  # positions are all that they tell
    cut = clusters(neighbors, count, pointers)
    own_rows = [rows_of_images(one.images, pointers) for one in cut]

    def asked(k: int) -> tuple[_Part, EarlierMap | None]:
        part = _Part.of(cut[k], whole)
        return part, None if earlier is None else part.earlier(earlier)

    of_parts = map_work(_positions_of, _Made(asked, len(cut)), partial(progress, "proposing lines"))
    positions, ratios = _of_all(own_rows, of_parts)

    def part_with_positions(k: int) -> tuple[_Part, SegmentPositions]:
        return _Part.of(cut[k], without_points), _known(cut[k], positions)

    found = map_work(_lines_of, _Made(part_with_positions, len(cut)), partial(progress, "linking segments"))
    num_segments, num_images = int(pointers[-1]), scene.num_images
    outcomes, length = np.empty(num_segments, np.int64), np.empty(num_segments)
    home, known = np.empty(num_images, np.int64), np.zeros((len(cut), num_images), bool)
    for k, (cluster, one) in enumerate(zip(cut, found, strict=True)):
        home[cluster.images], known[k, cluster.known] = k, True
        outcomes[own_rows[k]], length[own_rows[k]] = one.outcomes, one.length
    rows = np.unique(np.concatenate([one.rows for one in found]))
    views = views_of_rows(scene, segments, rows, options.min_length, options.noise)
    image_idx = np.repeat(np.arange(num_images), np.diff(pointers))
    tracks = joined(found, Borders(home, known, image_idx), views, rows, options.min_images)
    outcomes[outcomes <= Outcome.RECOVERED] = Outcome.REPEATED  # those of no line in the end
    outcomes[rows] = tracks.outcomes()
    if options.min_repeatability > 0.0 and tracks.num_lines:
        tracks = tracks.keep(_is_edge(whole, tracks, rows, length, outcomes), Outcome.TEXTURE)
        outcomes[rows] = tracks.outcomes()
    return line_map_of(tracks, rows, pointers, outcomes, neighbors, positions, ratios)


class _Made(Sequence[_Item]):
    """So many pieces of work, each made when it is its turn: all at once would be several copies of the scene."""

    def __init__(self, make: Callable[[int], _Item], count: int) -> None:
        self._make, self._count = make, count

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> _Item: ...
    @overload
    def __getitem__(self, index: slice) -> list[_Item]: ...
    def __getitem__(self, index: int | slice) -> _Item | list[_Item]:
        if isinstance(index, slice):
            return [self._make(k) for k in range(self._count)[index]]
        return self._make(range(self._count)[index])


def _is_edge(whole: _Whole, tracks: Tracks, rows: IntArray, length: FloatArray, outcomes: IntArray) -> BoolArray:
    """(L,) lines that are no texture, which is learned from all segments, as for lines that are mapped at once."""
    scene, segments, options = whole.scene, whole.segments, whole.options
    line_of = np.full(len(outcomes), -1, np.int64)
    line_of[rows] = tracks.line_of
    strength, sigma = (np.concatenate([getattr(one, name) for one in segments]) for name in ("strength", "sigma"))
    kinds = SegmentKinds(length, strength, np.hypot(sigma, options.noise), outcomes)
    size = np.column_stack([scene.cameras.width, scene.cameras.height])[scene.images.camera_idx]
    expected = num_expected(tracks, whole.neighbors, size, options.min_length)
    return is_edge(kinds, line_of, tracks.num_images(), expected, options)


@dataclass(frozen=True, eq=False)
class _Whole:
    """All images, their segments and neighbours."""

    scene: Scene
    segments: Sequence[Segments]
    neighbors: list[IntArray]
    options: MapLinesOptions


@dataclass(frozen=True, eq=False)
class _Part:
    """What a cluster is told, in its own numbers of images: so much is sent to another process."""

    cluster: Cluster
    #: Cameras, and for positions the points that they see, of the cluster's images and its ring; and their segments.
    scene: Scene
    segments: list[Segments]
    #: Of each of these images, those among them.
    neighbors: list[IntArray]
    #: (m,) which of these images are the cluster's own.
    is_own: BoolArray
    options: MapLinesOptions

    @staticmethod
    def of(cluster: Cluster, whole: _Whole) -> _Part:
        """Take what a cluster needs out of the whole."""
        known = cluster.known
        near = [cluster.image(row[np.isin(row, known)]) for row in (whole.neighbors[i] for i in known)]
        segments, is_own = [whole.segments[i] for i in known], np.isin(known, cluster.images)
        return _Part(cluster, whole.scene.subset(known), segments, near, is_own, whole.options)

    def earlier(self, whole: EarlierMap) -> EarlierMap:
        """Return what an earlier map says of the images and segments that the cluster knows."""
        known, rows, lines = self.cluster.known, self.cluster.rows, whole.lines
        near = [
            np.where(np.isin(row, known), self.cluster.image(row), -1) for row in (lines.neighbors[i] for i in known)
        ]
        part = replace(
            lines,
            neighbors=tuple(near),
            supporters=_known_rows(self.cluster, lines.supporters[rows], len(lines.rejection)),
            rejection=lines.rejection[rows],
            depth_ratios=lines.depth_ratios[rows],
        )
        return EarlierMap(whole.scene.points_only().subset(known), part)


def _positions_of(asked: tuple[_Part, EarlierMap | None]) -> tuple[SegmentPositions, FloatArray]:
    """Places and changes of depth of the segments of the cluster's own images; supporters by their rows among all."""
    part, earlier = asked
    options = part.options
    views = build_views(part.scene, part.segments, options.min_length, options.noise, options.depth_margin)
    none = np.zeros(0, np.int64)
    near = [row if own else none for row, own in zip(part.neighbors, part.is_own, strict=True)]
    known = None if earlier is None else earlier.known(part.scene, views, near, options.noise)
    if earlier is not None and earlier.same_cameras(part.scene):
        ratios = earlier.lines.depth_ratios
    else:
        ratios = depth_ratios(part.scene, part.segments, views)
    found = find_positions(part.scene, views, ratios, near, None, options, lambda done, total: None, known)
    own = np.flatnonzero(part.is_own[views.image_idx])
    mine = found.take(own)
    return replace(mine, supporters=part.cluster.whole(mine.supporters).astype(np.int32)), ratios[own]


def _of_all(
    own_rows: Sequence[IntArray], of_parts: Sequence[tuple[SegmentPositions, FloatArray]]
) -> tuple[SegmentPositions, FloatArray]:
    """Places and changes of depth of all segments."""
    order = np.argsort(np.concatenate(own_rows))
    columns = {
        name: np.concatenate([getattr(one, name) for one, _ in of_parts])[order] for name in SegmentPositions.names()
    }
    return SegmentPositions(**columns), np.concatenate([ratios for _, ratios in of_parts])[order]


def _known(cluster: Cluster, whole: SegmentPositions) -> SegmentPositions:
    """The positions of segments that a cluster knows; supporters by its own rows, none where it does not know them."""
    positions = whole.take(cluster.rows)
    return replace(positions, supporters=_known_rows(cluster, positions.supporters, len(whole.found)))


def _known_rows(cluster: Cluster, rows: IntArray, count: int) -> IntArray:
    """Rows of so many segments as those of a cluster; those that it does not know, and those below zero, as -1."""
    known = np.zeros(count + 1, bool)
    known[cluster.rows] = True
    return cluster.row(np.where(known[rows], rows, -1))


def _lines_of(asked: tuple[_Part, SegmentPositions]) -> Found:
    """The lines of a cluster, which see a segment of its own images."""
    part, positions = asked
    options, rows = part.options, np.arange(len(part.cluster.rows))
    views = views_of_rows(part.scene, part.segments, rows, options.min_length, options.noise)
    own = part.is_own[views.image_idx]
    unmerged = grow(
        Tracks.none(views, positions.rejection), positions, part.neighbors, options, lambda done, total: None
    )
    evidence = Evidence(
        options=options,
        neighbors=part.neighbors,
        strength=np.concatenate([np.zeros(0), *(one.strength for one in part.segments)]),
        size=np.column_stack([part.scene.cameras.width, part.scene.cameras.height])[part.scene.images.camera_idx],
        unmerged=unmerged,
    )
    tracks = filtered(merge_agreeing(unmerged), evidence, NEARBY)
    outcomes = tracks.outcomes()[own]
    seen = np.append(np.zeros(tracks.num_lines, bool), False)
    seen[tracks.line_of[own]] = True
    tracks = tracks.keep(seen[:-1], Outcome.NOT_LINKED)
    rows, pointers = tracks.table()
    return Found(
        rows=part.cluster.rows[rows],
        line_idx=np.repeat(np.arange(tracks.num_lines), np.diff(pointers)),
        linked=tracks.linked[rows],
        sigma=tracks.sigma[rows],
        squared=tracks.squared[rows],
        lines=tracks.lines,
        uncertainty=tracks.uncertainty,
        unchecked=tracks.unchecked,
        outcomes=outcomes,
        length=views.length[own],
    )
