# SPDX-License-Identifier: BSD-3-Clause
"""From a candidate of :mod:`groma.estimators.plane_search` to a plane: refined where it is connected, and judged."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from groma._numba import loop
from groma._ordering import copy, median
from groma._trees import nearest_in_order
from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators._plane_candidates import Features, squares
from groma.estimators._plane_loops import (
    BALL,
    connected_loop,
    connected_part_loop,
    fit_loop,
    height_kernel,
    layer_loop,
    near_free_loop,
    near_loop,
    variance_kernel,
)
from groma.estimators._plane_options import PLANE_SEARCH as GATES
from groma.estimators._plane_options import PlaneOptions
from groma.estimators.association import MAX_SQUARE, ROUNDS, log10_binomial_tail
from groma.estimators.plane_fit import PlaneFit, fit_with_covariance
from groma.gates import NORMAL
from groma.geometry.algebra import norm


@loop
def heights_loop(places, packed, rows, plane, height, spread):
    """Signed distances (M,) of rows from a plane, and their standard deviations (M,)."""
    for k in range(len(rows)):
        i = rows[k]
        height[k] = height_kernel(places[i], plane)
        spread[k] = math.sqrt(max(variance_kernel(packed[i], plane[0], plane[1], plane[2]), 1e-300))


@loop
def tilt_loop(places, packed, rows, plane, center, precision):
    """Largest variance of the normal of a plane fitted to rows (M,) with some precisions (M,), square radians.

    Features that are spread by their own noise alone, such as those of a line, do not tell it: the noise is taken off.
    """
    s00 = s01 = s02 = s11 = s12 = s22 = 0.0
    for k in range(len(rows)):
        i, p, c = rows[k], precision[k], packed[rows[k]]
        x, y, z = places[i, 0] - center[0], places[i, 1] - center[1], places[i, 2] - center[2]
        s00, s01, s02 = s00 + p * (x * x - c[0]), s01 + p * (x * y - c[1]), s02 + p * (x * z - c[2])
        s11, s12, s22 = s11 + p * (y * y - c[3]), s12 + p * (y * z - c[4]), s22 + p * (z * z - c[5])
    # Of the three eigenvalues that of the normal is left out: the sum and the product of the other two.
    a, b, c = plane[0], plane[1], plane[2]
    total = s00 + s11 + s22 - variance_kernel((s00, s01, s02, s11, s12, s22), a, b, c)
    minors = s11 * s22 - s12 * s12, s02 * s12 - s01 * s22, s01 * s12 - s02 * s11
    others = s00 * s22 - s02 * s02, s01 * s02 - s00 * s12, s00 * s11 - s01 * s01
    product = variance_kernel(minors + others, a, b, c)
    if not (product > 0.0 and total > 0.0):
        return np.inf
    return (0.5 * total + math.sqrt(max(0.25 * total * total - product, 0.0))) / product


@loop
def _refined_loop(features, labels, gates, mark, room, numbers, plane):
    """Refine a plane on the part of what lies on it that is connected; ``room[2]`` begins with the first such part.

    The normal of features that deviate alike is known as by one.
    Returns how many features that part has in the end, and the half thickness of the layer: 0 if it is no plane.
    """
    places, packed, spacing, partner, carrier, neighbours, balls = features
    gate, wider, far, link, converged, band, min_support, max_tilt, alike, rank, steps, rounds = gates
    height, spread, moved, weight, precision = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    before, center = np.empty(4), np.empty(3)
    num_free = num_near = 0
    count = neighbours.shape[1]
    for step in range(steps):
        # What is far away stays away. The first rounds reach farther: the candidate is not yet exact.
        if step < 2:
            reach = (far if step == 1 else wider) * gate
            num_free = near_free_loop(places, packed, balls, labels, plane, reach, room[0])
        limit = (wider if step < 2 else 1.0) * gate
        num_near = near_loop(places, packed, room[0, :num_free], plane, limit, room[1])
        part = room[2]
        count, independent = connected_part_loop(
            places, spacing, partner, carrier, neighbours, room[1, :num_near], part[:count], rank, link, mark, part
        )
        if independent < min_support:
            return count, 0.0
        rows = part[:count]
        heights_loop(places, packed, rows, plane, height, spread)
        for k in range(count):
            # Weights that fall with the distance lead to where the layer is densest, not to the middle of what it
            # cuts off.
            weight[k] = 1.0 / (1.0 + (height[k] / spread[k]) ** 2) ** 2
        copy(plane, before)
        fit_loop(places, packed, rows, weight, rounds, plane, center, precision)
        turned = before[0] * plane[0] + before[1] * plane[1] + before[2] * plane[2]
        heights_loop(places, packed, rows, plane, moved, spread)
        largest, usual = 0.0, median(spread[:count])
        for k in range(count):
            largest = max(largest, abs(moved[k] - math.copysign(height[k], turned * height[k])))
        if step > 1 and largest < converged * usual:
            break
    tilt = tilt_loop(places, packed, room[2, :count], plane, center, precision)
    tilt *= count if alike else 1
    return count, band * median(spread[:count]) if tilt <= max_tilt**2 else 0.0


@loop
def _polished_loop(features, rows, band, gates, mark, layer, joined, numbers, plane, center):
    """Fit a plane to what lies on it in the layer around it, where it is connected; return how much, and its share.

    Judged against all that is near, taken or not: what lies on a plane beside this one speaks against it. Membership is
    the weight: all of the plane where it is clean, its densest part where it is not.
    """
    places, packed, spacing, balls = features[0], features[1], features[2], features[6]
    link, inlier, least_share, turns, steps, rounds = gates
    height, spread, density, weight = numbers[0], numbers[1], numbers[2], numbers[3]
    count, share = 0, 0.5
    for _ in range(steps):
        number = layer_loop(places, balls, plane, band, layer)
        connected_loop(places, rows, places, layer[:number], spacing, link, plane, joined)
        for k in range(len(rows)):
            mark[rows[k]] = k
        count = 0
        for k in range(number):
            if joined[k] or mark[layer[k]] >= 0:
                layer[count] = layer[k]
                count += 1
        for k in range(len(rows)):
            mark[rows[k]] = -1
        heights_loop(places, packed, layer[:count], plane, height, spread)
        for k in range(count):
            s = max(spread[k], 1e-12 * band)
            density[k] = math.sqrt(2.0 / math.pi) / s * math.exp(-0.5 * min((height[k] / s) ** 2, MAX_SQUARE))
        share = 0.5
        for _ in range(turns):  # as in groma.estimators.association, of one structure
            total = 0.0
            for k in range(count):
                weight[k] = share * density[k] / (share * density[k] + (1.0 - share) / band)
                total += weight[k]
            share = (total + 1.0) / (count + 2.0)
        positive = 0
        for k in range(count):
            if not abs(height[k]) < inlier * spread[k]:
                weight[k] = 0.0
            positive += weight[k] > 0.0
        if share < least_share or positive < 3:  # derived from three that fix a plane
            return 0, 0.0
        fit_loop(places, packed, layer[:count], weight, rounds, plane, center, density)
    return count, share


@loop
def _grow_loop(features, labels, gates, others, mark, room, joined, numbers, plane, center):
    """Refine and polish a plane; return its number of features, half thickness, and the counts of its layer."""
    count, band = _refined_loop(features, labels, gates, mark, room, numbers, plane)
    inner, share = 0, 0.0
    if band > 0.0:
        inner, share = _polished_loop(
            features, room[2, :count], band, others, mark, room[3], joined, numbers, plane, center
        )  # fmt: skip
    return count, band, inner, share


@dataclass(frozen=True)
class Grown:
    """A plane that is kept."""

    fit: PlaneFit
    share: float
    band: float
    log10_false_alarms: float
    #: (M, 3) where the features on it are, and all features that are taken out with it.
    places: FloatArray
    taken: IntArray


#: A plane if it is kept; the refined plane, and its support.
Growth = tuple[Grown | None, FloatArray, IntArray]


class _Buffers:
    """What one thread writes to while it grows a candidate."""

    def __init__(self, count: int) -> None:
        self.mark, self.room = np.full(count, -1), np.empty((4, count), np.int64)
        self.joined, self.numbers = np.empty(count, bool), np.empty((5, count))


class Grower:
    """Grows candidates on the same features, several threads at a time; reuses its buffers.

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
        self._free: list[_Buffers] = []
        self._refining = (
            gate, GATES.wider, GATES.far, GATES.link, GATES.converged, GATES.band, options.min_support,
            options.max_tilt, features.rough, GATES.rank, GATES.grow_steps, GATES.fit_rounds,
        )  # fmt: skip
        least = GATES.hopeless * options.min_share
        self._polishing = GATES.link, NORMAL.far, least, ROUNDS, GATES.polish_steps, GATES.fit_rounds

    def grow(self, plane: FloatArray, home: int, labels: IntArray) -> Growth:
        """Refine a candidate where it is connected, and test it: its rows, the refined plane, its support.

        It grows from the neighbourhood of its ``home``, a feature: what lies on the same plane far away is another's.
        """
        try:
            buffers = self._free.pop()  # exclusive until they are put back
        except IndexError:
            buffers = _Buffers(len(self._features.places))
        result = self._grown(plane.copy(), home, labels, buffers)
        self._free.append(buffers)
        return result

    def _grown(self, plane: FloatArray, home: int, labels: IntArray, buffers: _Buffers) -> Growth:
        features, options, center = self._features, self._options, np.empty(3)
        first = features.neighbours[home]
        buffers.room[2, : len(first)] = first
        count, band, inner, share = _grow_loop(
            features.arrays, labels, self._refining, self._polishing, buffers.mark, buffers.room, buffers.joined,
            buffers.numbers, plane, center,
        )  # fmt: skip
        rows, layer = buffers.room[2, :count].copy(), buffers.room[3, :inner]
        if inner == 0 or share < options.min_share:
            return None, plane, rows
        height, spread, precision, weight = buffers.numbers[:4, :inner]
        reach = math.sqrt(self._gate) * spread
        edges = self._edges(layer[np.abs(height) < reach], labels)
        alarm = self._log10_false_alarms(plane, np.concatenate([rows, edges]))
        even = _log10_even(height, reach, band)
        if features.rough:  # some thicker layer stands out by chance
            even += self._log_tried
        if max(alarm, even) > np.log10(options.max_false_alarms):
            return None, plane, rows
        if features.rough and np.mean(labels[layer[np.abs(height) < reach]] < 0) <= NORMAL.majority:
            return None, plane, rows
        fit = fit_with_covariance(plane, center, features.places[layer], precision, weight)
        # The whole layer is taken out: relief so near cannot be distinguished from the plane.
        taken = np.union1d(rows, layer[labels[layer] < 0])
        return Grown(fit, share, band, alarm, features.places[rows], taken), plane, rows

    def _log10_false_alarms(self, plane: FloatArray, rows: IntArray) -> float:
        """Number of planes tried on which as much would lie by chance, of what is in a ball around it, log10."""
        features, places = self._features, self._features.places
        center = places[rows].mean(axis=0)
        radius = float(np.quantile(norm(places[rows] - center), GATES.extent))
        balls = np.flatnonzero(norm(features.balls[:, :3] - center) <= radius + features.balls[:, 3])
        near = (BALL * balls[:, None] + np.arange(BALL)).ravel()
        near = near[near < len(places)]
        near = near[norm(places[near] - center) < radius]
        on = np.zeros(len(places), bool)
        on[np.intersect1d(rows, near)] = True
        carrier = features.carrier[near]
        support = on[near] & ~((carrier >= 0) & on[carrier])
        counted = near[support | (carrier < 0)]  # carried points say nothing of their own
        spread = np.sqrt(np.maximum(features.packed[counted] @ squares(plane[:3]), 1e-300))
        shares = np.minimum(math.sqrt(self._gate) * spread / max(radius, 1e-300), 1.0)
        chance = float(shares.sum()) / max(len(counted), 1)
        inside = int(np.count_nonzero(support))
        return log10_binomial_tail(inside - 4, len(counted) - 3, chance) + self._log_tried  # three fix it

    def _edges(self, on: IntArray, labels: IntArray) -> IntArray:
        """Of what lies on a plane, both ends of segments that were taken out with others: an edge is on two faces."""
        other = self._features.partner[on]
        return on[(labels[on] >= 0) & (other != on) & np.isin(other, on)]


def _log10_even(height: FloatArray, reach: FloatArray, band: float) -> float:
    """How likely so much of a layer lies within ``reach`` of the plane if it is filled as its fuller side is, log10.

    A round body fills one side of the layer of a plane that touches it, and the sides of a thin post both sides of
    the layer of any plane that cuts through them.
    """
    above, below = height >= reach, height <= -reach
    fuller = above if np.count_nonzero(above) > np.count_nonzero(below) else below
    on = ~(above | below)
    counted = reach[on | fuller]
    chance = float(np.minimum(2.0 * counted / (counted + band), 1.0).mean())
    return log10_binomial_tail(int(np.count_nonzero(on)) - 4, len(counted) - 3, chance)  # three fix it


def connected_to(places: FloatArray, tested: FloatArray, spacing: FloatArray, plane: FloatArray) -> BoolArray:
    """Whether tested points, projected to a plane, are near the support of the plane.

    Parameters
    ----------
    places : (M, 3) float64
        Support of the plane, near ones together.
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
    height, height_of_places = (at @ plane[:3] + plane[3] for at in (tested, places))
    flat = places - height_of_places[:, None] * plane[:3]
    distance, _ = nearest_in_order(flat, tested - height[:, None] * plane[:3], 1, GATES.link * spacing)
    return np.asarray(distance[:, 0] < np.inf)
