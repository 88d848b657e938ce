# SPDX-License-Identifier: BSD-3-Clause
"""Find the pose of a frame without a good prediction: by described features, then by points, lines and planes.

Used when following fails between two frames, and to find the place again after the track was lost. Each keyframe
proposes a pose (perspective from points, with RANSAC); the proposals, and the prediction, are then judged together by
all that agrees with them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.geometry import quaternion
from groma.tracking.camera import TrackCamera, back, into
from groma.tracking.features import Features, FrameFeatures
from groma.tracking.landmarks import ALIVE
from groma.tracking.lines import FollowedSegments, assign, expected_segments
from groma.tracking.motion import PoseEstimate, estimate_pose
from groma.tracking.observations import LineMeasurements, Measurements, PlaneMeasurements, PointMeasurements
from groma.tracking.planes import assign_planes
from groma.tracking.points import PointTracks
from groma.tracking.track_map import Keyframe, TrackMap

#: A feature agrees with a pose within this distance, pixels (features of coarse scales are not precise).
NEAR = 6.0
#: Hamming distance beyond which descriptors do not match.
FARTHEST = 64
#: Agreements that a line and a plane count for, in points.
LINE_WEIGHT, PLANE_WEIGHT = 2.0, 6.0


@dataclass(frozen=True)
class FeatureMatches:
    """Features of a keyframe, with places in the world, matched to features of a frame."""

    keyframe: Keyframe
    #: (n,) rows of the keyframe's features, and of the frame's.
    first: IntArray
    second: IntArray
    #: (n, 3) places in the world.
    places: FloatArray


def match_features(first: Features, second: Features) -> tuple[IntArray, IntArray]:
    """Pair features whose descriptors are nearest to each other, both ways."""
    if not len(first.pixel) or not len(second.pixel):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(first.descriptor, second.descriptor)
    pairs = [pair for pair in pairs if pair.distance <= FARTHEST]
    return np.array([p.queryIdx for p in pairs], np.int64), np.array([p.trainIdx for p in pairs], np.int64)


def match_keyframe(track_map: TrackMap, camera: TrackCamera, keyframe: Keyframe, features: Features) -> FeatureMatches:
    """Match a frame's features to those of a keyframe whose place is known."""
    first, second = match_features(keyframe.features, features)
    places = feature_places(track_map, camera, keyframe, first)
    known = np.isfinite(places[:, 0])
    return FeatureMatches(keyframe, first[known], second[known], places[known])


def feature_places(track_map: TrackMap, camera: TrackCamera, keyframe: Keyframe, rows: IntArray) -> FloatArray:
    """Places (n, 3) in the world of a keyframe's features: of the map's point there, else by depth; NaN if unknown."""
    features, points = keyframe.features, track_map.points
    point = features.point[rows]
    mapped = point >= 0
    mapped[mapped] = points.state[point[mapped]] == ALIVE
    places = back(keyframe.pose, camera.bearings(features.pixel[rows]) * features.depth[rows, None])
    places[mapped] = points.xyz[point[mapped]]
    return places


def pose_from_matches(
    camera: TrackCamera, places: FloatArray, pixel: FloatArray, min_inliers: int = 10, error: float = 4.0
) -> tuple[FloatArray, BoolArray] | None:
    """Pose (7,) from places in the world and their pixels, by P3P with RANSAC, and which agree; None without one."""
    if len(places) < max(min_inliers, 6):
        return None
    found, turn, shift, inliers = cv2.solvePnPRansac(
        np.ascontiguousarray(places), np.ascontiguousarray(pixel - 0.5), camera.matrix_opencv, np.zeros(0),
        iterationsCount=300, reprojectionError=error, confidence=0.999, flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not found or inliers is None or len(inliers) < min_inliers or not np.isfinite(shift).all():
        return None
    turned = quaternion.from_matrix(np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64))
    pose = np.concatenate([turned, np.asarray(shift, dtype=np.float64).ravel()])
    agree = np.zeros(len(places), dtype=bool)
    agree[np.asarray(inliers, dtype=np.int64).ravel()] = True
    return pose, agree


@dataclass(frozen=True)
class Found:
    """A pose, what agrees with it, and what can be followed from there."""

    estimate: PoseEstimate
    points: PointTracks
    lines: FollowedSegments
    score: float


def find_pose(
    track_map: TrackMap,
    camera: TrackCamera,
    data: FrameFeatures,
    keyframes: list[Keyframe],
    guesses: list[FloatArray],
    predicted: FloatArray,
    prior_sigma: FloatArray,
) -> Found | None:
    """Find the pose of a frame near some keyframes; ``guesses`` are poses to be tried as well."""
    matches = [match_keyframe(track_map, camera, keyframe, data.features) for keyframe in keyframes]
    starts = list(guesses)
    for match in matches:
        proposal = pose_from_matches(camera, match.places, data.features.pixel[match.second])
        if proposal is not None:
            starts.append(proposal[0])
    if not starts:
        return None
    judged = []
    for start in starts:
        agreeing = sum(int(_agreeing(camera, match, data.features, start, 3 * NEAR).sum()) for match in matches)
        planes = len(assign_planes(track_map.planes, data.planes, start, 0.15, 0.12)[0]) if data.planes else 0
        judged.append(agreeing + PLANE_WEIGHT * planes)
    best: Found | None = None
    order = np.argsort(-np.array(judged), kind="stable")
    for k in order[:4]:
        found = _refine(track_map, camera, data, matches, starts[k], predicted, prior_sigma)
        if found is not None and (best is None or found.score > best.score):
            best = found
    return best


def _refine(track_map, camera, data, matches, start, predicted, prior_sigma) -> Found | None:
    """Estimate the pose from all that agrees with a start, with narrowing gates."""
    pose, estimate, lines = start, None, FollowedSegments.empty()
    pairs = np.zeros((0, 2), np.int64)
    for gate in (3.0, 1.0):
        pairs = _pairs(camera, matches, data.features, pose, gate * NEAR)
        # Features that are no point of the map yet become one when the frame becomes a keyframe: here by place alone.
        temporary, table = _temporary_points(track_map, matches, pairs, data)
        lines, line_table = match_lines(track_map, camera, data, pose, 8.0 * gate, 0.08 + 0.06 * gate)
        planes = match_planes(track_map, data, pose, 0.1 + 0.06 * gate, 0.06 + 0.04 * gate)
        if len(pairs) + len(line_table) + len(planes) < 3:
            return None
        view = replace(track_map.view, points=temporary)
        estimate = estimate_pose(camera, view, Measurements(table, line_table, planes), predicted, prior_sigma, pose)
        pose = estimate.pose
    assert estimate is not None
    good = estimate.points
    if data.options.points:
        promoted = _promote(track_map, camera, matches, pairs[good], data)
    else:
        promoted = PointTracks.empty()
    lines = lines.take(estimate.lines)
    counts = estimate.counts
    score = counts["points"] + LINE_WEIGHT * counts["lines"] + PLANE_WEIGHT * counts["planes"]
    return Found(estimate, promoted, lines, score)


def _agreeing(
    camera: TrackCamera, match: FeatureMatches, features: Features, pose: FloatArray, gate: float
) -> BoolArray:
    with np.errstate(invalid="ignore"):
        away = np.linalg.norm(camera.project(into(pose, match.places)) - features.pixel[match.second], axis=1)
        return away < gate


def _pairs(camera, matches, features, pose, gate) -> IntArray:
    """Rows (n, 2): which match, which of its pairs; each feature of the frame once, newest keyframes first."""
    taken = np.zeros(len(features.pixel), dtype=bool)
    out = []
    for k, match in enumerate(matches):
        rows = np.flatnonzero(_agreeing(camera, match, features, pose, gate) & ~taken[match.second])
        taken[match.second[rows]] = True
        out.append(np.column_stack([np.full(len(rows), k), rows]))
    return np.concatenate(out) if out else np.zeros((0, 2), np.int64)


class _Places:
    """Just the places of points, where an estimate wants a table of them."""

    def __init__(self, xyz: FloatArray) -> None:
        self.xyz = xyz


def _temporary_points(track_map, matches, pairs, data):
    xyz = np.array([matches[k].places[row] for k, row in pairs]).reshape(-1, 3)
    rows = np.array([matches[k].second[row] for k, row in pairs], np.int64)
    features = data.features
    count = len(rows)
    depth = features.depth[rows]
    unknown = np.full(count, np.nan)
    sigma = np.full(count, 1.5 * data.options.point_sigma_px)
    depth_sigma = 1.5 * data.depth_sigma(depth)
    if not data.options.points:
        count, rows = 0, rows[:0]
    table = PointMeasurements(np.arange(count), features.pixel[rows], sigma, depth, depth_sigma, unknown)
    return _Places(xyz), table.take(np.arange(count))


def _promote(track_map: TrackMap, camera: TrackCamera, matches, pairs: IntArray, data: FrameFeatures) -> PointTracks:
    """Make points of the map of features that agree, where they are none yet; return them as followed points."""
    points, features = track_map.points, data.features
    tracks = PointTracks.empty()
    for k, match in enumerate(matches):
        rows = pairs[pairs[:, 0] == k, 1]
        if not len(rows):
            continue
        keyframe, own, here = match.keyframe, match.first[rows], match.second[rows]
        index = keyframe.features.point[own]
        usable = index >= 0
        usable[usable] = points.state[index[usable]] == ALIVE
        fresh = np.flatnonzero(~usable & np.isfinite(keyframe.features.depth[own]))
        if len(fresh):
            new = points.extend(len(fresh))
            pixel, depth = keyframe.features.pixel[own[fresh]], keyframe.features.depth[own[fresh]]
            points.xyz[new], points.state[new] = match.places[rows[fresh]], ALIVE
            points.keyframe[new] = points.first_keyframe[new] = keyframe.index
            points.pixel[new] = points.first_pixel[new] = pixel
            keyframe.features.point[own[fresh]] = new
            index[fresh], usable[fresh] = new, True
            sigma = np.full(len(new), 1.5 * data.options.point_sigma_px)
            unknown = np.full(len(new), np.nan)
            table = PointMeasurements(new, pixel, sigma, depth, data.depth_sigma(depth), unknown)
            joined = PointMeasurements.stack([keyframe.measured.points, table])
            keyframe.measured = replace(keyframe.measured, points=joined)
        rows = np.flatnonzero(usable)
        features.point[here[rows]] = index[rows]
        tracks = tracks.joined(PointTracks(index[rows], features.pixel[here[rows]]))
    first = np.unique(tracks.index, return_index=True)[1]
    return tracks.take(first)


def match_lines(
    track_map: TrackMap, camera: TrackCamera, data: FrameFeatures, pose: FloatArray, distance: float, angle: float
) -> tuple[FollowedSegments, LineMeasurements]:
    """Assign detected segments to lines of the map by where a pose says they are, and how deep."""
    if not data.options.lines:
        return FollowedSegments.empty(), LineMeasurements.empty()
    lines, detected = track_map.lines, data.detected
    alive = np.flatnonzero(lines.alive)
    expected, seen = expected_segments(camera, lines, alive, pose)
    alive, expected = alive[seen], expected[seen]
    inverse = 1.0 / np.maximum(into(pose, lines.segment[alive].mean(axis=1))[:, 2], 1e-6)
    segments = detected.segments
    rows, hits = assign(expected, segments.ends, distance, angle, inverse, detected.inverse_depth.mean(axis=1))
    sigma = np.maximum(segments.sigma[hits], 0.5)
    followed = FollowedSegments(alive[rows], segments.ends[hits], sigma, segments.strength[hits])
    table = LineMeasurements(
        alive[rows], segments.ends[hits], sigma, detected.inverse_depth[hits], detected.inverse_depth_sigma[hits]
    )
    return followed, table


def match_planes(
    track_map: TrackMap, data: FrameFeatures, pose: FloatArray, angle: float, distance: float
) -> PlaneMeasurements:
    """Assign planes of a frame to planes of the map."""
    if data.planes is None:
        return PlaneMeasurements.empty()
    index, rows = assign_planes(track_map.planes, data.planes, pose, angle, distance)
    return PlaneMeasurements(index, data.planes.plane[rows], data.planes.sqrt_information[rows])


#: Widest gates of planes between two frames: angle, and distance of the seen part (scene units).
FRAME_GATES = (math.radians(12.0), 0.12)

__all__ = [
    "FRAME_GATES",
    "FeatureMatches",
    "Found",
    "feature_places",
    "find_pose",
    "match_features",
    "match_keyframe",
    "match_lines",
    "match_planes",
    "pose_from_matches",
]
