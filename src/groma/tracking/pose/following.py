# SPDX-License-Identifier: BSD-3-Clause
"""One frame after another: follow points and lines, assign planes, estimate the pose from all of them."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from groma._stopwatch import Stopwatch
from groma._typing import FloatArray
from groma.features.point_tracks import POINT_TRACKS, follow
from groma.tracking.beside import beside
from groma.tracking.frame.camera import TrackCamera, into
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.frame.measurements import LineMeasurements, Measurements, PlaneMeasurements, PointMeasurements
from groma.tracking.map.keyframes import Followed, keyframe_nearby, measure_points
from groma.tracking.map.landmarks import DEAD
from groma.tracking.map.lines import FollowedSegments, carried, coarse_flow, expected_segments, measured_edges
from groma.tracking.map.points import PointTracks, find_again, follow_points
from groma.tracking.map.track_map import TrackMap
from groma.tracking.pose.estimate import PoseEstimate, estimate_pose
from groma.tracking.pose.relocalise import match_planes
from groma.tracking.pose.verification import misses_much


@dataclass(frozen=True)
class Attempt:
    """What following a frame gave: a pose, or one that is in doubt."""

    predicted: FloatArray
    prior_sigma: FloatArray
    estimate: PoseEstimate | None = None
    unconfirmed: PoseEstimate | None = None
    #: Whether enough agrees with the pose.
    trusted: bool = False
    followed: Followed = field(default_factory=Followed.nothing)


def follow_frame(
    track_map: TrackMap,
    before: FrameFeatures,
    data: FrameFeatures,
    followed: Followed,
    previous: FloatArray,
    expected: tuple[FloatArray, FloatArray],
    watch: Stopwatch,
    pool: Executor | None = None,
    searched: bool = False,
) -> tuple[PoseEstimate | None, Followed]:
    """Return the pose of a frame that follows another, and what is still followed.

    ``expected`` is the predicted pose with its standard deviations (6,). Lines and planes are found beside points in a
    pool. Where so many points are gone that features will be asked anyway, lines are not followed, unless few are left:
    without lines their pose is a poor guess. If the frame before was ``searched``, lines do not begin before points,
    and a part of the points is followed first: where most of it is gone, it does for a guess.
    """
    camera, options, gates = data.camera, data.options, data.options.gates
    predicted, prior_sigma = expected
    tracks, segments = followed.points, followed.lines
    with_lines = options.lines and len(segments.index) > 0
    at_once = pool if with_lines and not searched else None
    lines_followed = beside(at_once, partial(follow_lines, track_map, before, data, segments))
    planes_found = beside(pool if data.frame.depth is not None else None, lambda: data.planes)
    with watch("points"):
        tracks = tracks.take(track_map.points.state[tracks.index] != DEAD)
        if options.points:
            images = before.gray, data.gray, predicted, previous, POINT_TRACKS.max_shift
            part = tracks.take(np.arange(0, len(tracks), gates.points.first_of if searched else 1))
            left = follow_points(track_map, camera, part, *images)
            count = int(track_map.points.alive[left.index].sum())
            if searched and not misses_much(track_map, camera, part, predicted, count, gates):
                left = follow_points(track_map, camera, tracks, *images)
            tracks = left
    alive = track_map.points.alive[tracks.index]
    with watch("depth"):
        measured = measure_points(track_map, data, predicted, tracks.take(alive))
        if not options.points:
            measured = PointMeasurements.empty()
    # Planes before lines: where the thread beside is still busy with lines, this one finds the planes meanwhile.
    with watch("planes"):
        planes = PlaneMeasurements.empty()
        if planes_found() is not None:
            planes = match_planes(track_map, data, predicted)
    with watch("lines"):
        lines = LineMeasurements.empty()
        few = len(measured) < gates.lines.few_points
        if (
            options.points
            and not few
            and misses_much(track_map, camera, followed.points, predicted, len(measured), gates)
        ):
            segments = FollowedSegments.empty()
        elif with_lines:
            segments = lines_followed()
            lines = measure_lines(track_map, data, segments, few_points=few)
    # derived from the numbers that each tells of a pose
    if len(measured) + 2 * len(lines) + 3 * len(planes) < gates.verification.min_followed:
        return None, Followed.nothing()
    with watch("pose"):
        estimate = estimate_pose(camera, track_map, Measurements(measured, lines, planes), predicted, prior_sigma)
    # Followed are points that agree, and points without a place; lines likewise.
    keep = np.ones(len(tracks), dtype=bool)
    keep[np.flatnonzero(alive)[~estimate.points]] = False
    segments = segments.take(~np.isin(segments.index, lines.index[~estimate.lines]))
    return estimate, Followed(tracks.take(keep), segments)


def find_points_again(track_map: TrackMap, data: FrameFeatures, pose: FloatArray, followed: Followed) -> Followed:
    """Look for points of the map that are in view but not followed, if there is room for many."""
    options, gates = data.options, data.options.gates.points
    room = options.num_points - len(followed.points)
    if not options.points or room < gates.again_room * options.num_points:
        return followed
    found = find_again(track_map, data.camera, data.gray, pose, followed.points, room, gates)
    return Followed(followed.points.joined(found), followed.lines)


def follow_nearby(track_map: TrackMap, data: FrameFeatures, pose: FloatArray, followed: Followed) -> Followed | None:
    """Follow an older keyframe that stands for a pose; None unless there is one, still seen well."""
    options = data.options
    keyframe = keyframe_nearby(track_map, pose, options)
    if keyframe is None:
        return None
    track_map.visit(keyframe)
    found = find_again(
        track_map, data.camera, data.gray, pose, followed.points, options.num_points, options.gates.points
    )
    points = followed.points.joined(found)
    seen = np.isin(keyframe.measured.points.index, points.index).sum()
    enough = seen >= options.keyframe_share * len(keyframe.measured.points)
    return Followed(points, followed.lines) if enough else None


def carry(
    track_map: TrackMap,
    camera: TrackCamera,
    before: FrameFeatures,
    data: FrameFeatures,
    new: Followed,
    followed: Followed,
    pose: FloatArray,
    pool: Executor | None = None,
) -> Followed:
    """Follow what a frame added to the map to a later frame, which was followed without it; return both together."""
    points, lines = new.points, new.lines
    lines = lines.take(~np.isin(lines.index, followed.lines.index))
    with_lines = len(lines.index) > 0
    lines_followed = beside(pool if with_lines else None, partial(follow_lines, track_map, before, data, lines))
    points = points.take(~np.isin(points.index, followed.points.index))
    place = into(pose, track_map.points.xyz[points.index])
    expected = camera.project(place)
    known = track_map.points.alive[points.index] & np.isfinite(expected).all(axis=1)
    shift = np.median((expected - points.pixel)[known], axis=0) if known.any() else np.zeros(2)
    guess = np.where(known[:, None], expected, points.pixel + shift)
    inside = np.flatnonzero(camera.inside(guess, 2.0))
    pixel, good = follow(before.gray, data.gray, points.pixel[inside], guess[inside], levels=2)
    points = PointTracks(points.index[inside[good]], pixel[good])
    return Followed(followed.points.joined(points), followed.lines.joined(lines_followed() if with_lines else lines))


def follow_lines(
    track_map: TrackMap, before: FrameFeatures, data: FrameFeatures, segments: FollowedSegments
) -> FollowedSegments:
    """Carry segments by flow and measure their edges in the new image."""
    gates = data.options.gates.lines
    flow = coarse_flow(before.gray, data.gray, gates.reduction)
    guess, agree = carried(flow, segments.ends, data.gray.shape, gates)
    agree &= track_map.lines.state[segments.index] != DEAD
    guess, good = _inside(guess, data.gray.shape, gates.min_length)
    rows = np.flatnonzero(agree & good)
    found, of = measured_edges(data.smooth, guess[rows], segments.strength[rows], gates)
    return FollowedSegments(segments.index[rows[of]], found.ends, found.sigma, found.strength)


def _inside(ends: FloatArray, shape: tuple[int, int], min_length: float) -> tuple[FloatArray, np.ndarray]:
    """Cut segments to the image; those that become too short are gone."""
    height, width = shape
    start, way = ends[:, :2], ends[:, 2:] - ends[:, :2]
    low, high = np.zeros(len(ends)), np.ones(len(ends))
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis, size in ((0, width), (1, height)):
            for side, sign in ((3.0, 1.0), (size - 3.0, -1.0)):
                share = sign * (side - start[:, axis]) / (sign * way[:, axis])
                low = np.where(sign * way[:, axis] > 0, np.maximum(low, share), low)
                high = np.where(sign * way[:, axis] < 0, np.minimum(high, share), high)
    cut = np.hstack([start + low[:, None] * way, start + high[:, None] * way])
    inside = ((cut[:, :2] >= 2) & (cut[:, :2] <= (width - 2, height - 2))).all(axis=1)
    good = inside & ((high - low) * np.linalg.norm(way, axis=1) > min_length)
    return np.where(good[:, None], cut, 10.0), good


def measure_lines(
    track_map: TrackMap, data: FrameFeatures, segments: FollowedSegments, few_points: bool
) -> LineMeasurements:
    """Return what a frame measures of followed lines whose place is known."""
    rows = np.flatnonzero(track_map.lines.alive[segments.index])
    ends = segments.ends[rows]
    inverse, sigma = np.full((len(rows), 2), np.nan), np.full((len(rows), 2), np.nan)
    if few_points:
        inverse, sigma = data.inverse_depths(ends)
    return LineMeasurements(
        segments.index[rows], ends, np.maximum(segments.sigma[rows], data.options.gates.lines.min_sigma), inverse, sigma
    )


def find_lines_again(track_map: TrackMap, data: FrameFeatures, pose: FloatArray, followed: Followed) -> Followed:
    """Look for lines of the map that are in view but not followed, where the pose says they are."""
    lines, gates, segments = track_map.lines, data.options.gates.lines, followed.lines
    room = data.options.num_lines - len(segments.index)
    if not data.options.lines or room <= 0:
        return followed
    wanted = lines.alive.copy()
    wanted[segments.index] = False
    rows = np.flatnonzero(wanted)[-gates.again_recent :]
    expected, seen = expected_segments(data.camera, lines, rows, pose, gates)
    rows, expected = rows[seen][-room:], expected[seen][-room:]
    if not len(rows):
        return followed
    found, of = measured_edges(data.smooth, expected, lines.strength[rows], gates)
    away = np.abs(found.ends - expected[of]).max(axis=1)
    good = away < gates.again_distance
    new = FollowedSegments(rows[of[good]], found.ends[good], found.sigma[good], found.strength[good])
    return Followed(followed.points, segments.joined(new))
