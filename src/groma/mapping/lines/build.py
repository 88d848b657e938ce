# SPDX-License-Identifier: BSD-3-Clause
"""3D lines from the segments of posed images.

Stages, each on all images before the next begins:

1. neighbours by the points that images share (:mod:`groma.mapping.lines.neighbors`);
2. for every segment, proposals of its place from every neighbour, and the one that most neighbours agree on
   (:mod:`groma.mapping.lines.places`), one image at a time;
3. tracks: link, refine, recover, merge, trim (:mod:`groma.mapping.lines.tracks`), and join what was mapped more than
   once (:mod:`groma.mapping.lines.merge`). Lines of texture are dropped: those of segments of a kind that is seldom
   found again (:mod:`groma.mapping.lines.kinds`), and those that few of the images show that should
   (:mod:`groma.mapping.lines.texture`); and so are lines that repeat another one beside it
   (:mod:`groma.mapping.lines.duplicates`).

Every segment ends with a :class:`Outcome` (:mod:`groma.mapping.lines.outcomes`), so that the question why a line is
missing has an answer.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError
from groma.mapping.lines.consensus import Choice
from groma.mapping.lines.directions import depth_ratios
from groma.mapping.lines.duplicates import not_duplicates
from groma.mapping.lines.kinds import found_again
from groma.mapping.lines.line_map import LineMap, explain
from groma.mapping.lines.matches import MatchProvider, external_matches, segment_matches
from groma.mapping.lines.merge import merge_agreeing
from groma.mapping.lines.neighbors import covisible_neighbors
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.lines.outcomes import UNKNOWN, Outcome
from groma.mapping.lines.places import choose_places
from groma.mapping.lines.texture import edge_odds, num_expected
from groma.mapping.lines.tracks import Tracks, link
from groma.mapping.lines.views import LineViews, build_views
from groma.scene import Lines, Scene

if TYPE_CHECKING:
    from groma.features.matching.wide_baseline import LineMatches
    from groma.features.segments import Segments


#: Log odds to be an edge below which a line is dropped: texture with a probability of 95 %.
TEXTURE_ODDS = float(np.log(0.05 / 0.95))
#: Segments that no neighbour or geometry lets become part of a line say nothing about others of their kind.
_IMPOSSIBLE = (Outcome.TOO_SHORT, Outcome.NO_NEIGHBOR, Outcome.DEGENERATE)


def map_lines(
    scene: Scene,
    segments: Sequence[Segments],
    matches: Mapping[tuple[int, int], LineMatches] | MatchProvider | None = None,
    options: MapLinesOptions | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    neighbors: Callable[[Scene], list[IntArray]] | None = None,
) -> LineMap:
    """Build 3D lines from the segments of posed images.

    Parameters
    ----------
    scene : Scene
        Images with cameras and poses. Points and their observations choose the neighbours and bound the depths.
    segments : sequence of C Segments
        By image of the scene; COLMAP pixels of the cameras as they are (with distortion, if they have one).
    matches : mapping or callable, optional
        LineMatches of images (i, j), pairs of segments of i and j; a pair that is missing or None is taken as
        unmatched. (j, i) is used where (i, j) is missing in a mapping. Without it every segment in the epipolar beam
        is a candidate.
    options : MapLinesOptions, optional
        Lengths, gates and counts.
    progress : callable, optional
        Called with stage, number done, number in all.
    neighbors : callable, optional
        Chooses for every image of a scene which others it is compared with, the best first, in place of
        :func:`~groma.mapping.lines.neighbors.covisible_neighbors`.

    Returns
    -------
    LineMap
        Perhaps without lines: :func:`explain` then says why.

    Raises
    ------
    InputError
        If the number of segment sets is not the number of images.

    Notes
    -----
    Time and memory grow with images x neighbours x segments; proposals are kept for one image only.
    """
    options = options or MapLinesOptions()
    if len(segments) != scene.num_images:
        raise InputError(
            f"segments must hold one set per image of the scene ({scene.num_images}); got {len(segments)}. "
            "Pass Segments.empty() for images without."
        )
    report = progress or (lambda stage, done, total: None)
    seconds: dict[str, float] = {}
    clock = time.perf_counter()

    def lap(stage: str) -> None:
        nonlocal clock
        now = time.perf_counter()
        seconds[stage], clock = seconds.get(stage, 0.0) + now - clock, now

    if neighbors is None:
        compared = covisible_neighbors(scene, options.num_neighbors, options.min_shared)
    else:
        compared = neighbors(scene)
    lap("neighbors")
    views = build_views(scene, segments, options.min_length, options.noise, options.depth_margin)
    lap("views")
    outcome = np.full(len(views.image_idx), UNKNOWN, np.int64)
    ratios = depth_ratios(scene, segments, views) if options.use_directions else np.zeros((len(outcome), 2))
    lap("directions")
    places = choose_places(scene, views, ratios, compared, matches, options, outcome, report)
    outcome[~views.usable] = Outcome.TOO_SHORT
    lap("proposals")
    strength = np.concatenate([np.zeros(0), *(one.strength for one in segments)])
    size = np.column_stack([scene.cameras.width, scene.cameras.height])[scene.images.camera_idx]
    tracks = _build_tracks(views, strength, size, compared, places, options, outcome, report)
    lap("tracks")
    return _result(tracks, compared, places, outcome, seconds)


def _build_tracks(
    views: LineViews,
    strength: FloatArray,
    size: IntArray,
    neighbors: list[IntArray],
    places: Choice,
    options: MapLinesOptions,
    outcome: IntArray,
    report: Callable[[str, int, int], None],
) -> Tracks:
    """Lines from places; updates the outcomes."""
    tracks, sigma = Tracks(views), views.sigma
    center = views.center[views.image_idx]
    safe = np.where(places.found[:, None], places.q, 1.0)
    points = center[:, None] + views.ray / safe[:, :, None]
    own, left = np.zeros(len(outcome), bool), np.zeros(len(outcome), bool)
    for attempt in range(2):
        # The second attempt links what the first left over, for example the smaller part of a group of two lines.
        report("tracks", attempt, 2)
        free = views.usable & (tracks.line_of < 0)
        members, representative = link(views, places.q, places.covariance, places.score, places.supporters, free)
        own[members] = True
        tracks.add(members, representative, points)
        tracks.refine()
        left[tracks.keep(tracks.num_images() >= 2)] = True
        if attempt == 0:
            scale = float(np.clip(tracks.noise_scale(), *options.noise_scale))
            views = tracks.views = replace(views, sigma=scale * views.sigma)
            tracks.refine()
            left[tracks.keep(tracks.num_images() >= 2)] = True
        for _ in range(2):
            tracks.recover(neighbors, views.usable, options.directed)
            tracks.refine()
            left[tracks.keep(tracks.num_images() >= 2)] = True
    # The darker side of an edge changes with what is behind it.
    tracks.recover(neighbors, views.usable, False)
    tracks.refine()
    left[tracks.keep(tracks.num_images() >= 2)] = True
    settled = np.append(_is_sure(tracks, options), False)[tracks.line_of]
    merge_agreeing(tracks)
    left[tracks.keep(tracks.num_images() >= 2)] = True
    # Left alone when all others of its line were dropped, or dropped itself; the later word counts for both.
    outcome[left & (tracks.line_of < 0)] = Outcome.FEW_IMAGES
    outcome[tracks.dropped & (tracks.line_of < 0)] = Outcome.OUTLIER
    outcome[tracks.keep(tracks.num_images() >= options.min_images)] = Outcome.FEW_IMAGES
    rows = np.flatnonzero(tracks.line_of >= 0)
    # What was sure stays so when it is joined to another line, whose noise then counts too.
    sure = np.bincount(tracks.line_of[rows], settled[rows], len(tracks.X)) > 0
    sure |= _is_sure(tracks, options)
    outcome[tracks.keep(sure)] = Outcome.UNCERTAIN
    outcome[tracks.keep(_not_texture(tracks, strength, sigma, size, neighbors, outcome, options))] = Outcome.TEXTURE
    outcome[tracks.keep(not_duplicates(tracks, _neighbors_of_neighbors(neighbors), options.min_images))] = (
        Outcome.REPEATED
    )
    longest = np.zeros(len(tracks.X))
    rows = np.flatnonzero(tracks.line_of >= 0)
    np.maximum.at(longest, tracks.line_of[rows], views.length[rows])
    outcome[tracks.keep(longest >= options.min_longest)] = Outcome.SHORT_LINE
    member = tracks.line_of >= 0
    outcome[member] = np.where(own[member], Outcome.MAPPED, Outcome.RECOVERED)
    return tracks


def _not_texture(
    tracks: Tracks,
    strength: FloatArray,
    sigma: FloatArray,
    size: IntArray,
    neighbors: list[IntArray],
    outcome: IntArray,
    options: MapLinesOptions,
) -> BoolArray:
    """(L,) lines of a kind that is found again, and seen where they should be."""
    if options.min_repeatability <= 0.0 or not len(tracks.X):
        return np.ones(len(tracks.X), bool)
    length = tracks.views.length
    possible = tracks.views.usable & ~np.isin(outcome, _IMPOSSIBLE)
    expected = num_expected(tracks, neighbors, size, options.min_length)
    odds = edge_odds(
        (length, strength, sigma), tracks.line_of, possible, tracks.num_images(), expected, options.min_images
    )
    again = found_again(length, strength, tracks.line_of, possible, len(tracks.X), options.min_repeatability)
    return again & (odds >= TEXTURE_ODDS)


def _neighbors_of_neighbors(neighbors: list[IntArray]) -> list[IntArray]:
    """Images that are neighbours, or have a neighbour in common."""
    none = np.empty(0, np.int64)
    return [np.unique(np.concatenate([none, row, *(neighbors[j] for j in row)])) for row in neighbors]


def _is_sure(tracks: Tracks, options: MapLinesOptions) -> BoolArray:
    """(L,) whether lines are known well enough, also without any one image.

    A line farther away than the usual one must be known as well as that one: a map is as good far away as it is near.
    """
    distance = _distance(tracks)
    usual = float(np.median(distance)) if len(distance) else 0.0
    sure = tracks.uncertainty <= options.max_uncertainty * np.minimum(distance, usual)
    if options.min_images > 2:
        sure &= tracks.unchecked <= options.max_unchecked * distance
    return sure


def _distance(tracks: Tracks) -> FloatArray:
    """(L,) mean distance of the lines' middles from the cameras that see them."""
    views, rows = tracks.views, np.flatnonzero(tracks.line_of >= 0)
    line = tracks.line_of[rows]
    away = np.linalg.norm(tracks.X[line].mean(1) - views.center[views.image_idx[rows]], axis=1)
    number = np.bincount(line, minlength=len(tracks.X))
    return np.bincount(line, away, minlength=len(tracks.X)) / np.maximum(number, 1)


def _result(
    tracks: Tracks, neighbors: list[IntArray], places: Choice, outcome: IntArray, seconds: dict[str, float]
) -> LineMap:
    """Collect the result; lines run like most of their segments."""
    views = tracks.views
    rows = np.flatnonzero(tracks.line_of >= 0)
    rows = rows[np.lexsort([views.image_idx[rows], tracks.line_of[rows]])]
    line_idx, image_idx = tracks.line_of[rows], views.image_idx[rows]
    X = tracks.X.copy()
    if len(X):
        turned = tracks.direction() < 0
        X[turned] = X[turned][:, ::-1]
    residual = np.sqrt(0.5 * tracks.squared[rows]) * views.sigma[rows]
    bounds = np.searchsorted(line_idx, np.arange(len(X) + 1))
    ordered = residual[np.lexsort([residual, line_idx])]
    low, high = (bounds[:-1] + bounds[1:] - 1) // 2, (bounds[:-1] + bounds[1:]) // 2
    median = 0.5 * (ordered[low] + ordered[high]) if len(X) else np.zeros(0)
    return LineMap(
        lines=Lines.through(X).plucker if len(X) else np.zeros((0, 6)),
        segments=X,
        image_idx=image_idx,
        segment_idx=rows - views.pointers[image_idx],
        line_idx=line_idx,
        residual=residual,
        num_images=tracks.num_images(),
        median_residual=median,
        uncertainty=tracks.uncertainty,
        outcomes=tuple(outcome[views.rows(i)] for i in range(len(views.camera))),
        neighbors=tuple(neighbors),
        assisted={name: int(places.assisted[rows, k].sum()) for k, name in enumerate(("points", "directions"))},
        seconds=seconds,
    )


__all__ = [
    "LineMap",
    "MapLinesOptions",
    "MatchProvider",
    "Outcome",
    "explain",
    "external_matches",
    "map_lines",
    "segment_matches",
]
