# SPDX-License-Identifier: BSD-3-Clause
r"""Several planes in uncertain points and segments, found one by one.

The search draws planes from neighbours in space (and from pairs of segments that are nearly coplanar), improves each on
its neighbourhood, scores it by what lies on it there, and takes planes out one after the other, the best first. A plane
is a part of its inliers that is connected in space: links between inliers are no longer than the distances at which
points have their neighbours there anyway. It is kept if

* it has enough support, and its normal is known to ``max_tilt``;
* so much support would not come about by chance among all planes that were tried;
* it stands out: of what is in the layer around it, a good share lies on it, and more than would by chance if it were
  filled as the fuller side of the layer is. Relief without a flat part has no plane, nor has a thin post one that cuts
  through its sides, nor a round body one that touches it.

Narrow faces, such as treads, have few neighbours on themselves, so that few of the planes drawn are theirs. They are
parallel to faces beside them, or at right angles to two: such planes through what is left are drawn next, and then
beside those that this finds, as long as any are found. And the edges of a face are on two: what was taken out with
another plane counts in the test against chance, if it is a segment, both ends of which are on this one, too.

What is left is searched again as rough walls, by features with four times the noise. As neighbours deviate alike on
these, their number does not make the normal better known: the noise is at most ``max_tilt`` of the spread of the plane
across its longest axis. Among so many thicker layers some stand out against their sides by chance, so that this test
counts all that were tried, and most of what lies on such a plane must be on none of those found before.

A segment takes part with its two end points; points on it count no more once it is there.

Everything is local: the number of candidates grows with the features, and each is scored, grown and judged where it was
drawn. A scene has about the same planes whether it stands alone or is part of a larger one, and the time grows hardly
faster than the features. What is searched once more, beside planes that are known by then, is only where neighbours
have become free: elsewhere candidates were tried before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from heapq import heappop, heappush

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError, ShapeError, given_or_default
from groma.estimators._plane_candidates import (
    Features,
    Scores,
    features_of,
    from_neighbours,
    from_planes,
    from_segments,
)
from groma.estimators._plane_growth import Grower, Grown, Growth, connected_to
from groma.estimators._plane_options import PLANE_SEARCH, PlaneOptions
from groma.estimators.plane_fit import PlaneFit
from groma.execution import begin
from groma.gates import chi_square_gate
from groma.geometry.algebra import vectors

#: Half thickness of the layer around a plane in which it must stand out, in standard deviations of its points.
BAND = PLANE_SEARCH.band
#: Candidates whose scores are brought up to date together (cost: time only).
_SCORED_TOGETHER = 16
#: Features that planes which are known already take out.
_NONE = np.zeros(0, np.int64)


@dataclass(frozen=True)
class PlaneSet:
    """Planes found, in the order they were taken out."""

    #: (K, 4) unit normals and offsets.
    planes: FloatArray
    #: (K, 4, 4) covariances of (n, w), rank 3.
    covariance: FloatArray
    #: (K,) number of points and segment ends that made the plane.
    support: IntArray
    #: (K,) part of what is in the layer around the plane that lies on it.
    share: FloatArray
    #: (K,) half thickness of that layer, scene units.
    band: FloatArray
    #: (K,) base-10 logarithm of the expected number of false alarms.
    log10_false_alarms: FloatArray
    #: (N,) the plane that each point was taken out with, -1 for none.
    point_label: IntArray
    #: (L,) the plane that each segment was taken out with, both ends; -1 for none.
    segment_label: IntArray
    #: For each plane the (M, 3) support points and segment ends, at which it is connected.
    places: list[FloatArray] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.planes)

    def take(self, rows: IntArray, new: IntArray) -> PlaneSet:
        """Return some of the planes; ``new`` (K,) is the number of each of these here among them, -1 for none."""
        label = np.append(new, -1)
        return PlaneSet(
            planes=self.planes[rows],
            covariance=self.covariance[rows],
            support=self.support[rows],
            share=self.share[rows],
            band=self.band[rows],
            log10_false_alarms=self.log10_false_alarms[rows],
            point_label=label[self.point_label],
            segment_label=label[self.segment_label],
            places=[self.places[row] for row in rows],
        )


class PlaneSearch:
    """Searches for planes in points and segments; see the module.

    Parameters
    ----------
    points : (N, 3) float64
        Points, scene units.
    covariances : (N, 3, 3) float64
        Their covariances, positive definite.
    segments : (L, 2, 3) float64, optional
        End points of line segments.
    segment_covariances : (L, 2, 3, 3) float64, optional
        Covariances of the end points; the part along the segment hardly matters.
    options : PlaneOptions, optional
        What counts as a plane.
    carriers : (N,) int, optional
        The segment that each point lies on, -1 for none. With a segment on a plane its points are there too, and say
        nothing more about whether there is a plane.

    Raises
    ------
    ShapeError, InputError
        If shapes do not fit or numbers are not finite.
    """

    def __init__(
        self,
        points: FloatArray,
        covariances: FloatArray,
        segments: FloatArray | None = None,
        segment_covariances: FloatArray | None = None,
        options: PlaneOptions | None = None,
        carriers: IntArray | None = None,
    ) -> None:
        self._options = given_or_default(options, PlaneOptions)
        points = vectors(points, 3, "points")
        ends = np.zeros((0, 2, 3)) if segments is None else vectors(segments, 3, "segments")
        end_noise = np.zeros((0, 2, 3, 3)) if segment_covariances is None else np.asarray(segment_covariances, float)
        covariances = np.asarray(covariances, dtype=np.float64)
        if covariances.shape != (len(points), 3, 3) or end_noise.shape != (len(ends), 2, 3, 3):
            raise ShapeError(
                f"covariances must have shapes ({len(points)}, 3, 3) and ({len(ends)}, 2, 3, 3), as points and "
                f"segments; got {covariances.shape} and {end_noise.shape}."
            )
        places = np.concatenate([points, ends.reshape(-1, 3)])
        noise = np.concatenate([covariances, end_noise.reshape(-1, 3, 3)])
        if not (np.isfinite(places).all() and np.isfinite(noise).all()):
            raise InputError("Points, segments and their covariances must be finite. Remove the rows that are not.")
        carrier = np.full(len(points), -1) if carriers is None else np.asarray(carriers)
        if carrier.shape != (len(points),) or (len(carrier) and carrier.max() >= len(ends)):
            raise ShapeError(
                f"carriers must have shape ({len(points)},) and refer to the {len(ends)} segments; got {carrier.shape}."
            )
        carrier = np.concatenate([np.where(carrier >= 0, len(points) + 2 * carrier, -1), np.full(2 * len(ends), -1)])
        partner = np.arange(len(places))
        partner[len(points) :] = len(points) + (np.arange(2 * len(ends)) ^ 1)
        self._num_points = len(points)
        self._features: tuple[Features, Callable[[], Features]] | None = None
        if len(places) >= max(self._options.min_support, 4):  # derived from three that fix a plane
            features = features_of(places, noise, partner, carrier)
            self._features = features, begin(partial(features.thicker, PLANE_SEARCH.thicker))
        #: (N,) features that stayed free when planes were sought last; none before.
        self._searched = np.zeros(len(places), bool)

    def planes(self, known: PlaneSet | None = None, progress: Callable[[int, int], None] | None = None) -> PlaneSet:
        """Find planes.

        Parameters
        ----------
        known : PlaneSet, optional
            Planes beside which others are sought, in what has no label of theirs. They are the first that are returned.
            After a first call candidates are drawn only where neighbours have become free since then.
        progress : callable, optional
            Called with the number of candidates that are settled, and of all.

        Returns
        -------
        PlaneSet
            Each with what was taken out for it. A feature near two planes is given to one of them here.
        """
        labels, found = np.full(len(self._searched), -1), list[Grown]()
        if known is not None:
            labels = np.concatenate([known.point_label, np.repeat(known.segment_label, 2)])
            fits = [PlaneFit(*one, 1.0) for one in zip(known.planes, known.covariance, strict=True)]
            rest = known.share, known.band, known.log10_false_alarms, known.places, [_NONE] * len(fits)
            found = [Grown(*one) for one in zip(fits, *rest, strict=True)]
        if self._features is not None:
            self._extract(*self._features, labels, found, progress or (lambda done, total: None))
        self._searched = labels < 0
        fits = [grown.fit for grown in found]
        end_label = labels[self._num_points :].reshape(-1, 2)
        return PlaneSet(
            planes=np.array([fit.plane for fit in fits]).reshape(-1, 4),
            covariance=np.array([fit.covariance for fit in fits]).reshape(-1, 4, 4),
            support=np.array([len(grown.places) for grown in found], dtype=np.int64),
            share=np.array([grown.share for grown in found], dtype=np.float64),
            band=np.array([grown.band for grown in found], dtype=np.float64),
            log10_false_alarms=np.array([grown.log10_false_alarms for grown in found], dtype=np.float64),
            point_label=labels[: self._num_points],
            segment_label=np.where(end_label[:, 0] == end_label[:, 1], end_label[:, 0], -1),
            places=[grown.places for grown in found],
        )

    def _extract(
        self,
        features: Features,
        rough: Callable[[], Features],
        filled: IntArray,
        found: list[Grown],
        progress: Callable[[int, int], None],
    ) -> None:
        """Find planes, then rough ones, beside those ``found``, which is added to; ``filled`` gets their numbers."""
        options, labels = self._options, filled[features.given]
        gate, settled = chi_square_gate(1.0 - options.level, 1), 0

        def say(done: int, total: int) -> None:
            progress(settled + done, settled + total)

        # What is drawn at a feature depends on its neighbours: where none has become free it was tried before.
        fresh = _beside(features, (labels < 0) & ~self._searched[features.given])
        num_known = len(found)
        for searched in (lambda: features, rough):
            if np.count_nonzero(labels < 0) < options.min_support:
                break  # too few are left
            one = searched()
            rng, number = np.random.default_rng(options.seed), -1
            free, corner = one.position[labels[one.position] < 0], one.position[self._num_points :].reshape(-1, 2)
            first, first_homes = from_neighbours(one, free, fresh, gate, rng)
            second, second_homes, num_pairs = from_segments(one, corner[(labels[corner] < 0).all(axis=1)], gate, fresh)
            candidates, homes = np.concatenate([first, second]), np.concatenate([first_homes, second_homes])
            num_tried, drawn_at, num_drawn = len(first) + num_pairs, fresh, num_known
            while number < len(found):
                number = len(found)
                _extract_of(one, candidates, homes, num_tried, labels, found, options, say)
                settled += len(candidates)
                planes = np.array([grown.fit.plane for grown in found]).reshape(-1, 4)
                drawn_at = drawn_at | _beside(one, labels >= num_drawn)
                candidates, homes = from_planes(one, planes, labels, drawn_at, rng)
                drawn_at, num_drawn = np.zeros_like(fresh), len(found)
                num_tried += len(candidates)
        filled[features.given] = labels


def find_planes(
    points: FloatArray,
    covariances: FloatArray,
    segments: FloatArray | None = None,
    segment_covariances: FloatArray | None = None,
    options: PlaneOptions | None = None,
    carriers: IntArray | None = None,
    progress: Callable[[int, int], None] | None = None,
    known: PlaneSet | None = None,
) -> PlaneSet:
    """Find planes in points and segments: what a :class:`PlaneSearch` of them finds when it is asked once.

    See there for the parameters, and :meth:`PlaneSearch.planes` for ``progress``, ``known`` and what is returned.

    Raises
    ------
    ShapeError, InputError
        If shapes do not fit or numbers are not finite.
    """
    search = PlaneSearch(points, covariances, segments, segment_covariances, options, carriers)
    return search.planes(known, progress)


def _beside(features: Features, some: BoolArray) -> BoolArray:
    """(N,) features that have one of some (N,) among their neighbours."""
    return np.asarray(some[features.neighbours].any(axis=1))


def _extract_of(
    features: Features,
    candidates: FloatArray,
    homes: IntArray,
    num_tried: int,
    labels: IntArray,
    found: list[Grown],
    options: PlaneOptions,
    progress: Callable[[int, int], None],
) -> None:
    """Find planes one by one, beside those ``found``; ``labels`` and ``found`` are added to."""
    gate = chi_square_gate(1.0 - options.level, 1)
    log_tried = float(np.log10(2.0 * PLANE_SEARCH.refined * num_tried + 1.0))  # two thicknesses
    # With less information than the test of false alarms needs, a candidate will be rejected.
    least_score = float(np.log(10.0) * (log_tried - np.log10(options.max_false_alarms)))
    scores = Scores(features, candidates, homes, gate, PLANE_SEARCH.link)
    queue = _Queue(scores, labels, 0.5 * options.min_support, least_score)
    grower = Grower(features, gate, log_tried, options)
    failures, patience = 0, max(PLANE_SEARCH.patience, len(candidates) // PLANE_SEARCH.candidates_per_failure)
    ahead: dict[int, Callable[[], Growth]] = {}
    while failures < patience and (best := queue.best()) is not None:
        progress(len(candidates) - len(queue), len(candidates))
        queue.alive[best] = False
        grow = ahead.pop(best, partial(grower.grow, candidates[best], int(homes[best]), labels))
        ahead.clear()
        if (other := queue.best(stays=True)) is not None:  # it will probably be needed: nine in ten are no plane
            ahead[other] = begin(partial(grower.grow, candidates[other], int(homes[other]), labels))
        grown, plane, rows = grow()
        failures += 1
        if grown is not None:
            failures = 0
            labels[grown.taken] = len(found)
            found.append(grown)
            queue.labels_changed()
            ahead.clear()
        scores.keep_others(plane, rows, queue.alive)


class _Queue:
    """Candidates, the best first, that have enough support and information among features without a label."""

    def __init__(self, scores: Scores, labels: IntArray, least_support: float, least_score: float) -> None:
        self._scores, self._labels, self._least = scores, labels, (least_support, least_score)
        #: (H,) which are worth a try, and whether their scores are of these labels.
        self.alive, self._fresh = np.ones(scores.count, bool), np.zeros(scores.count, bool)
        self._queue: list[tuple[float, int]] = []
        self._put(np.arange(scores.count))

    def __len__(self) -> int:
        return len(self._queue)

    def labels_changed(self) -> None:
        """Note that no score is of these labels any more."""
        self._fresh[:] = False

    def best(self, stays: bool = False) -> int | None:
        """Return the best candidate, None if there is none, and take it off unless it ``stays``."""
        queue = self._queue
        while queue:
            # Scores only fall while planes are taken out: the best is the best if its own is of after the last one.
            stale: list[int] = []
            while queue and len(stale) < _SCORED_TOGETHER and not (self.alive[k := queue[0][1]] and self._fresh[k]):
                heappop(queue)
                if self.alive[k]:
                    stale.append(k)
            if not stale:
                return (queue[0] if stays else heappop(queue))[1] if queue else None
            self._put(np.array(stale, np.int64))
        return None

    def _put(self, which: IntArray) -> None:
        """Score some candidates, and put those on the queue that are still worth a try."""
        support, score = self._scores.of(which, self._labels)
        self._fresh[which] = True
        self.alive[which] = (support >= self._least[0]) & (score >= self._least[1])
        for k in np.flatnonzero(self.alive[which]).tolist():
            heappush(self._queue, (-float(score[k]), int(which[k])))


__all__ = ["BAND", "PlaneOptions", "PlaneSearch", "PlaneSet", "connected_to", "find_planes"]
