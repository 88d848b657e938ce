# SPDX-License-Identifier: BSD-3-Clause
"""A place that a single camera saw twice: the similarity between both copies of it in the map.

A keyframe that recognises a place gets a second pose, in terms of the landmarks that were mapped there first. That pose
has the scale of then; the scale of now follows from points of both copies that the keyframe sees at the same pixel:
their depths differ by it. Each ratio of depths is weighted by how well both are known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from groma._typing import FloatArray, IntArray
from groma.features.segments import SEGMENTS
from groma.gates import NORMAL, chi_square_gate
from groma.geometry import se3
from groma.localization.pose.matches import Matches
from groma.localization.pose.refinement import refine
from groma.mapping.noise.landmarks import point_noise
from groma.tracking.backend.loop_closure import agreeing_pose, join_lines
from groma.tracking.frame.camera import TrackCamera, into, rotation
from groma.tracking.frame.descriptor_pairs import PlacedFeatures
from groma.tracking.frame.measurements import PointMeasurements
from groma.tracking.gates import TrackingGates
from groma.tracking.map.landmarks import ALIVE
from groma.tracking.map.lines import assign, expected_segments
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.options import TrackOptions
from groma.tracking.pose.relocalise import KnownFeatures, known_features, match_near
from groma.tracking.pose.rivals import num_cells, stands_out
from groma.tracking.result import map_to_scene


@dataclass(frozen=True, eq=False)
class KnownMap:
    """A map with the uncertainty of its points."""

    track_map: TrackMap
    camera: TrackCamera

    @cached_property
    def is_metric(self) -> bool:
        """Whether its unit is a length that was measured."""
        return self.track_map.is_metric

    @cached_property
    def covariance(self) -> FloatArray:
        """(N, 3, 3) of each point, scene units, with keyframes held; infinite where it is not known."""
        scene = map_to_scene(self.track_map, self.camera, relations=False)
        covariance = np.full((len(self.track_map.points), 3, 3), np.inf)
        if scene.num_points:
            covariance[scene.points.ids - 1] = point_noise(scene).covariance
        return covariance

    def depths(self, pose: FloatArray, index: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the logarithms of the depths (n,) of points in a camera, and their variances; infinite if unknown."""
        z = into(pose, self.track_map.points.xyz[index])[:, 2]
        axis = rotation(pose)[2]
        variance = np.einsum("i,nij,j->n", axis, self.covariance[index], axis)
        good = (z > 0) & (variance > 0) & np.isfinite(variance)
        z = np.where(good, z, 1.0)
        return np.log(z), np.where(good, variance / z**2, np.inf)


@dataclass(frozen=True, eq=False)
class PlaceAgain:
    """Two keyframes that see the same place, and the similarity between their cameras."""

    keyframe: Keyframe
    newest: Keyframe
    #: (7,) pose of the newest by the landmarks of the older keyframe, and in their unit.
    pose: FloatArray
    #: (8,) keyframe_from_newest, and the covariance (7, 7) of its error (translation, rotation, logarithm of the scale)
    #: in the unit and the frame of the newest.
    keyframe_from_newest: FloatArray
    covariance: FloatArray
    #: Described features of the older keyframe and those near it that agree, and (n, 2) which is which of the newest.
    known: KnownFeatures
    pairs: IntArray
    #: (n, 2) lines of the older map, and lines that the newest keyframe measures at the same place.
    lines: IntArray

    def matches(self, k: int) -> tuple[IntArray, IntArray]:
        """Return the features that agree of the k-th keyframe of those known, and of the newest."""
        pairs = self.pairs[self.known.of[self.pairs[:, 0]] == k]
        return self.known.row[pairs[:, 0]], pairs[:, 1]

    def stands_out(self, camera: TrackCamera, gates: TrackingGates) -> bool:
        """Whether clearly more features agree with the place than with others beside it."""
        seen = self.newest.features
        features = PlacedFeatures.of(seen.pixel, seen.descriptor)

        def votes_at(pose: FloatArray) -> int:
            pairs = match_near(camera, self.known, features, pose, gates.finding.near, gates.features.max_bits_near)
            return num_cells(camera, seen.pixel[pairs[:, 1]])

        votes = num_cells(camera, seen.pixel[self.pairs[:, 1]])
        return stands_out(camera, self.pose, votes, votes_at, gates.finding.near)

    @property
    def log_scale(self) -> float:
        """Logarithm of how much longer lengths of the newest are in the unit of the older keyframe."""
        return math.log(self.keyframe_from_newest[7])


def measure_place(
    older: KnownMap,
    newer: KnownMap,
    keyframe: Keyframe,
    newest: Keyframe,
    matches: tuple[IntArray, IntArray],
    options: TrackOptions,
) -> PlaceAgain | None:
    """Return the place that two keyframes have in common, if their matched features agree on one.

    Enough features must agree on one pose, and enough depths on one scale.
    """
    camera, gates = older.camera, options.gates
    found = agreeing_pose(older.track_map, camera, keyframe, newest, *matches, gates)
    if found is None:
        return None
    near = _around(older.track_map, keyframe, newest, gates)
    known = known_features(older.track_map, camera, near)
    refined = _refined(older, known, newest, found[0], options)
    if refined is None:
        return None
    pose, own, pairs = refined
    scale = (0.0, 0.0) if older.is_metric and newer.is_metric else _scale(older, newer, near, newest, pose, gates)
    if scale is None:
        return None
    log_scale, variance = scale
    relative = se3.compose(keyframe.pose[None], se3.inverse(pose[None]))[0]
    covariance = np.zeros((7, 7))
    unit = np.exp([-log_scale] * 3 + [0.0] * 3)
    covariance[:6, :6] = unit[:, None] * own * unit
    covariance[6, 6] = variance
    similarity = np.append(relative, math.exp(log_scale))
    lines = _same_lines(older, newer, near, newest, pose, gates)
    return PlaceAgain(keyframe, newest, pose, similarity, covariance, known, pairs, lines)


def _refined(
    older: KnownMap, known: KnownFeatures, newest: Keyframe, pose: FloatArray, options: TrackOptions
) -> tuple[FloatArray, FloatArray, IntArray] | None:
    """Return the pose of the newest by all known features that agree near it, its covariance (6, 6), and their pairs.

    Features count by their own noise and by that of their points; None where few agree.
    """
    gates, query, features = options.gates, older.camera.query, newest.features
    point = np.array([known.keyframes[k].features.point[row] for k, row in zip(known.of, known.row, strict=True)])
    mapped = (point >= 0) & np.isfinite(older.covariance[point, 0, 0])
    placed = PlacedFeatures.of(features.pixel, features.descriptor)
    matches, found, pairs = Matches(), None, np.zeros((0, 2), np.int64)
    for factor in gates.finding.rounds:
        reach = factor * gates.finding.near
        pairs = match_near(older.camera, known, placed, pose, reach)
        pairs = pairs[mapped[pairs[:, 0]]]
        if len(pairs) < gates.loops.min_inliers:
            return None
        matches = Matches(
            features.pixel[pairs[:, 1]],
            known.places[pairs[:, 0]],
            point_sigma=options.point_sigma_px * features.scale[pairs[:, 1]],
            point_covariance=older.covariance[point[pairs[:, 0]]],
        )
        found = refine(query, matches, pose, (reach, reach))
        pose = found.pose
    if found is None or found.point_inliers.sum() < gates.loops.min_inliers:
        return None
    covariance = found.covariance(matches)
    return (pose, covariance, pairs[found.point_inliers]) if np.isfinite(covariance).all() else None


def join_place(track_map: TrackMap, place: PlaceAgain, options: TrackOptions) -> None:
    """Let the newest keyframe see the points that a place had before, and make one of lines that it has twice.

    Points at matched features stay apart: features match to a pixel or two, tracked points far better.
    """
    newest = place.newest
    join_lines(track_map, place.lines)
    for k, keyframe in enumerate(place.known.keyframes):
        first, second = place.matches(k)
        old = keyframe.features.point[first]
        rows = np.unique(old, return_index=True)[1]
        rows = rows[(track_map.points.state[old[rows]] == ALIVE) & ~np.isin(old[rows], newest.measured.points.index)]
        table = replace(_described(newest, second[rows], options), index=old[rows])
        points = PointMeasurements.stack([newest.measured.points, table])
        newest.measured = replace(newest.measured, points=points)
        free = rows[newest.features.point[second[rows]] < 0]
        newest.features = newest.features.linked(second[free], old[free])


def _described(keyframe: Keyframe, rows: IntArray, options: TrackOptions) -> PointMeasurements:
    """Return described features of a keyframe as measurements of the points 0, 1, ..."""
    count, features = len(rows), keyframe.features
    unknown = np.full(count, np.nan)
    sigma = options.point_sigma_px * features.scale[rows]
    return PointMeasurements(
        np.arange(count), features.pixel[rows], sigma, unknown, unknown, np.full((count, 2), np.nan)
    )


def _around(track_map: TrackMap, keyframe: Keyframe, newest: Keyframe, gates: TrackingGates) -> list[Keyframe]:
    """Return a keyframe and those of the same period that share most landmarks with it."""
    others = [
        one
        for one in track_map.living()
        if one is not keyframe and one is not newest and abs(one.index - keyframe.index) < gates.loops.gap
    ]
    shared = track_map.shared(keyframe, others)
    best = np.argsort(-shared, kind="stable")[: gates.verification.nearest]
    return [keyframe, *(others[k] for k in best if shared[k] >= gates.loops.shared)]


def _same_lines(
    older: KnownMap, newer: KnownMap, near: list[Keyframe], newest: Keyframe, pose: FloatArray, gates: TrackingGates
) -> IntArray:
    """Return lines (n, 2) of the older map that appear where the newest keyframe measures lines of the newer one."""
    table, seen = older.track_map.lines, newest.measured.lines
    old = np.unique(np.concatenate([keyframe.measured.lines.index for keyframe in near]))
    old = old[table.state[old] == ALIVE]
    if older.track_map is newer.track_map:
        old = old[~np.isin(old, seen.index)]
    rows = np.flatnonzero(newer.track_map.lines.state[seen.index] == ALIVE)
    expected, visible = expected_segments(older.camera, table, old, pose, gates.lines)
    first, second = assign(expected[visible], seen.ends[rows], gates.lines.distance, SEGMENTS.angle, gates=gates.lines)
    return np.column_stack([old[visible][first], seen.index[rows[second]]])


def _scale(
    older: KnownMap, newer: KnownMap, near: list[Keyframe], newest: Keyframe, pose: FloatArray, gates: TrackingGates
) -> tuple[float, float] | None:
    """Return the logarithm of the scale of older lengths in terms of newer ones, and its variance."""
    seen = newest.measured.points
    old = np.unique(np.concatenate([keyframe.measured.points.index for keyframe in near]))
    points = older.track_map.points
    old = old[points.state[old] == ALIVE]
    if older.track_map is newer.track_map:
        old = old[~np.isin(old, seen.index)]
    rows = np.flatnonzero(newer.track_map.points.state[seen.index] == ALIVE)
    if not len(old) or not len(rows):
        return None
    pixel = older.camera.project(into(pose, points.xyz[old]))
    old, pixel = old[np.isfinite(pixel[:, 0])], pixel[np.isfinite(pixel[:, 0])]
    if not len(old):
        return None
    distance, which = KDTree(seen.pixel[rows]).query(pixel, distance_upper_bound=gates.points.same_feature)
    good = np.flatnonzero(np.isfinite(distance))
    first = older.depths(pose, old[good])
    second = newer.depths(newest.pose, seen.index[rows[np.asarray(which)[good]]])
    ratio, variance = first[0] - second[0], first[1] + second[1]
    ratio, variance = ratio[np.isfinite(variance)], variance[np.isfinite(variance)]
    return _common(ratio, variance, gates.finding.min_inliers, gates.loops.shift_sigma)


def _common(values: FloatArray, variance: FloatArray, least: int, floor: float) -> tuple[float, float] | None:
    """Return the mean of the values that agree and its variance; None where fewer than half, or too few, agree.

    Surfaces at the same pixel may be different ones, so the median decides what belongs together.
    """
    if len(values) < least:
        return None
    variance = variance + floor**2
    middle, weight = float(np.median(values)), 1.0 / variance
    for _ in range(5):
        agree = (values - middle) ** 2 < chi_square_gate(NORMAL.false_alarm, 1) * variance
        if agree.sum() < max(least, 0.5 * len(values)):
            return None
        weight = agree / variance
        middle = float((weight * values).sum() / weight.sum())
    return middle, float(1.0 / weight.sum())
