# SPDX-License-Identifier: BSD-3-Clause
"""3D lines from the segments of posed images.

Stages, each on all images before the next begins:

1. neighbours by the points that images share (:mod:`groma.pipelines._neighbors`);
2. for every segment, proposals of its place from every neighbour (:mod:`groma.pipelines._line_proposals`), and the
   one most neighbours agree on (:mod:`groma.pipelines._line_support`), one image at a time;
3. tracks: link, refine, recover, merge, trim (:mod:`groma.pipelines._line_tracks`), and join what was mapped more than
   once (:mod:`groma.pipelines._line_merge`).

Every segment ends with a :class:`Fate`, so that the question why a line is missing has an answer.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError
from groma.pipelines._line_directions import depth_ratios
from groma.pipelines._line_matches import MatchProvider, external_matches, flow_matches, wide_baseline_matches
from groma.pipelines._line_merge import merge_agreeing
from groma.pipelines._line_proposals import WEAK, Proposer
from groma.pipelines._line_support import Choice, choose
from groma.pipelines._line_tracks import Tracks, link
from groma.pipelines._line_views import LineViews, build_views
from groma.pipelines._neighbors import covisible_neighbors
from groma.scene import LineObservations, Lines, Relations, Scene

if TYPE_CHECKING:
    from groma.frontend.matching import LineMatches
    from groma.frontend.segments import Segments


class Fate(IntEnum):
    """What became of a segment. Members are in the order of the stages."""

    #: It observes a line.
    MAPPED = 0
    #: It observes a line, found by projecting the line, not by its own proposals.
    RECOVERED = 1
    #: Shorter than ``min_length``, or where the camera cannot undo its distortion.
    TOO_SHORT = 2
    #: Its image shares too few points with others.
    NO_NEIGHBOR = 3
    #: No segment of a neighbour can be the same line: none in the epipolar beam at a plausible depth, or none matched.
    NO_MATCH = 4
    #: Every candidate leaves the depth open: the line runs along the epipolar lines of all neighbours.
    DEGENERATE = 5
    #: Too few neighbours agree on a place.
    NO_SUPPORT = 6
    #: Another place has about the same support.
    AMBIGUOUS = 7
    #: It has a place, but no other segment has the same.
    NOT_LINKED = 8
    #: It was part of a line, and its distance to it failed the test.
    OUTLIER = 9
    #: Its line is seen in fewer than ``min_images`` images.
    FEW_IMAGES = 10
    #: Its line is too uncertain for its distance, or would be without one of its images.
    UNCERTAIN = 11
    #: No segment of its line is as long as ``min_longest``.
    SHORT_LINE = 12


#: Segments whose deviation is that many times the usual one make no line by themselves.
MAX_BLUR = 2.8
#: Not a fate: what a segment has before its stage.
UNKNOWN = -1

_WORDS = {
    Fate.MAPPED: "mapped",
    Fate.RECOVERED: "recovered by projecting a line",
    Fate.TOO_SHORT: "too short or outside the camera's valid region",
    Fate.NO_NEIGHBOR: "in images that share too few points with others",
    Fate.NO_MATCH: "without a candidate in any neighbour",
    Fate.DEGENERATE: "along the epipolar lines of all neighbours",
    Fate.NO_SUPPORT: "without agreement among neighbours",
    Fate.AMBIGUOUS: "with two places equally well supported",
    Fate.NOT_LINKED: "with a place of their own only",
    Fate.OUTLIER: "dropped from a line as outliers",
    Fate.FEW_IMAGES: "on lines seen in too few images",
    Fate.UNCERTAIN: "on lines too uncertain for their distance",
    Fate.SHORT_LINE: "on lines that only short segments show",
}

_REMEDIES = {
    Fate.TOO_SHORT: "Lower min_length, or use larger images.",
    Fate.NO_NEIGHBOR: "Check that the images overlap, and that the model has 3D points with observations.",
    Fate.NO_MATCH: "Check that segments and poses belong to the same images and the same image size, and widen "
    "depth_margin.",
    Fate.DEGENERATE: "The camera moved along the lines; add images taken from another height or side.",
    Fate.NO_SUPPORT: "Check poses and intrinsics (a few pixels of error leave no agreement), raise noise, or lower "
    "min_images.",
    Fate.AMBIGUOUS: "Repeated structure: pass matches, or more images.",
    Fate.NOT_LINKED: "Add images, or raise num_neighbors.",
    Fate.OUTLIER: "Poses disagree with the segments: adjust the points first, or raise noise.",
    Fate.FEW_IMAGES: "Lower min_images, or add images.",
    Fate.UNCERTAIN: "Add images from further apart, or raise max_uncertainty.",
    Fate.SHORT_LINE: "Lower min_longest, or use larger images.",
}


@dataclass(frozen=True)
class MapLinesOptions:
    """How to map lines."""

    #: Shortest segment used, pixels; detectors have a limit of their own.
    min_length: float = 12.0
    #: The longest segment of a line is at least so long, pixels; shorter ones join lines, and make none.
    min_longest: float = 0.0
    #: Neighbours per image.
    num_neighbors: int = 10
    #: Fewest shared points of neighbours.
    min_shared: int = 8
    #: Fewest images of a line.
    min_images: int = 3
    #: Error of poses and cameras in the image, added in quadrature to the segments' sigma; pixels.
    noise: float = 0.15
    #: The sigmas are scaled to what the first lines show, within these bounds; (1, 1) keeps them.
    noise_scale: tuple[float, float] = (0.33, 4.0)
    #: The depth range of the points around a segment is widened by this factor at both sides.
    depth_margin: float = 2.0
    #: Segments are directed, for example dark on the left: the same line then runs the same way in all images.
    directed: bool = True
    #: Share of the shorter of two segments that must overlap along the line.
    min_overlap: float = 0.3
    #: Largest relative standard deviation of the depth of a two-view proposal.
    max_relative_sigma: float = 0.03
    #: Largest standard deviation of a line's end points over their distance from the cameras.
    max_uncertainty: float = 0.012
    #: The same when any one image of the line is left out: beyond it, a wrong match in that image would go unnoticed.
    max_unchecked: float = 0.04
    #: A place is ambiguous if another one has more than this share of its support.
    max_rival: float = 0.95
    #: Use lines through known points as further proposals.
    use_points: bool = True
    #: Use vanishing directions, alone and with known points.
    use_directions: bool = True

    @staticmethod
    def selective(min_length: float = 12.0) -> MapLinesOptions:
        """Fewer lines, of which more are right: known to 2.5 thousandths of their distance, and 25 pixels long."""
        return MapLinesOptions(min_length=min_length, max_uncertainty=0.0025, min_longest=25.0)


@dataclass(frozen=True, eq=False)
class LineMap:
    """Lines, the segments that observe them, and what became of all others."""

    #: (L, 6) Plücker lines (m, d), unit direction, world frame.
    lines: FloatArray
    #: (L, 2, 3) end points; directed like the segments.
    segments: FloatArray
    #: (N,) image of each observation; observations are sorted by line.
    image_idx: IntArray
    #: (N,) number of the segment within its image.
    segment_idx: IntArray
    #: (N,) line of each observation.
    line_idx: IntArray
    #: (N,) root mean square distance of the segment's end points to the projected line, pixels.
    residual: FloatArray
    #: (L,) number of images that see the line.
    num_images: IntArray
    #: (L,) median over its observations of ``residual``, pixels.
    median_residual: FloatArray
    #: (L,) largest standard deviation of the end points across the line, scene units.
    uncertainty: FloatArray
    #: One array per image: the :class:`Fate` of each segment.
    fates: tuple[IntArray, ...]
    #: One array per image: its neighbours, best first.
    neighbors: tuple[IntArray, ...]
    #: Number of observations whose own proposals include one from known ``points``, or from a point and one of the
    #: vanishing ``directions``.
    assisted: dict[str, int] = field(default_factory=dict)
    #: Seconds per stage.
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def num_lines(self) -> int:
        """Number of lines."""
        return len(self.lines)

    def fate_counts(self) -> dict[Fate, int]:
        """Number of segments with each fate."""
        counts = np.bincount(np.concatenate([*self.fates, np.empty(0, np.int64)]), minlength=len(Fate))
        return {fate: int(counts[fate]) for fate in Fate}

    def add_to(self, scene: Scene, segments: Sequence[Segments]) -> Scene:
        """Return the scene with these lines and their observations in place of its own lines."""
        measured, sigma = np.zeros((len(self.image_idx), 4)), np.ones(len(self.image_idx))
        for i in np.unique(self.image_idx):
            at = self.image_idx == i
            measured[at], sigma[at] = segments[i].ends[self.segment_idx[at]], segments[i].sigma[self.segment_idx[at]]
        usual = float(np.median(sigma)) if len(sigma) else 1.0
        return scene.replace(
            lines=Lines.through(self.segments),
            line_observations=LineObservations(self.image_idx, self.line_idx, measured, sigma / usual),
            relations=Relations(point_on_plane=scene.relations.point_on_plane),
        )


def map_lines(
    scene: Scene,
    segments: Sequence[Segments],
    matches: Mapping[tuple[int, int], LineMatches] | MatchProvider | None = None,
    options: MapLinesOptions | None = None,
    progress: Callable[[str, int, int], None] | None = None,
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

    neighbors = covisible_neighbors(scene, options.num_neighbors, options.min_shared)
    lap("neighbors")
    views = build_views(scene, segments, options.min_length, options.noise, options.depth_margin)
    lap("views")
    fate = np.full(len(views.image_idx), UNKNOWN, np.int64)
    ratios = depth_ratios(scene, segments, views) if options.use_directions else np.zeros((len(fate), 2))
    lap("directions")
    places = _choose_places(scene, views, ratios, neighbors, matches, options, fate, report)
    fate[~views.usable] = Fate.TOO_SHORT
    lap("proposals")
    tracks = _build_tracks(views, neighbors, places, options, fate, report)
    lap("tracks")
    return _result(tracks, neighbors, places, fate, seconds)


def _choose_places(
    scene: Scene,
    views: LineViews,
    ratios: FloatArray,
    neighbors: list[IntArray],
    matches: Mapping[tuple[int, int], LineMatches] | MatchProvider | None,
    options: MapLinesOptions,
    fate: IntArray,
    report: Callable[[str, int, int], None],
) -> Choice:
    """The place of every segment of every image; writes the fates of those without one."""
    count = len(views.image_idx)
    places = Choice(
        np.zeros(count, bool),
        np.zeros((count, 2)),
        np.zeros((count, 3)),
        np.zeros(count),
        np.zeros(count),
        np.full((count, max(1, options.num_neighbors)), -1, np.int64),
        np.zeros((count, 2), bool),
    )
    proposer = Proposer(views, ratios, options.directed, options.min_overlap, options.max_relative_sigma)
    near_points = _points_by_image(scene, views) if options.use_points else [None] * scene.num_images
    for i, others in enumerate(neighbors):
        report("proposals", i, len(neighbors))
        rows = views.rows(i)
        if len(others) == 0:
            fate[rows] = Fate.NO_NEIGHBOR
            continue
        given = [_given(matches, i, int(j)) for j in others]
        for j, pairs in zip(others, given, strict=True):
            _check_pairs(pairs, i, int(j), views)
        proposals = proposer.propose(i, others, given, near_points[i])
        # A line of min_images images is this segment and min_images - 1 neighbours; two of them must agree.
        chosen = choose(proposals, rows.stop - rows.start, len(others), max(1, min(2, options.min_images - 1)))
        ambiguous = chosen.found & (chosen.rival > options.max_rival * chosen.score)
        found = chosen.found & ~ambiguous
        places.found[rows], places.q[rows], places.covariance[rows] = found, chosen.q, chosen.covariance
        places.score[rows], places.rival[rows] = np.where(found, chosen.score, 0.0), chosen.rival
        places.assisted[rows] = found[:, None] & chosen.assisted
        places.supporters[rows, : len(others)] = np.where(found[:, None], chosen.supporters, -1)
        fate[rows] = np.select(
            [found, ambiguous, proposals.reached > WEAK, proposals.reached == WEAK, proposals.reached < WEAK],
            [Fate.NOT_LINKED, Fate.AMBIGUOUS, Fate.NO_SUPPORT, Fate.DEGENERATE, Fate.NO_MATCH],
            UNKNOWN,
        )
    return places


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
    order = np.argsort(observations.image_idx, kind="stable")
    bounds = np.searchsorted(observations.image_idx[order], np.arange(scene.num_images + 1))
    near = []
    for i in range(scene.num_images):
        xyz = scene.points.xyz[observations.point_idx[order[bounds[i] : bounds[i + 1]]]]
        x = xyz @ views.camera[i, :, :3].T + views.camera[i, :, 3]
        x = x[x[:, 2] > 0.0]
        near.append((x[:, :2] / x[:, 2:], 1.0 / x[:, 2]))
    return near


def _build_tracks(
    views: LineViews,
    neighbors: list[IntArray],
    places: Choice,
    options: MapLinesOptions,
    fate: IntArray,
    report: Callable[[str, int, int], None],
) -> Tracks:
    """Lines from places; updates the fates."""
    tracks = Tracks(views)
    # Segments that were fitted badly run over two edges or along a curve, and do so alike in several images.
    sharp = views.sigma <= MAX_BLUR * np.median(views.sigma[views.usable]) if views.usable.any() else views.usable
    center = views.center[views.image_idx]
    safe = np.where(places.found[:, None], places.q, 1.0)
    points = center[:, None] + views.ray / safe[:, :, None]
    own, left = np.zeros(len(fate), bool), np.zeros(len(fate), bool)
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
    fate[left & (tracks.line_of < 0)] = Fate.FEW_IMAGES
    fate[tracks.dropped & (tracks.line_of < 0)] = Fate.OUTLIER
    fate[tracks.keep(tracks.num_images() >= options.min_images)] = Fate.FEW_IMAGES
    rows = np.flatnonzero(tracks.line_of >= 0)
    # What was sure stays so when it is joined to another line, whose noise then counts too.
    sure = np.bincount(tracks.line_of[rows], settled[rows], len(tracks.X)) > 0
    sure |= _is_sure(tracks, options)
    sure &= _num_sharp(tracks, sharp) >= min(3, options.min_images)
    fate[tracks.keep(sure)] = Fate.UNCERTAIN
    longest = np.zeros(len(tracks.X))
    rows = np.flatnonzero(tracks.line_of >= 0)
    np.maximum.at(longest, tracks.line_of[rows], views.length[rows])
    fate[tracks.keep(longest >= options.min_longest)] = Fate.SHORT_LINE
    member = tracks.line_of >= 0
    fate[member] = np.where(own[member], Fate.MAPPED, Fate.RECOVERED)
    return tracks


def _is_sure(tracks: Tracks, options: MapLinesOptions) -> BoolArray:
    """(L,) whether lines are known well enough for their distance, also without any one image."""
    distance = _distance(tracks)
    sure = tracks.uncertainty <= options.max_uncertainty * distance
    if options.min_images > 2:
        sure &= tracks.unchecked <= options.max_unchecked * distance
    return sure


def _num_sharp(tracks: Tracks, sharp: BoolArray) -> IntArray:
    """(L,) number of images that show a line as a sharp segment."""
    rows = np.flatnonzero((tracks.line_of >= 0) & sharp)
    pairs = np.unique(np.column_stack([tracks.line_of[rows], tracks.views.image_idx[rows]]), axis=0)
    return np.bincount(pairs[:, 0], minlength=len(tracks.X))


def _distance(tracks: Tracks) -> FloatArray:
    """(L,) mean distance of the lines' middles from the cameras that see them."""
    views, rows = tracks.views, np.flatnonzero(tracks.line_of >= 0)
    line = tracks.line_of[rows]
    away = np.linalg.norm(tracks.X[line].mean(1) - views.center[views.image_idx[rows]], axis=1)
    number = np.bincount(line, minlength=len(tracks.X))
    return np.bincount(line, away, minlength=len(tracks.X)) / np.maximum(number, 1)


def _result(
    tracks: Tracks, neighbors: list[IntArray], places: Choice, fate: IntArray, seconds: dict[str, float]
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
    median = np.array([np.median(residual[bounds[n] : bounds[n + 1]]) for n in range(len(X))])
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
        fates=tuple(fate[views.rows(i)] for i in range(len(views.camera))),
        neighbors=tuple(neighbors),
        assisted={name: int(places.assisted[rows, k].sum()) for k, name in enumerate(("points", "directions"))},
        seconds=seconds,
    )


def explain(line_map: LineMap) -> str:
    """Say in words how many segments were mapped, where the others were lost, and what to do.

    Names the stage that lost most; for an empty map that is the reason.
    """
    counts = line_map.fate_counts()
    total = sum(counts.values())
    if not line_map.fates:
        return "There are no images. Pass a scene with images and poses."
    if total == 0:
        return "No segments were detected in any image. Check that the images are not blank, or lower min_length."
    mapped = counts[Fate.MAPPED] + counts[Fate.RECOVERED]
    head = f"{line_map.num_lines} lines from {mapped} of {total} segments in {len(line_map.fates)} images."
    lost = sorted(((n, fate) for fate, n in counts.items() if fate > Fate.RECOVERED and n), reverse=True)
    if not lost:
        return head
    parts = "; ".join(f"{n} ({n / total:.0%}) {_WORDS[fate]}" for n, fate in lost)
    worst = lost[0][1]
    start = "The map is empty" if line_map.num_lines == 0 else "Most segments were lost"
    return f"{head} Not mapped: {parts}. {start} because segments were {_WORDS[worst]}. {_REMEDIES[worst]}"


__all__ = [
    "Fate",
    "LineMap",
    "MapLinesOptions",
    "MatchProvider",
    "explain",
    "external_matches",
    "flow_matches",
    "map_lines",
    "wide_baseline_matches",
]
