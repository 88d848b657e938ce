# SPDX-License-Identifier: BSD-3-Clause
"""The place of every segment in space: what every neighbour proposes, and what most of them agree on.

One image at a time: proposals (:mod:`groma.mapping.lines.proposals`) from the segments of its neighbours, from known
points and vanishing directions, then the choice among them (:mod:`groma.mapping.lines.consensus`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.errors import InputError
from groma.mapping.lines.consensus import Choice, choose
from groma.mapping.lines.matches import MatchProvider
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.lines.outcomes import UNKNOWN, Outcome
from groma.mapping.lines.proposals import WEAK, Proposer
from groma.mapping.lines.views import LineViews
from groma.scene import Scene

if TYPE_CHECKING:
    from groma.features.matching.wide_baseline import LineMatches


def choose_places(
    scene: Scene,
    views: LineViews,
    ratios: FloatArray,
    neighbors: list[IntArray],
    matches: Mapping[tuple[int, int], LineMatches] | MatchProvider | None,
    options: MapLinesOptions,
    outcome: IntArray,
    report: Callable[[str, int, int], None],
) -> Choice:
    """The place of every segment of every image; writes the outcomes of those without one."""
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
            outcome[rows] = Outcome.NO_NEIGHBOR
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
        outcome[rows] = np.select(
            [found, ambiguous, proposals.reached > WEAK, proposals.reached == WEAK, proposals.reached < WEAK],
            [
                Outcome.NOT_LINKED,
                Outcome.AMBIGUOUS,
                Outcome.NO_SUPPORT,
                Outcome.DEGENERATE,
                Outcome.NO_MATCH,
            ],
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
