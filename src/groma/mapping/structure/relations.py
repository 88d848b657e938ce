# SPDX-License-Identifier: BSD-3-Clause
"""Which points and lines lie on planes, along directions, on lines: chi-square tests with the landmarks' covariances.

A pair is related if it passes three tests: the distance is within the noise of both (chi-square test); the landmark is
probably not clutter near the structure (:mod:`groma.estimators.association`), which leaves out landmarks that are too
uncertain to decide; and it lies where the structure was observed, not on its extension.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial import KDTree

from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.association import inlier_probability
from groma.estimators.directions import DirectionSet
from groma.estimators.plane_search import BAND, PlaneSet, connected_to
from groma.execution import map_in_threads, num_threads
from groma.gates import chi_square_gate, gate
from groma.geometry.algebra import dot, norm, perpendicular, unit
from groma.mapping.groups import distinct_pairs
from groma.mapping.noise.landmarks import LineNoise, PointNoise
from groma.scene import LineIntervals


@dataclass(frozen=True)
class RelationGates:
    """What competes for a landmark, and where landmarks are looked for."""

    competing: float = gate(
        0.26, "rad", "between the normals of planes that compete for a landmark", "chosen on benchmarks/surveyed.py"
    )
    line_margin: float = gate(
        0.02, "1", "of the length of a line, that points on it may be beyond", "chosen on benchmarks/surveyed.py"
    )
    pooled: float = gate(
        4.0, "features", "that the share of all lines counts in that of each", "chosen on walls full of points"
    )
    neighbor: int = gate(
        8, "neighbours", "at whose distance a landmark has its surroundings", "chosen on benchmarks/surveyed.py"
    )
    num_nearest: int = gate(12, "samples", "of segments that a point is compared with", "cost: time of a search")
    num_samples: tuple[int, int] = gate(
        (50_000, 12), "samples", "of all segments, and per segment on average", "cost: memory"
    )


@dataclass(frozen=True)
class Landmarks:
    """Points and segments with their noise; only the usable ones take part in relations."""

    points: FloatArray
    point_noise: PointNoise
    point_usable: BoolArray
    segments: FloatArray
    line_noise: LineNoise
    line_usable: BoolArray
    #: (P,) and (L, 2) distances at which points and segment ends have their neighbours.
    point_spacing: FloatArray
    end_spacing: FloatArray
    #: Where the segments are supported.
    intervals: LineIntervals


@dataclass(frozen=True)
class Pairs:
    """Landmarks and the structures they belong to."""

    #: (M, 2) number of the landmark, number of the structure.
    pairs: IntArray
    #: (M,) probability that the landmark is no clutter.
    probability: FloatArray

    @staticmethod
    def none() -> Pairs:
        """No pairs."""
        return Pairs(np.zeros((0, 2), np.int64), np.zeros(0))

    def take(self, rows: IntArray | BoolArray) -> Pairs:
        """Return some of the pairs."""
        return Pairs(self.pairs[rows], self.probability[rows])

    def counts(self, num: int) -> IntArray:
        """(num,) landmarks of each structure."""
        return np.bincount(self.pairs[:, 1], minlength=num)

    def renumbered(self, new: IntArray) -> Pairs:
        """Return the pairs with other numbers of structures, without those whose new number is -1."""
        structure = new[self.pairs[:, 1]]
        return Pairs(np.column_stack([self.pairs[:, 0], structure]), self.probability).take(structure >= 0)


def spacings(
    points: FloatArray, segments: FloatArray, gates: RelationGates = RelationGates()
) -> tuple[FloatArray, FloatArray]:
    """Distances (P,), (L, 2) from points and segment ends to their neighbours among both."""
    places = np.concatenate([points, segments.reshape(-1, 3)])
    if len(places) < 2:
        return np.ones(len(points)), np.ones((len(segments), 2))
    distance, _ = KDTree(places).query(places, k=min(gates.neighbor + 1, len(places)), workers=num_threads())
    return distance[: len(points), -1], distance[len(points) :, -1].reshape(-1, 2)


def on_planes(
    marks: Landmarks,
    found: PlaneSet,
    level: float,
    least: tuple[float, float],
    gates: RelationGates = RelationGates(),
) -> tuple[Pairs, Pairs]:
    """Points on planes and lines on planes; their probabilities have to exceed the least of their kind."""
    num = len(found)
    parts = map_in_threads(partial(_near_plane, marks, found, level), range(num))
    points, lines = ([_nothing(), *tables] for tables in (list(zip(*parts, strict=True)) or [(), ()]))
    competing = np.arccos(np.clip(np.abs(found.planes[:, :3] @ found.planes[:, :3].T), 0.0, 1.0)) < gates.competing
    results = []
    for table, enough in zip((np.concatenate(points), np.concatenate(lines)), least, strict=True):
        probability, _ = inlier_probability(table[:, 2], table[:, 3], table[:, 1].astype(np.int64), found.band)
        results.append(_best_of_competing(_passing(table, probability, enough), competing, num))
    return results[0], results[1]


def _near_plane(marks: Landmarks, found: PlaneSet, level: float, k: int) -> tuple[FloatArray, FloatArray]:
    """Points and lines in the layer of a plane, where it is connected: tables as :func:`_with_plane` makes them."""
    point_gate, line_gate = chi_square_gate(1.0 - level, 1), chi_square_gate(1.0 - level, 2)
    usable_points, usable_lines = np.flatnonzero(marks.point_usable), np.flatnonzero(marks.line_usable)
    plane, covariance = found.planes[k], found.covariance[k]
    height = np.abs(marks.points[usable_points] @ plane[:3] + plane[3])
    rows = usable_points[height < found.band[k]]
    rows = rows[connected_to(found.places[k], marks.points[rows], marks.point_spacing[rows], plane)]
    points = _with_plane(rows, k, *_point_heights(marks, rows, plane, covariance), point_gate)
    ends = marks.segments[usable_lines]
    rows = usable_lines[(np.abs(ends @ plane[:3] + plane[3]) < found.band[k]).all(axis=1)]
    near = connected_to(found.places[k], marks.segments[rows].reshape(-1, 3), marks.end_spacing[rows].ravel(), plane)
    rows = rows[near.reshape(-1, 2).all(axis=1)]
    return points, _with_plane(rows, k, *_line_heights(marks, rows, plane, covariance), line_gate)


def along_directions(
    marks: Landmarks,
    found: DirectionSet,
    sigma: float,
    level: float,
    least: float,
) -> Pairs:
    """Lines along directions, at most one direction for each line."""
    rows = np.flatnonzero(marks.line_usable)
    if len(rows) == 0 or len(found) == 0:
        return Pairs.none()
    extent = marks.segments[rows, 1] - marks.segments[rows, 0]
    own = marks.line_noise.directions(norm(marks.segments[:, 1] - marks.segments[:, 0]))[rows]
    basis = np.stack(perpendicular(unit(extent)), axis=1)
    tables, bands = [_nothing()], np.zeros(len(found))
    largest = chi_square_gate(1.0 - level, 2)
    for k, vector in enumerate(found.vectors):
        across = basis @ vector
        noise = basis @ (own + found.covariance[k]) @ np.swapaxes(basis, 1, 2) + sigma**2 * np.eye(2)
        squared = np.einsum("na,na->n", across, np.linalg.solve(noise, across[..., None])[..., 0])
        spread = np.sqrt(np.linalg.eigvalsh(noise)[:, 1])
        angle = norm(across)
        passing = squared < largest
        bands[k] = BAND * float(np.median(spread[passing])) if passing.any() else 0.0
        near = angle < bands[k]
        tables.append(_with_plane(rows[near], k, angle[near], spread[near], squared[near], largest))
    table = np.concatenate(tables)
    probability, _ = inlier_probability(table[:, 2], table[:, 3], table[:, 1].astype(np.int64), bands)
    return _best_of_competing(_passing(table, probability, least), np.ones((len(found), len(found)), bool), len(found))


def on_lines(marks: Landmarks, level: float, least: float, gates: RelationGates = RelationGates()) -> Pairs:
    """Points on lines: where images support them, not in gaps nor beyond their ends."""
    rows = np.flatnonzero(marks.line_usable)
    tested = np.flatnonzero(marks.point_usable)
    if len(rows) == 0 or len(tested) == 0:
        return Pairs.none()
    pairs = _near_segments(marks.points[tested], marks.segments[rows], gates)
    point, line = tested[pairs[:, 0]], rows[pairs[:, 1]]
    start, along = marks.segments[line, 0], marks.segments[line, 1] - marks.segments[line, 0]
    share = dot(marks.points[point] - start, along) / dot(along, along)
    offset = marks.points[point] - start - share[:, None] * along
    inside = marks.intervals.covers(line, share, gates.line_margin)
    point, line, share, offset = point[inside], line[inside], share[inside], offset[inside]
    across = marks.line_noise.across[line]
    components = np.einsum("nai,ni->na", across, offset)
    noise = across @ marks.point_noise.covariance[point] @ np.swapaxes(across, 1, 2)
    noise += marks.line_noise.at(share, share, line)
    squared = np.einsum("na,na->n", components, np.linalg.solve(noise, components[..., None])[..., 0])
    spread = np.sqrt(np.linalg.eigvalsh(noise)[:, 1])
    distance = norm(components)
    num = len(marks.segments)
    largest = chi_square_gate(1.0 - level, 2)
    near = squared < BAND**2
    # The band of a line is set by the noise of what is near it.
    count = np.maximum(np.bincount(line[near], minlength=num), 1)
    band = BAND * np.bincount(line[near], weights=spread[near], minlength=num) / count
    band = np.maximum(band, 1e-300)
    near = distance < band[line]
    point, line, squared = point[near], line[near], squared[near]
    # On a wall full of points the clutter beside a line is spread over one dimension, not two.
    probability, _ = inlier_probability(distance[near], spread[near], line, band, gates.pooled)
    passed = (squared < largest) & (probability > least)
    return Pairs(np.column_stack([point, line]), probability).take(passed)


# --------------------------------------------------------------------------------------------------------- Distances
def _nothing() -> FloatArray:
    return np.zeros((0, 6))


def _with_plane(
    rows: IntArray, k: int, distance: FloatArray, spread: FloatArray, squared: FloatArray, largest: float
) -> FloatArray:
    """Table of landmark, structure, distance, standard deviation, squared whitened distance, gate."""
    constant = np.ones(len(rows))
    columns = rows.astype(np.float64), k * constant, distance, spread, squared, largest * constant
    return np.column_stack(columns)


def _point_heights(
    marks: Landmarks, rows: IntArray, plane: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    height = marks.points[rows] @ plane[:3] + plane[3]
    lever = np.column_stack([marks.points[rows], np.ones(len(rows))])
    variance = np.einsum("i,nij,j->n", plane[:3], marks.point_noise.covariance[rows], plane[:3])
    variance = np.maximum(variance + np.einsum("ni,ij,nj->n", lever, covariance, lever), 1e-300)
    return np.abs(height), np.sqrt(variance), height**2 / variance


def _line_heights(
    marks: Landmarks, rows: IntArray, plane: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Height of the segment where it is known best, its deviation, and the squared whitened heights of both ends.

    Clutter beside a plane is often parallel to it (mouldings, frames), so that the height of a segment tells it from
    what lies on the plane, and its tilt does not: the mixture looks at the one, the chi-square test at both.
    """
    ends = marks.segments[rows]
    height = ends @ plane[:3] + plane[3]
    slope = marks.line_noise.across[rows] @ plane[:3]
    blocks = marks.line_noise.covariance[rows].reshape(-1, 2, 2, 2, 2)
    lever = np.concatenate([ends, np.ones((len(rows), 2, 1))], axis=2)
    noise = np.einsum("na,neafb,nb->nef", slope, blocks, slope)
    noise += np.einsum("nei,ij,nfj->nef", lever, covariance, lever)
    size = np.trace(noise, axis1=1, axis2=2)
    noise = noise + (1e-9 * size + 1e-300)[:, None, None] * np.eye(2)
    squared = np.einsum("ne,ne->n", height, np.linalg.solve(noise, height[..., None])[..., 0])
    weight = np.linalg.solve(noise, np.ones((len(rows), 2, 1)))[..., 0]
    information = weight.sum(axis=1)
    return np.abs((weight * height).sum(axis=1)) / information, 1.0 / np.sqrt(information), squared


def _near_segments(points: FloatArray, segments: FloatArray, gates: RelationGates) -> IntArray:
    """Pairs (point, segment) of segments near points, found by samples along the segments."""
    length = norm(segments[:, 1] - segments[:, 0])
    number = max(gates.num_samples[0], gates.num_samples[1] * len(segments))
    count = np.clip(np.ceil(number * length / max(length.sum(), 1e-300)), 3, 512).astype(np.int64)
    owner = np.repeat(np.arange(len(segments)), count)
    first = np.repeat(np.cumsum(count) - count, count)
    share = (np.arange(len(owner)) - first) / (count[owner] - 1)
    samples = segments[owner, 0] + share[:, None] * (segments[owner, 1] - segments[owner, 0])
    nearest = min(gates.num_nearest, len(samples))
    _, index = KDTree(samples).query(points, k=nearest, workers=num_threads())
    return distinct_pairs(np.repeat(np.arange(len(points)), nearest), owner[index.reshape(len(points), -1)].ravel())[0]


def _passing(table: FloatArray, probability: FloatArray, least: float) -> Pairs:
    """Pairs of a table that pass the chi-square test and are probable enough."""
    passed = (table[:, 4] < table[:, 5]) & (probability > least)
    return Pairs(table[:, :2].astype(np.int64), probability).take(passed)


def _best_of_competing(found: Pairs, competing: BoolArray, num: int) -> Pairs:
    """The likeliest pairs where a landmark is claimed by structures of which only one can be right."""
    pairs = found.pairs
    if len(pairs) == 0:
        return found
    order = np.lexsort((-found.probability, pairs[:, 0]))
    kept = np.zeros(len(pairs), dtype=bool)
    # Claims of one landmark follow each other, the likeliest first: compare rank by rank with those kept before.
    landmark = pairs[order, 0]
    first = np.flatnonzero(np.r_[True, landmark[1:] != landmark[:-1]])
    rank = np.arange(len(order)) - np.repeat(first, np.diff(np.r_[first, len(order)]))
    taken = np.zeros((int(pairs[:, 0].max()) + 1, num), dtype=bool)
    for level in range(int(rank.max()) + 1):
        rows = order[rank == level]
        owner, structure = pairs[rows].T
        free = ~(taken[owner] & competing[structure]).any(axis=1)
        kept[rows[free]] = True
        taken[owner[free], structure[free]] = True
    return found.take(kept)


__all__ = ["Landmarks", "Pairs", "RelationGates", "along_directions", "on_lines", "on_planes", "spacings"]
