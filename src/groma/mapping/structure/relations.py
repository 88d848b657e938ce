# SPDX-License-Identifier: BSD-3-Clause
"""Which points and lines lie on planes, along directions, on lines: chi-square tests with the landmarks' covariances.

A pair is related if it passes three tests: the distance is within the noise of both (chi-square test); the landmark is
probably not clutter near the structure (:mod:`groma.estimators.association`), which leaves out landmarks that are too
uncertain to decide; and it lies where the structure was observed, not on its extension.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from groma._rows import Rows, column, numbered
from groma._trees import kd_tree, nearest
from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.association import inlier_probability
from groma.estimators.membership import MEMBERSHIPS, Candidates, memberships
from groma.estimators.plane_search import BAND, PlaneSet, connected_to
from groma.execution import map_in_threads, together
from groma.gates import SEARCH, SURVEYED, chi_square_gate, gate
from groma.geometry.algebra import dot, norm
from groma.mapping.groups import distinct_pairs
from groma.mapping.noise.landmarks import LineNoise, PointNoise
from groma.scene import LineIntervals


@dataclass(frozen=True)
class RelationGates:
    """What competes for a landmark, and where landmarks are looked for."""

    competing: float = gate(0.26, "rad", "between planes that compete for a landmark", SURVEYED)
    line_margin: float = gate(0.02, "1", "of the length of a line, that points on it may be beyond", SURVEYED)
    neighbor: int = gate(8, "neighbours", "at whose distance a landmark has its surroundings", SURVEYED)
    layer: float = gate(3.0, "bands", "window around a plane, for the mixture", "derived from deviations to the band")
    widest: float = gate(0.33, "layers", "that members of a plane may deviate", "derived from normal noise: a third")
    num_nearest: int = gate(12, "samples", "of segments that a point is compared with", SEARCH)
    num_samples: tuple[int, int] = gate((50_000, 12), "samples", "of all segments, and of each", "cost: memory")


GATES = RelationGates()

#: What is near a plane, by all that it depends on: tables of points and of lines.
_Near = dict[tuple[bytes, bytes, float, bytes], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class Landmarks:
    """Points and segments with their noise; only the usable ones take part in relations."""

    points: FloatArray
    point_noise: PointNoise
    point_usable: BoolArray
    segments: FloatArray
    line_noise: LineNoise
    #: The noise of lines before that of surfaces was added.
    own_line_noise: LineNoise
    line_usable: BoolArray
    #: (P,) and (L, 2) distances at which points and segment ends have their neighbours.
    point_spacing: FloatArray
    end_spacing: FloatArray
    #: Where the segments are supported.
    intervals: LineIntervals
    #: (P,) and (L,) length that a pixel spans there, scene units.
    point_pixel: FloatArray
    line_pixel: FloatArray

    @cached_property
    def usable(self) -> tuple[tuple[IntArray, FloatArray], tuple[IntArray, FloatArray]]:
        """Numbers and places of the usable points, and of the usable segments."""
        points, lines = np.flatnonzero(self.point_usable), np.flatnonzero(self.line_usable)
        return (points, self.points[points]), (lines, self.segments[lines])


@dataclass(frozen=True, eq=False)
class Pairs(Rows):
    """Landmarks and the structures they belong to."""

    #: (M, 2) number of the landmark, number of the structure.
    pairs: IntArray = column(2, dtype=np.int64)
    #: (M,) probability that the landmark is no clutter.
    probability: FloatArray = column()
    #: (M,) deviation from the structure that is usual for such landmarks, pixels; 0 where their noise explains it.
    #: Of pairs of planes and directions: that of the angle, radians.
    deviation: FloatArray = column()

    def counts(self, num: int) -> IntArray:
        """(num,) landmarks of each structure."""
        return np.bincount(self.pairs[:, 1], minlength=num)

    def renumbered(self, new: IntArray) -> Pairs:
        """Return the pairs with other numbers of structures, without those whose new number is -1."""
        structure = new[self.pairs[:, 1]]
        pairs = np.column_stack([self.pairs[:, 0], structure])
        return Pairs(pairs, self.probability, self.deviation).take(structure >= 0)


def samples_of(segments: FloatArray, count: IntArray) -> tuple[FloatArray, IntArray]:
    """Places (N, 3) on segments from end to end, so many on each (L,), and the segment of each."""
    owner, number = numbered(count)
    share = number / (count[owner] - 1)
    return segments[owner, 0] + share[:, None] * (segments[owner, 1] - segments[owner, 0]), owner


def spacings(points: FloatArray, segments: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances (P,), (L, 2) from points and segment ends to their neighbours among both."""
    places = np.concatenate([points, segments.reshape(-1, 3)])
    if len(places) < 2:
        return np.ones(len(points)), np.ones((len(segments), 2))
    distance, _ = nearest(kd_tree(places), places, min(GATES.neighbor + 1, len(places)))
    return distance[: len(points), -1], distance[len(points) :, -1].reshape(-1, 2)


def on_planes(
    marks: Landmarks, found: PlaneSet, level: float, least: tuple[float, float], known: _Near | None = None
) -> tuple[Pairs, Pairs]:
    """Points on planes and lines on planes; their probabilities have to exceed the least of their kind.

    What is near planes is kept in ``known``, for the next time.

    Walls are rough: how far what belongs to a plane deviates from it is estimated with the share of what belongs there.
    What stands out on the plane itself, within its own noise, is still held to it as such.
    """
    num = len(found)
    if num == 0:
        return Pairs.empty(), Pairs.empty()
    near = partial(_near_plane, marks, found, GATES.layer, {} if known is None else known)
    parts = list(zip(*map_in_threads(near, range(num)), strict=True))
    points, lines = np.concatenate(parts[0]), np.concatenate(parts[1])
    table = np.concatenate([points, lines])
    mark, owner = table[:, 0].astype(np.int64), table[:, 1].astype(np.int64)
    is_line = np.arange(len(table)) >= len(points)
    of_point = ~is_line
    pixel = np.concatenate([marks.point_pixel[mark[of_point]], marks.line_pixel[mark[is_line]]])
    label = _label(found.point_label, marks.point_usable), _label(found.segment_label, marks.line_usable)
    label = np.concatenate(label)[mark + len(marks.points) * is_line]
    half = GATES.layer * found.band
    typical = np.array([np.median(pixel[owner == k]) if (owner == k).any() else 1.0 for k in range(num)])
    told = memberships(
        Candidates(
            owner=owner,
            offset=table[:, 2:3],
            variance=table[:, 3:4] ** 2,
            unit=pixel,
            clutter=0.5 / half[owner],
            counted=(label < 0) | (label == owner),
            group=owner + num * is_line,
        ),
        GATES.widest * half / typical,
    )
    competing = np.arccos(np.clip(np.abs(found.planes[:, :3] @ found.planes[:, :3].T), 0.0, 1.0)) < GATES.competing

    def related(rows: BoolArray, enough: float) -> Pairs:
        deviation = told.deviation[owner[rows]]
        inner = _on_plane_itself(table[rows], found.band, level, enough)
        passed = _within(table[rows], deviation * pixel[rows], level) & (told.probability[rows] > enough)
        probability = np.where(inner > 0.0, np.maximum(inner, told.probability[rows]), told.probability[rows])
        pairs = np.column_stack([mark, owner])[rows]
        chosen = Pairs(pairs, probability, np.where(inner > 0.0, 0.0, deviation))
        likely = np.flatnonzero(passed | (inner > 0.0))
        likely = likely[_best_of_competing(chosen.take(likely), competing, num)]
        if rows is is_line:
            return chosen.take(likely)
        return _on_one_face(chosen.take(likely), table[rows][likely], pixel[rows][likely], enough)

    points_on, lines_on = together(partial(related, of_point, least[0]), partial(related, is_line, least[1]))
    return points_on, lines_on


def _on_one_face(found: Pairs, table: FloatArray, pixel: FloatArray, least: float) -> Pairs:
    """The pairs that are sure, too, if a point is on one face alone; beside an edge both have as many points."""
    mark, variance = found.pairs[:, 0], table[:, 3] ** 2 + (found.deviation * pixel) ** 2
    density = np.exp(-0.5 * table[:, 2] ** 2 / variance) / np.sqrt(variance)
    own = density / np.maximum(np.bincount(mark, density), np.finfo(float).tiny)[mark]
    return Pairs(found.pairs, found.probability * own, found.deviation).take(found.probability * own > least)


def _on_plane_itself(table: FloatArray, band: FloatArray, level: float, least: float) -> FloatArray:
    """Probability of what lies on a plane within its own noise, against all that is in its band; 0 for the others."""
    owner, height = table[:, 1].astype(np.int64), np.abs(table[:, 2])
    near, result = np.flatnonzero(height < band[owner]), np.zeros(len(table))
    probability, _ = inlier_probability(height[near], table[near, 3], owner[near], band)
    passed = _within(table[near], 0.0, level) & (probability > least)
    result[near[passed]] = probability[passed]
    return result


def _within(table: FloatArray, away: FloatArray | float, level: float) -> BoolArray:
    """Whether heights pass the chi-square test, members deviating by a length ``away``, and lines are not turned.

    Heights tell what lies on a plane. Tilts only tell lines that cross it, by more than the band: those of members have
    heavier tails than the noise of their ends.
    """
    square = np.square(away)
    passed = table[:, 2] ** 2 / (table[:, 3] ** 2 + square) < chi_square_gate(1.0 - level, 1)
    return np.asarray(passed & (table[:, 4] ** 2 / (table[:, 5] + 2.0 * square) < BAND**2))


def _label(of_usable: IntArray, usable: BoolArray) -> IntArray:
    """Labels of all landmarks from those of the usable ones, -1 for the others."""
    label = np.full(len(usable), -1)
    label[usable] = of_usable
    return label


def _near_plane(marks: Landmarks, found: PlaneSet, layer: float, known: _Near, k: int) -> tuple[FloatArray, FloatArray]:
    """Points and lines in the layer of a plane, where it is connected.

    Tables of landmark, plane, height and its deviation, difference of the heights of both ends and its variance.
    """
    same = found.planes[k].tobytes(), found.covariance[k].tobytes(), float(found.band[k]), found.places[k].tobytes()
    if same not in known:
        half = layer * found.band[k]
        known[same] = _in_layer(marks, found.planes[k], found.covariance[k], half, found.places[k])
    points, lines = known[same]
    return np.insert(points, 1, k, axis=1), np.insert(lines, 1, k, axis=1)


def _in_layer(
    marks: Landmarks, plane: FloatArray, covariance: FloatArray, half: float, places: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The tables of :func:`_near_plane` without the number of the plane."""
    (usable, at), (usable_lines, ends) = marks.usable
    near = np.abs(at @ plane[:3] + plane[3]) < half
    rows, at = usable[near], at[near]
    near = (np.abs(ends @ plane[:3] + plane[3]) < half).all(axis=1)
    lines, ends = usable_lines[near], ends[near]
    spacing = np.concatenate([marks.point_spacing[rows], marks.end_spacing[lines].ravel()])
    near = connected_to(places, np.concatenate([at, ends.reshape(-1, 3)]), spacing, plane)
    lines, rows = lines[near[len(rows) :].reshape(-1, 2).any(axis=1)], rows[near[: len(rows)]]
    height, variance = _point_heights(marks, rows, plane, covariance)
    unused = np.zeros(len(rows)), np.ones(len(rows))
    points = np.column_stack([rows.astype(np.float64), height, np.sqrt(variance), *unused])
    return points, np.column_stack([lines.astype(np.float64), *_line_heights(marks, lines, plane, covariance)])


def on_lines(marks: Landmarks, level: float, least: float) -> Pairs:
    """Points on lines: where images support them, not in gaps nor beyond their ends."""
    rows = np.flatnonzero(marks.line_usable)
    tested = np.flatnonzero(marks.point_usable)
    if len(rows) == 0 or len(tested) == 0:
        return Pairs.empty()
    pairs = _near_segments(marks.points[tested], marks.segments[rows])
    point, line = tested[pairs[:, 0]], rows[pairs[:, 1]]
    start, along = marks.segments[line, 0], marks.segments[line, 1] - marks.segments[line, 0]
    share = dot(marks.points[point] - start, along) / dot(along, along)
    offset = marks.points[point] - start - share[:, None] * along
    inside = marks.intervals.covers(line, share, GATES.line_margin)
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
    probability, _ = inlier_probability(distance[near], spread[near], line, band, MEMBERSHIPS.pooled)
    passed = (squared < largest) & (probability > least)
    return Pairs(np.column_stack([point, line]), probability, np.zeros(len(point))).take(passed)


# --------------------------------------------------------------------------------------------------------- Distances
def _point_heights(
    marks: Landmarks, rows: IntArray, plane: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    height = marks.points[rows] @ plane[:3] + plane[3]
    lever = np.column_stack([marks.points[rows], np.ones(len(rows))])
    variance = np.einsum("i,nij,j->n", plane[:3], marks.point_noise.covariance[rows], plane[:3])
    return height, np.maximum(variance + np.einsum("ni,ij,nj->n", lever, covariance, lever), 1e-300)


def _line_heights(
    marks: Landmarks, rows: IntArray, plane: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Height of the segment where it is known best and its deviation; the difference of both ends and its variance.

    Clutter beside a plane is often parallel to it (mouldings, frames): the height of a segment tells it from what lies
    on the plane, and its tilt does not.
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
    weight = np.linalg.solve(noise, np.ones((len(rows), 2, 1)))[..., 0]
    information, turned = weight.sum(axis=1), noise[:, 0, 0] + noise[:, 1, 1] - 2.0 * noise[:, 0, 1]
    return (weight * height).sum(axis=1) / information, 1.0 / np.sqrt(information), height[:, 1] - height[:, 0], turned


def _near_segments(points: FloatArray, segments: FloatArray) -> IntArray:
    """Pairs (point, segment) of segments near points, found by samples along the segments."""
    length = norm(segments[:, 1] - segments[:, 0])
    number = max(GATES.num_samples[0], GATES.num_samples[1] * len(segments))
    count = np.clip(np.ceil(number * length / max(length.sum(), 1e-300)), 3, 512).astype(np.int64)
    samples, owner = samples_of(segments, count)
    number = min(GATES.num_nearest, len(samples))
    _, index = nearest(kd_tree(samples), points, number)
    return distinct_pairs(np.repeat(np.arange(len(points)), number), owner[index].ravel())[0]


def _best_of_competing(found: Pairs, competing: BoolArray, num: int) -> BoolArray:
    """Which pairs (M,) are the likeliest where a landmark is claimed by structures of which only one can be right."""
    pairs = found.pairs
    if len(pairs) == 0:
        return np.zeros(0, bool)
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
    return kept
