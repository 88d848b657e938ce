# SPDX-License-Identifier: BSD-3-Clause
"""Filters of finished lines, as a list of named steps.

A filter gets the lines that passed the filters before it. It returns which of them it keeps, (L,), and the rejection
reason for the segments of the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy  # its parts are imported when something of them is first used

from groma._typing import BoolArray, FloatArray, IntArray
from groma.gates import NORMAL
from groma.mapping.lines.filtering.duplicates import not_duplicates
from groma.mapping.lines.filtering.kinds import found_again
from groma.mapping.lines.filtering.texture import edge_odds, num_expected
from groma.mapping.lines.linking.tracks import Tracks
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.lines.outcomes import Outcome


@dataclass(frozen=True, eq=False)
class Evidence:
    """What filters know beside the lines."""

    options: MapLinesOptions
    #: One array per image: its neighbours.
    neighbors: list[IntArray]
    #: (S,) gradient across each segment, grey levels per pixel.
    strength: FloatArray
    #: (C, 2) width and height of the images, pixels; 0 where they are not known.
    size: IntArray
    #: The lines before those that agree were merged, which adds noise to their segments.
    unmerged: Tracks


#: Which lines stay, and what becomes of the segments of the others.
Verdict = tuple[BoolArray, Outcome]
#: A filter of lines.
Filter = Callable[[Tracks, Evidence], Verdict]


def seen_by_enough_images(tracks: Tracks, evidence: Evidence) -> Verdict:
    """Seen by ``min_images``."""
    return tracks.num_images() >= evidence.options.min_images, Outcome.FEW_IMAGES


def well_determined(tracks: Tracks, evidence: Evidence) -> Verdict:
    """Known well enough, now or before what agrees was merged: a merged line counts the noise of both."""
    rows, line = tracks.members()
    before = np.append(is_certain(evidence.unmerged, evidence.options), False)[evidence.unmerged.line_of]
    was_certain = np.bincount(line, before[rows], tracks.num_lines) > 0
    return was_certain | is_certain(tracks, evidence.options), Outcome.UNCERTAIN


def not_texture(tracks: Tracks, evidence: Evidence) -> Verdict:
    """Of a kind of segments that is found again, and shown by the images that should show it."""
    views = tracks.views
    if evidence.options.min_repeatability <= 0.0 or tracks.num_lines == 0:
        return np.ones(tracks.num_lines, bool), Outcome.TEXTURE
    kinds = SegmentKinds(views.length, evidence.strength, views.sigma, tracks.rejection)
    expected = num_expected(tracks, evidence.neighbors, evidence.size, evidence.options.min_length)
    return is_edge(kinds, tracks.line_of, tracks.num_images(), expected, evidence.options), Outcome.TEXTURE


@dataclass(frozen=True, eq=False)
class SegmentKinds:
    """What tells segments (S,) of edges from those of texture."""

    #: (S,) pixels.
    length: FloatArray
    #: (S,) gradient across each, grey levels per pixel.
    strength: FloatArray
    #: (S,) standard deviation across each, pixels.
    sigma: FloatArray
    #: (S,) the :class:`Outcome` of those without a line.
    rejection: IntArray


def is_edge(
    kinds: SegmentKinds, line_of: IntArray, seen: IntArray, expected: IntArray, options: MapLinesOptions
) -> BoolArray:
    """(L,) lines of segments that are found again, and shown by those that should show them.

    ``line_of`` (S,) is the line of each segment, -1 for none; ``seen`` and ``expected`` (L,) are numbers of images.
    """
    # Segments that no neighbour or geometry lets become part of a line say nothing about others of their kind.
    possible = ~np.isin(kinds.rejection, (Outcome.TOO_SHORT, Outcome.NO_NEIGHBOR, Outcome.DEGENERATE))
    least = options.min_repeatability
    again = found_again(kinds.length, kinds.strength, line_of, possible, len(seen), least)
    told = kinds.length, kinds.strength, kinds.sigma
    odds = edge_odds(told, line_of, possible, seen, expected, options.min_images)
    return again & (odds >= scipy.special.logit(NORMAL.significance))


def not_duplicate(tracks: Tracks, evidence: Evidence) -> Verdict:
    """Not explained by another line beside it, also in images that have a neighbour in common."""
    neighbors, none = evidence.neighbors, np.empty(0, np.int64)
    around = [np.unique(np.concatenate([none, row, *(neighbors[j] for j in row)])) for row in neighbors]
    return not_duplicates(tracks, around, evidence.options.min_images), Outcome.REPEATED


def long_enough(tracks: Tracks, evidence: Evidence) -> Verdict:
    """With a segment of ``min_longest``."""
    rows, line = tracks.members()
    longest = np.zeros(tracks.num_lines)
    np.maximum.at(longest, line, tracks.views.length[rows])
    return longest >= evidence.options.min_longest, Outcome.SHORT_LINE


#: The filters, in their order.
FILTERS: tuple[Filter, ...] = (seen_by_enough_images, well_determined, not_texture, not_duplicate, long_enough)

#: Those that need no more than what is around a line; texture is learned from all segments of a scene.
NEARBY: tuple[Filter, ...] = tuple(one for one in FILTERS if one is not not_texture)


def filtered(tracks: Tracks, evidence: Evidence, filters: tuple[Filter, ...] = FILTERS) -> Tracks:
    """Return the lines that pass all filters."""
    for passes in filters:
        tracks = tracks.keep(*passes(tracks, evidence))
    return tracks


def is_certain(tracks: Tracks, options: MapLinesOptions) -> BoolArray:
    """(L,) whether lines are known well enough, also without any one image.

    A line farther away than the usual one must be known as well as that one: a map is as good far away as it is near.
    """
    distance = _distance(tracks)
    usual = float(np.median(distance)) if len(distance) else 0.0
    certain = tracks.uncertainty <= options.max_uncertainty * np.minimum(distance, usual)
    if options.min_images > 2:
        certain &= tracks.unchecked <= options.max_unchecked * distance
    return certain


def _distance(tracks: Tracks) -> FloatArray:
    """(L,) mean distance of the lines' middles from the cameras that see them."""
    views, (rows, line) = tracks.views, tracks.members()
    away = np.linalg.norm(tracks.lines.mean(1)[line] - views.center[views.image_idx[rows]], axis=1)
    number = np.bincount(line, minlength=tracks.num_lines)
    return np.bincount(line, away, minlength=tracks.num_lines) / np.maximum(number, 1)
