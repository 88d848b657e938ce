# SPDX-License-Identifier: BSD-3-Clause
"""Candidates of :mod:`groma.estimators.plane_search`: planes of neighbouring features, of near segments, and of planes.

Their number grows with the features, and each looks only at what is near: a scene has the same candidates whether it
stands alone or is part of a larger one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from groma._numba import loop, unrolled_loop
from groma._ordering import median
from groma._trees import kd_tree, nearest
from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators._plane_loops import BALL, height_kernel, least_axis_kernel, lies_on_kernel, variance_kernel
from groma.estimators._plane_options import PLANE_SEARCH
from groma.execution import map_in_threads, map_ranges
from groma.gates import NORMAL
from groma.geometry.algebra import cross, dot, norm

#: Pairs processed together (cost: memory).
_CHUNK = 4096
#: Features, or up to twice as many, by which two planes are compared (cost: time only).
_JUDGES = 64
#: Candidates that are worth a thread, to be drawn and to be scored: scoring one takes a hundredth of a millisecond, and
#: handing over a tenth. And pieces, as some candidates take longer than others (cost: time only).
_DRAWN_AT_ONCE, _SCORED_AT_ONCE, _PIECES = 1024, 256, 32

#: Where the entries of a covariance, and those of its diagonal, are among the packed ones (derived from
#: their order).
_UNPACKED, _DIAGONAL = [0, 1, 2, 1, 3, 4, 2, 4, 5], [0, 3, 5]


@dataclass(frozen=True)
class Features:
    """Points and segment ends, near ones together."""

    places: FloatArray
    #: (N, 6) covariances as vectors whose product with :func:`squares` of a normal is the variance along it.
    packed: FloatArray
    #: (N,) distance at which a feature has its neighbours.
    spacing: FloatArray
    #: (N,) other end of the same segment, or the feature itself.
    partner: IntArray
    #: (N,) first end of the segment that a point lies on, -1 for none.
    carrier: IntArray
    #: (N, n) the nearest features of each, itself first.
    neighbours: IntArray
    #: (B, 5) balls that hold ``BALL`` features each: center, radius, a bound of the variances.
    balls: FloatArray
    #: (N,) the number that each was given with, and where each of those is here.
    given: IntArray
    position: IntArray
    #: Whether surfaces deviate, which neighbours do alike.
    rough: bool = False

    @property
    def arrays(self) -> tuple[Any, ...]:
        """What loops take."""
        return self.places, self.packed, self.spacing, self.partner, self.carrier, self.neighbours, self.balls

    def thicker(self, factor: float) -> Features:
        """Return features of rough surfaces: the least standard deviation of each is so many times as large."""
        least = np.linalg.eigvalsh(self.packed[:, _UNPACKED].reshape(-1, 3, 3))[:, 0]
        packed = self.packed.copy()
        packed[:, _DIAGONAL] += (factor**2 - 1.0) * least[:, None]
        balls = self.balls.copy()
        balls[:, 4] = np.maximum.reduceat(packed[:, _DIAGONAL].sum(axis=1), np.arange(0, len(packed), BALL))
        return replace(self, packed=packed, balls=balls, rough=True)


def features_of(places: FloatArray, noise: FloatArray, partner: IntArray, carrier: IntArray) -> Features:
    """Return places (N, 3) of points and segment ends, their covariances (N, 3, 3), and their neighbourhoods."""
    near = min(PLANE_SEARCH.neighbours, len(places))
    tree = kd_tree(places)
    given = np.asarray(tree.indices, dtype=np.int64)
    position = np.empty_like(given)
    position[given] = np.arange(len(given))
    places, noise = places[given], noise[given]
    distance, neighbours = nearest(tree, places, near)
    first = np.arange(0, len(places), BALL)
    number = np.diff(np.append(first, len(places)))
    center = np.add.reduceat(places, first) / number[:, None]
    radius = np.maximum.reduceat(norm(places - np.repeat(center, number, axis=0)), first)
    variance = np.maximum.reduceat(np.trace(noise, axis1=1, axis2=2), first)
    return Features(
        places=places,
        packed=np.ascontiguousarray(noise[:, *np.triu_indices(3)]),
        spacing=np.maximum(distance[:, min(PLANE_SEARCH.rank, near - 1)], 1e-12),
        partner=position[partner[given]],
        carrier=np.where(carrier >= 0, position[carrier], -1)[given],
        neighbours=position.astype(np.int32)[neighbours],
        balls=np.column_stack([center, radius, variance]),
        given=given,
        position=position,
    )


def squares(normal: FloatArray) -> FloatArray:
    """Products (..., 6) of the entries of normals (..., 3), those off the diagonal twice."""
    x, y, z = normal[..., 0], normal[..., 1], normal[..., 2]
    return np.stack([x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z], axis=-1)


@loop
def _through_neighbours(places, packed, neighbours, seed, choice, limit, rounds, planes):
    """Planes (H, 4) through seeds and two of their neighbours each, improved on all of them; all zero where none is."""
    A, V, n = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    weight = np.empty(neighbours.shape[1])
    for h in range(len(seed)):
        home = seed[h]
        c0, c1, c2 = places[home, 0], places[home, 1], places[home, 2]
        a, b = neighbours[home, choice[h, 0]], neighbours[home, choice[h, 1]]
        u0, u1, u2 = places[a, 0] - c0, places[a, 1] - c1, places[a, 2] - c2
        v0, v1, v2 = places[b, 0] - c0, places[b, 1] - c1, places[b, 2] - c2
        n[0], n[1], n[2] = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        size = math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        planes[h] = 0.0
        if not size > 0.0:
            continue
        n /= size
        for _ in range(rounds):
            total = m0 = m1 = m2 = 0.0
            enough = 0
            for k in range(len(weight)):
                i = neighbours[home, k]
                height = (places[i, 0] - c0) * n[0] + (places[i, 1] - c1) * n[1] + (places[i, 2] - c2) * n[2]
                variance = max(variance_kernel(packed[i], n[0], n[1], n[2]), 1e-300)
                weight[k] = 0.0
                if height * height < limit * variance:
                    weight[k] = 1.0 / (variance + height * height)
                    enough += 1
                    total += weight[k]
                    m0 += weight[k] * places[i, 0]
                    m1 += weight[k] * places[i, 1]
                    m2 += weight[k] * places[i, 2]
            if enough < 4:  # derived from three that fix a plane
                break
            c0, c1, c2 = m0 / total, m1 / total, m2 / total
            A[:] = 0.0
            for k in range(len(weight)):
                i = neighbours[home, k]
                x, y, z, p = places[i, 0] - c0, places[i, 1] - c1, places[i, 2] - c2, weight[k] / total
                A[0, 0] += p * x * x
                A[0, 1] += p * x * y
                A[0, 2] += p * x * z
                A[1, 1] += p * y * y
                A[1, 2] += p * y * z
                A[2, 2] += p * z * z
            A[1, 0], A[2, 0], A[2, 1] = A[0, 1], A[0, 2], A[1, 2]
            least = least_axis_kernel(A, V)
            n[0], n[1], n[2] = V[0, least], V[1, least], V[2, least]
        planes[h, 0], planes[h, 1], planes[h, 2] = n[0], n[1], n[2]
        planes[h, 3] = -(n[0] * c0 + n[1] * c1 + n[2] * c2)


def from_neighbours(
    features: Features, free: IntArray, fresh: BoolArray, gate: float, rng: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """Candidates (H, 4) from free ``fresh`` features (N,), their homes (H,), and two neighbours, improved there."""
    number, near = len(free), features.neighbours.shape[1]
    count = max(number // PLANE_SEARCH.features_per_seed, min(PLANE_SEARCH.min_seeds, PLANE_SEARCH.repeated * number))
    seed = free[rng.permutation(np.repeat(np.arange(number), -(-count // number)))[:count]]
    choice = rng.integers(1, near, (count, 2))[fresh[seed]]
    seed = seed[fresh[seed]]
    planes = np.empty((len(seed), 4))

    def draw(part: slice) -> None:
        _through_neighbours(
            features.places, features.packed, features.neighbours, seed[part], choice[part], PLANE_SEARCH.wider * gate,
            PLANE_SEARCH.rounds, planes[part]
        )  # fmt: skip

    map_ranges(draw, len(seed), _DRAWN_AT_ONCE)
    valid = planes[:, :3].any(axis=1)
    return planes[valid], seed[valid]


def from_planes(
    features: Features, planes: FloatArray, labels: IntArray, fresh: BoolArray, rng: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """Candidates (H, 4) at free ``fresh`` features (N,), their homes (H,): parallel to planes beside, or across two."""
    free = np.flatnonzero(labels < 0)
    seed = np.sort(rng.permutation(free)[: max(len(free) // PLANE_SEARCH.features_per_seed, PLANE_SEARCH.min_seeds)])
    seed = seed[fresh[seed]]
    label = np.sort(labels[features.neighbours[seed]], axis=1)
    label = np.sort(np.where(np.diff(label, axis=1, prepend=-1) > 0, label, -1), axis=1)[:, ::-1]
    first, second = np.triu_indices(max(int((label >= 0).sum(axis=1).max(initial=0)), 1))
    row, pair = np.nonzero(label[:, second] >= 0)
    one, other = planes[label[row, first[pair]], :3], planes[label[row, second[pair]], :3]
    normal = np.where((first == second)[pair, None], one, cross(one, other))
    size = norm(normal)
    kept = size > PLANE_SEARCH.crossing
    normal, homes = normal[kept] / size[kept, None], seed[row[kept]]
    return np.column_stack([normal, -dot(normal, features.places[homes])]), homes


def from_segments(
    features: Features, corner: IntArray, gate: float, fresh: BoolArray
) -> tuple[FloatArray, IntArray, int]:
    """Candidates (H, 4) from near segments that are coplanar within their noise, their homes, and how many were tried.

    Of the pairs of a segment with ``fresh`` ends (N,), those that fix their plane best; ``corner`` (L, 2) has the ends.
    """
    ends = features.places[corner]
    if len(ends) < 2:
        return np.zeros((0, 4)), np.zeros(0, np.int64), 0
    middle = ends.mean(axis=1)
    count = min(PLANE_SEARCH.near_segments + 1, len(ends))
    _, near = nearest(kd_tree(middle), middle, count)
    first, second = np.repeat(np.arange(len(ends)), count - 1), near[:, 1:].ravel()
    keys = np.sort((np.minimum(first, second) * len(ends) + np.maximum(first, second))[first != second])
    once = np.column_stack(np.divmod(keys[np.diff(keys, prepend=-1) > 0], len(ends)))
    once = once[fresh[corner[once]].any(axis=(1, 2))]
    chunks = [once[k : k + _CHUNK] for k in range(0, max(len(once), 1), _CHUNK)]
    parts = map_in_threads(partial(_coplanar, features, corner, gate), chunks)
    pairs, planes, worth = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((-worth, pairs[:, 0]))
    owner = pairs[order, 0]
    chosen = np.sort(order[np.arange(len(order)) - np.searchsorted(owner, owner) < PLANE_SEARCH.pairs])
    return planes[chosen], corner[pairs[chosen, 0], 0], len(once)


def _coplanar(
    features: Features, ends: IntArray, gate: float, pairs: IntArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Those of some pairs (M, 2) of segments that span a plane, the planes (M, 4), and how well each is fixed (M,)."""
    corner = ends[pairs].reshape(-1, 4)
    four = features.places[corner]
    center = four.mean(axis=1)
    away = four - center[:, None]
    values, axes = np.linalg.eigh(np.einsum("hki,hkj->hij", away, away))
    normal = axes[:, :, 0]
    variance = np.einsum("hkc,hc->hk", features.packed[corner], squares(normal)).mean(axis=1)
    flat = values[:, 0] < 2.0 * gate * variance
    # Two segments on one line leave the plane open.
    flat &= values[:, 1] > PLANE_SEARCH.not_collinear * np.maximum(values[:, 0], variance)
    planes = np.column_stack([normal, -dot(normal, center)])
    return pairs[flat], planes[flat], values[flat, 1] / variance[flat]


@unrolled_loop
def scores_loop(features, labels, gate, reach, planes, homes, which, stamp, number, queue, support, score):
    """For some candidates, how many free features lie on them around their homes (M,), and their information (M,).

    What lies on the plane is followed from neighbour to neighbour, until ``queue`` is full. Each feature adds the
    logarithm of the extent of all that was found over its own noise, less near the gate. ``stamp`` (N,) holds numbers
    up to ``number``; higher ones are written.
    """
    places, packed, spacing, partner, _, neighbours, _ = features
    for w in range(len(which)):
        number += 1
        plane, home = planes[which[w]], homes[which[w]]
        count = begin = 0
        for m in range(neighbours.shape[1]):
            i = neighbours[home, m]
            stamp[i] = number
            if count < len(queue) and labels[i] < 0 and lies_on_kernel(i, places, packed, plane, gate):
                queue[count] = i
                count += 1
        while begin < count < len(queue):
            i = queue[begin]
            begin += 1
            for m in range(-1, neighbours.shape[1]):
                j = partner[i] if m < 0 else neighbours[i, m]
                if stamp[j] == number:
                    continue
                if m >= 0:
                    x, y, z = places[j, 0] - places[i, 0], places[j, 1] - places[i, 1], places[j, 2] - places[i, 2]
                    if x * x + y * y + z * z > (reach * max(spacing[i], spacing[j])) ** 2:
                        continue
                stamp[j] = number
                if count < len(queue) and labels[j] < 0 and lies_on_kernel(j, places, packed, plane, gate):
                    queue[count] = j
                    count += 1
        support[w], score[w] = count, 0.0
        if count == 0:
            continue
        c0 = c1 = c2 = spread = 0.0
        for k in range(count):
            i = queue[k]
            c0 += places[i, 0] / count
            c1 += places[i, 1] / count
            c2 += places[i, 2] / count
        for k in range(count):
            i = queue[k]
            x, y, z = places[i, 0] - c0, places[i, 1] - c1, places[i, 2] - c2
            spread += 2.0 * (x * x + y * y + z * z) / count  # of a disc, the square of its radius
        for k in range(count):
            i = queue[k]
            height = height_kernel(places[i], plane)
            variance = gate * max(variance_kernel(packed[i], plane[0], plane[1], plane[2]), 1e-300)
            if spread > variance:
                score[w] += (1.0 - height * height / variance) * 0.5 * math.log(spread / variance)


@loop
def keep_others_loop(features, rows, plane, planes, same, first_at, at, mark, alive):
    """Take candidates near rows that would end at their plane off those that are ``alive`` (H,).

    They are equal if half of some rows, or more, are within this many standard deviations. Candidates
    ``at[first_at[i]]`` to before ``at[first_at[i + 1]]`` are at home at feature i. ``mark`` (N,) holds -1, and does so
    again.
    """
    places, packed, neighbours = features[0], features[1], features[5]
    spread = np.empty(len(rows))
    for k in range(len(rows)):
        spread[k] = math.sqrt(max(variance_kernel(packed[rows[k]], plane[0], plane[1], plane[2]), 1e-300))
    limit, step = same * median(spread), max(1, len(rows) // _JUDGES)
    height = np.empty((len(rows) + step - 1) // step)
    for k in range(len(rows)):
        for m in range(neighbours.shape[1]):
            i = neighbours[rows[k], m]
            if mark[i] >= 0:
                continue
            mark[i] = 0
            for c in range(first_at[i], first_at[i + 1]):
                within = beyond = 0
                while alive[at[c]] and within + beyond < len(height) and 2 * max(within, beyond) <= len(height):
                    j = within + beyond
                    height[j] = abs(height_kernel(places[rows[j * step]], planes[at[c]]))
                    if height[j] > limit:
                        beyond += 1
                    else:
                        within += 1
                if within > beyond or (within == beyond > 0 and median(height) <= limit):
                    alive[at[c]] = False
    for k in range(len(rows)):
        for m in range(neighbours.shape[1]):
            mark[neighbours[rows[k], m]] = -1


class Scores:
    """Scores of candidates where they are at home.

    Parameters
    ----------
    features : Features
        Points and segment ends.
    planes : (H, 4) float64
        Candidates.
    homes : (H,) int
        The feature that each was drawn at.
    gate : float
        Squared distance over variance up to which a feature lies on a plane.
    reach : float
        Longest link between features, as a multiple of their spacing.
    """

    def __init__(self, features: Features, planes: FloatArray, homes: IntArray, gate: float, reach: float) -> None:
        self._features, self._planes, self._homes = features, planes, homes
        self._gate, self._reach, self.count = gate, reach, len(planes)
        self._rooms: list[_Room] = []
        self._at = np.argsort(homes, kind="stable")
        self._first_at = np.searchsorted(homes[self._at], np.arange(len(features.places) + 1))
        self._mark = np.full(len(features.places), -1)

    def of(self, which: IntArray, labels: IntArray) -> tuple[IntArray, FloatArray]:
        """Support (M,) and score (M,) of some candidates among the features without a label."""
        features, support, score = self._features, np.empty(len(which), np.int64), np.empty(len(which))
        pieces = max(1, min(_PIECES, len(which) // _SCORED_AT_ONCE))
        cuts = [len(which) * piece // pieces for piece in range(pieces + 1)]

        def fill(piece: int) -> None:
            part = slice(cuts[piece], cuts[piece + 1])
            try:
                room = self._rooms.pop()  # exclusive until it is put back
            except IndexError:
                room = _Room(len(features.places))
            scores_loop(
                features.arrays, labels, self._gate, self._reach, self._planes, self._homes, which[part], room.stamp,
                room.number, room.queue, support[part], score[part],
            )  # fmt: skip
            room.number += part.stop - part.start
            self._rooms.append(room)

        map_in_threads(fill, range(pieces))
        return support, score

    def keep_others(self, plane: FloatArray, rows: IntArray, alive: BoolArray) -> None:
        """Take candidates that would end at a plane, on some features, off those that are worth a try (H,)."""
        if len(rows):
            keep_others_loop(
                self._features.arrays, rows, plane, self._planes, NORMAL.alike, self._first_at, self._at,
                self._mark, alive,
            )  # fmt: skip


class _Room:
    """Where one thread keeps which features it has met."""

    def __init__(self, num_features: int) -> None:
        self.stamp, self.number = np.zeros(num_features, np.int64), 0
        self.queue = np.empty(PLANE_SEARCH.max_followed, np.int64)
