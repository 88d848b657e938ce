# SPDX-License-Identifier: BSD-3-Clause
r"""From the positions of single segments to lines that many images see, step by step.

link
    Segments whose positions support each other become lines (:mod:`groma.mapping.lines.linking.link`).
scale the noise
    The standard deviations of all segments are scaled to what the residuals of the first lines show.
recover
    Lines are projected into the images of their neighbourhood. A free segment on a line joins it, also one whose own
    proposals were degenerate; a segment of another line is a vote that both are one.

After each step lines are fitted again (:mod:`groma.mapping.lines.linking.fit`), observations that fail a chi-square
test are let go, and the ends of a line are cut to the part of it that at least two images see
(:mod:`groma.estimators.line_ends`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import scipy  # its parts are imported when something of them is first used

from groma._typing import BoolArray, FloatArray, IntArray
from groma.execution import map_work
from groma.features.segments import SEGMENTS
from groma.mapping.groups import distinct_pairs
from groma.mapping.lines.gates import AGREEMENT
from groma.mapping.lines.hypotheses.positions import SegmentPositions
from groma.mapping.lines.linking.fit import find_on_lines, near_together
from groma.mapping.lines.linking.link import link
from groma.mapping.lines.linking.tracks import Tracks
from groma.mapping.lines.options import MapLinesOptions


# ---------------------------------------------------------------------------------------------------------------- steps
def grow(
    tracks: Tracks,
    positions: SegmentPositions,
    neighbors: list[IntArray],
    options: MapLinesOptions,
    progress: Callable[[int, int], None],
) -> Tracks:
    """Return the lines that positions make and the segments on them, in the order in which this file describes."""

    def link_free(now: Tracks) -> Tracks:
        return linked(now, positions)

    def recover(now: Tracks) -> Tracks:
        return recovered(now, neighbors, options.directed)

    steps = (
        link_free,
        lambda now: with_own_noise(now, options.noise_scale),
        recover,
        recover,
        link_free,  # what the first lines left over, for example the smaller part of a group of two lines
        recover,
        recover,
        lambda now: recovered(now, neighbors, False),  # the darker side of an edge changes with what is behind it
    )
    for done, step in enumerate(steps):
        progress(done, len(steps))
        tracks = step(tracks).refined()
    return tracks


def linked(tracks: Tracks, positions: SegmentPositions) -> Tracks:
    """Return the tracks with lines of the free segments whose positions agree."""
    views = tracks.views
    free = views.usable & (tracks.line_of < 0)
    members, representative = link(views, tracks.sigma, positions, free, AGREEMENT.max_squared(2))
    return tracks.with_groups(members, representative, positions.ends_in_space(views))


def with_own_noise(tracks: Tracks, bounds: tuple[float, float]) -> Tracks:
    """Return the tracks with standard deviations scaled to what the residuals of the lines show, within bounds."""
    return tracks.with_sigma(float(np.clip(_noise_scale(tracks), *bounds)) * tracks.sigma)


def recovered(tracks: Tracks, neighbors: list[IntArray], directed: bool) -> Tracks:
    """Return the tracks with free segments that lie on a line added to it, and lines that are one joined."""
    if tracks.num_lines == 0:
        return tracks
    forward = tracks.direction() if directed else np.zeros(tracks.num_lines)
    hit, distance = _on_lines(tracks, neighbors, tracks.sigma, forward, AGREEMENT.max_squared(2))
    alias = _same_lines(tracks, hit)
    rows, line = tracks.members()
    line_of = tracks.line_of.copy()
    line_of[rows] = alias[line]
    is_free = tracks.line_of[hit[:, 1]] < 0
    hit, distance = hit[is_free], distance[is_free]
    order = np.argsort(distance, kind="stable")
    segment, best = np.unique(hit[order, 1], return_index=True)
    line_of[segment] = alias[hit[order, 0]][best]
    return tracks.observed_by(line_of)


# ------------------------------------------------------------------------------------------------------------ evidence
def near_lines(tracks: Tracks, neighbors: list[IntArray], reach: float | None = None) -> IntArray:
    """Lines and segments (M, 2) whose ends lie within ``reach`` pixels of the line, or within their noise."""
    undirected = np.zeros(tracks.num_lines)
    if reach is None:
        return _on_lines(tracks, neighbors, tracks.sigma, undirected, AGREEMENT.max_squared(2))[0]
    # Both ends at the reach: twice its square.
    return _on_lines(tracks, neighbors, np.full(len(tracks.line_of), reach), undirected, 2.0)[0]


def votes_for_same(tracks: Tracks, hit: IntArray, counted: BoolArray) -> tuple[IntArray, IntArray]:
    """Pairs (M, 2) of lines where the first explains segments of the second, and in how many images (M,)."""
    owner, count = tracks.line_of[hit[:, 1]], max(tracks.num_lines, 1)
    keys = (hit[:, 0] * tracks.num_lines + owner)[counted]
    seen, _ = distinct_pairs(keys, tracks.views.image_idx[hit[counted, 1]])
    key, votes = np.unique(seen[:, 0], return_counts=True)
    return np.column_stack([key // count, key % count]), votes


def _on_lines(
    tracks: Tracks, neighbors: list[IntArray], sigma: FloatArray, forward: FloatArray, max_squared: float
) -> tuple[IntArray, FloatArray]:
    """Lines and segments on them (M, 2), in the images of the lines and their neighbours; and squared distances."""
    views, gates = tracks.views, (max_squared, SEGMENTS.overlap, tracks.gates.min_overlap_px)
    work = []  # of each image with its own segments and the lines near it alone: it may be sent to another process
    for image, lines in enumerate(tracks.lines_near_images(neighbors)):
        rows = views.rows(image)
        segments = views.ends[rows], sigma[rows], views.usable[rows]
        work.append((views.camera[image], lines, tracks.lines[lines], forward[lines], rows.start, segments))
    found = map_work(partial(_on_lines_in, gates), work)
    return (
        np.concatenate([np.empty((0, 2), np.int64), *(hits for hits, _ in found)]),
        np.concatenate([np.empty(0), *(distances for _, distances in found)]),
    )


def _on_lines_in(
    gates: tuple[float, float, float],
    image: tuple[FloatArray, IntArray, FloatArray, FloatArray, int, tuple[FloatArray, FloatArray, BoolArray]],
) -> tuple[IntArray, FloatArray]:
    """The same of one image: its camera, the lines to look for with their ends and directions, and its segments."""
    camera, lines, ends, forward, first, (segments, sigma, usable) = image
    order = near_together(segments, usable)
    hits, distances = np.empty((4096, 2), np.int64), np.empty(4096)
    while True:
        needed = find_on_lines(camera, ends, order, segments, sigma, forward, *gates, hits, distances)
        if needed <= len(hits):
            return np.column_stack([lines[hits[:needed, 0]], first + hits[:needed, 1]]), distances[:needed]
        hits, distances = np.empty((needed, 2), np.int64), np.empty(needed)


def _same_lines(tracks: Tracks, hit: IntArray) -> IntArray:
    """(L,) the line that each line becomes: line B becomes A where A explains B's segments in most of B's images.

    Pairs with most votes come first. A line is joined once, and only to one that is not joined itself: chains are left
    to the next round.
    """
    owner, alias = tracks.line_of[hit[:, 1]], np.arange(tracks.num_lines)
    pairs, votes = votes_for_same(tracks, hit, (owner >= 0) & (owner != hit[:, 0]))
    enough = AGREEMENT.min_common * tracks.num_images()[pairs[:, 1]]
    good = (votes >= tracks.gates.min_common_images) & (votes >= enough)
    pairs, votes = pairs[good], votes[good]
    taken = set()
    for a, b in pairs[np.argsort(-votes, kind="stable")].tolist():
        if alias[a] == a and alias[b] == b and b not in taken:
            alias[b] = a
            taken.add(a)
    return alias


def _noise_scale(tracks: Tracks) -> float:
    """By how much the sigmas are too large or too small, from what is left of the lines' own residuals.

    An observation's two squared distances over sigma have 2 - 4/n degrees of freedom where its line has n
    observations. A quantile is compared, by the formula of Wilson and Hilferty; the upper quartile, as detections have
    heavier tails than a normal law, and the gates that follow should keep them.
    """
    rows, line = tracks.members()
    number = np.bincount(line, minlength=tracks.num_lines)[line]
    many = number >= tracks.gates.min_observations
    rows, number = rows[many], number[many]
    if len(rows) < tracks.gates.min_residuals:
        return 1.0
    freedom = 2.0 - 4.0 / number  # derived from the four numbers of a line
    spread = 2.0 / (9.0 * freedom)  # derived from the cube root: Wilson and Hilferty 1931
    expected = freedom * (1.0 - spread + scipy.special.ndtri(tracks.gates.noise_quantile) * np.sqrt(spread)) ** 3
    return float(np.sqrt(np.quantile(tracks.squared[rows] / expected, tracks.gates.noise_quantile)))
