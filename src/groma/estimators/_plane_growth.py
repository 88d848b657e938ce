# SPDX-License-Identifier: BSD-3-Clause
"""From a candidate of :mod:`groma.estimators.plane_search` to a plane: refined where it is connected, and judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._trees import kd_tree
from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators._plane_candidates import Features
from groma.estimators._plane_loops import (
    ball_loop,
    connected_part_loop,
    fit_loop,
    heights_loop,
    layer_loop,
    near_free_loop,
    near_loop,
    nearest_rows_loop,
)
from groma.estimators._plane_options import PLANE_SEARCH as GATES
from groma.estimators._plane_options import PlaneOptions
from groma.estimators.association import inlier_probability, log10_poisson_tail
from groma.estimators.plane_fit import PlaneFit, fit_plane, tilt_sigma
from groma.geometry.algebra import norm, perpendicular


@dataclass(frozen=True)
class Grown:
    """A plane that is kept."""

    fit: PlaneFit
    share: float
    band: float
    log10_false_alarms: float
    #: The features on it, and those taken out with it.
    rows: IntArray
    taken: IntArray


class Grower:
    """Grows candidates, one after the other, on the same features; keeps the room it works in.

    Parameters
    ----------
    features : Features
        Points and segment ends.
    gate : float
        Squared distance over variance up to which a feature lies on a plane.
    log_tried : float
        Base-10 logarithm of the number of candidates that are tried in all.
    options : PlaneOptions
        What counts as a plane.
    """

    def __init__(self, features: Features, gate: float, log_tried: float, options: PlaneOptions) -> None:
        self._features = features
        self._gate, self._log_tried, self._options = gate, log_tried, options
        count = len(features.places)
        self._mark, self._held = np.full(count, -1), np.zeros(count, np.int64)
        self._room, self._layer = np.empty(count, np.int64), np.empty(count, np.int64)

    def grow(self, plane: FloatArray, home: int, labels: IntArray) -> tuple[Grown | None, FloatArray, IntArray]:
        """Refine a candidate where it is connected, and judge it: what is kept, where it went, its support.

        It grows from the neighbourhood of its ``home``, a feature: what lies on the same plane far away is another's.
        """
        features, gate, options = self._features, self._gate, self._options
        free = None
        rows, weight = features.neighbours[home], np.zeros(0)
        for step in range(GATES.grow_steps):
            if step == 1:  # what is far away stays away
                free = self._near_free(labels, plane, GATES.far * gate)
            # The first rounds reach farther: the candidate is not yet exact.
            limit = (GATES.wider if step < 2 else 1.0) * gate
            near = self._near_free(labels, plane, limit) if free is None else self._near(free, plane, limit)
            rows, independent = self._part(near, rows)
            if independent < options.min_support:
                return None, plane, rows
            height, spread = self._heights(rows, plane)
            # Weights that fall with the distance lead to where the layer is densest, not to the middle of what it
            # cuts off.
            weight = 1.0 / (1.0 + (height / spread) ** 2) ** 2
            before, plane = plane, self._fitted(rows, weight)
            turned = float(np.sign(before[:3] @ plane[:3]))
            moved, spread = self._heights(rows, plane)
            moved -= turned * height
            if step > 1 and np.abs(moved).max() < GATES.converged * _median(spread):
                break
        if (
            tilt_sigma(fit_plane(features.places[rows], features.covariances[rows], weight).covariance)
            > options.max_tilt
        ):
            return None, plane, rows
        band = GATES.band * _median(self._heights(rows, plane)[1])
        support, layer, share = features.places[rows], rows, np.zeros(1)
        for _ in range(GATES.polish_steps):
            # Judged against all that is near, taken or not: what lies on a plane beside this one speaks against it.
            layer = self._layer[
                : layer_loop(features.places, features.order, features.balls, plane, band, self._layer)
            ].copy()
            joined = np.isin(layer, rows, assume_unique=True, kind="table")
            others = layer[~joined]
            joined[~joined] = connected_to(support, features.places[others], features.spacing[others], plane)
            layer = layer[joined]
            height, spread = self._heights(layer, plane)
            height = np.abs(height)
            probability, share = inlier_probability(height, spread, np.zeros(len(layer), np.int64), np.array([band]))
            weight = np.where(height < GATES.inlier * spread, probability, 0.0)
            if share[0] < GATES.hopeless * options.min_share or np.count_nonzero(weight) < 3:
                return None, plane, rows
            # Membership as the weight: all of the plane where it is clean, its densest part where it is not.
            plane = self._fitted(layer, weight)
        if share[0] < options.min_share:
            return None, plane, rows
        alarm = self._log10_false_alarms(plane, rows)
        if alarm > np.log10(options.max_false_alarms):
            return None, plane, rows
        fit = fit_plane(features.places[layer], features.covariances[layer], weight)
        # The whole layer is taken out: relief so near to a plane cannot be told from it.
        taken = np.union1d(rows, layer[labels[layer] < 0])
        return Grown(fit, float(share[0]), band, alarm, rows, taken), plane, rows

    def _near_free(self, labels: IntArray, plane: FloatArray, limit: float) -> IntArray:
        """Features without a label whose squared distance is within so many variances."""
        features = self._features
        count = near_free_loop(
            features.places, features.packed, labels, features.order, features.balls, plane, limit, self._room
        )  # fmt: skip
        return self._room[:count].copy()

    def _near(self, rows: IntArray, plane: FloatArray, limit: float) -> IntArray:
        """Those of some features whose squared distance is within so many variances."""
        features = self._features
        return self._room[: near_loop(features.places, features.packed, rows, plane, limit, self._room)].copy()

    def _heights(self, rows: IntArray, plane: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Signed distances of features from a plane, and their standard deviations."""
        height, spread = np.empty(len(rows)), np.empty(len(rows))
        heights_loop(self._features.places, self._features.packed, rows, plane, height, spread)
        return height, spread

    def _fitted(self, rows: IntArray, weight: FloatArray) -> FloatArray:
        """Plane through some features."""
        plane, center, precision = np.empty(4), np.empty(3), np.empty(len(rows))
        fit_loop(
            self._features.places, self._features.packed, rows, weight, GATES.fit_rounds, plane, center, precision
        )  # fmt: skip
        return plane

    def _part(self, rows: IntArray, held: IntArray) -> tuple[IntArray, int]:
        """Part of some features that is connected in space, with most of those held; how many no segment carries."""
        features, count = self._features, min(GATES.rank + 1, len(rows))
        if count < 3:
            return rows, 0
        nearest, distance = np.empty((len(rows), count), np.int64), np.empty((len(rows), count))
        short = np.empty(len(rows), np.int64)
        missing = nearest_rows_loop(
            features.places, rows, features.neighbours, self._mark, nearest, distance, short
        )  # fmt: skip
        if missing:  # the others among their neighbours do not lie on the plane
            places, short = features.places[rows], short[:missing]
            tree = kd_tree(places, balanced_tree=False, compact_nodes=False)
            distance[short], nearest[short] = tree.query(places[short], k=count)
        out, count_of = np.empty(len(rows), np.int64), np.empty(2, np.int64)
        self._held[held] = 1
        connected_part_loop(
            rows, nearest, distance, GATES.link, features.spacing, features.partner, features.carrier, self._held,
            self._mark, out, count_of,
        )  # fmt: skip
        self._held[held] = 0
        return out[: count_of[0]], int(count_of[1])

    def _log10_false_alarms(self, plane: FloatArray, rows: IntArray) -> float:
        """Number of planes tried on which as much would lie by chance, of their neighbourhood, base-10 logarithm."""
        features = self._features
        center = features.places[rows].mean(axis=0)
        radius = float(np.quantile(norm(features.places[rows] - center), GATES.extent))
        found = np.zeros(2)
        ball_loop(
            features.places, features.packed, features.carrier, features.order, features.balls, rows, center, radius,
            plane, self._gate, self._mark, found,
        )  # fmt: skip
        if found[0] == 0:
            return self._log_tried
        return log10_poisson_tail(found[0] - 4, found[1]) + self._log_tried  # three fix it


def connected_to(places: FloatArray, tested: FloatArray, spacing: FloatArray, plane: FloatArray) -> BoolArray:
    """Whether tested points, projected to a plane, are near the support of the plane.

    Parameters
    ----------
    places : (M, 3) float64
        Support of the plane.
    tested : (N, 3) float64
        Points to test.
    spacing : (N,) float64
        Distance at which each has its neighbours.
    plane : (4,) float64
        Unit normal and offset.

    Returns
    -------
    (N,) bool
    """
    if len(tested) == 0:
        return np.zeros(0, dtype=bool)
    basis = np.stack(perpendicular(plane[:3]), axis=1)
    tree = kd_tree(places @ basis, balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(tested @ basis, distance_upper_bound=np.nextafter(GATES.link * spacing.max(), np.inf))
    return np.asarray(distance <= GATES.link * spacing)


def _median(values: FloatArray) -> float:
    """Median of a few numbers, without what NumPy does for many axes."""
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    ordered = np.partition(values, (half - 1, half))
    return 0.5 * float(ordered[half - 1] + ordered[half])
