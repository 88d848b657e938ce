# SPDX-License-Identifier: BSD-3-Clause
"""Selection of keyframes, and the points, lines and planes that they add to the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.features.point_tracks import spread
from groma.features.segments import SEGMENTS
from groma.geometry import se3
from groma.scene.landmarks import Lines
from groma.tracking.frame.camera import TrackCamera, back, into
from groma.tracking.frame.features import Features, FrameFeatures
from groma.tracking.frame.measurements import LineMeasurements, Measurements, PlaneMeasurements, PointMeasurements
from groma.tracking.map.feature_points import linked_to_points, place_by_motion
from groma.tracking.map.landmarks import ALIVE, PENDING
from groma.tracking.map.lines import FollowedSegments, assign, expected_segments, line_ends
from groma.tracking.map.planes import add_planes, assign_planes, grow
from groma.tracking.map.points import PointTracks
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.map.triangulation import triangulate
from groma.tracking.options import TrackOptions


@dataclass(frozen=True)
class Followed:
    """What of the map is followed in a frame."""

    points: PointTracks
    lines: FollowedSegments

    @staticmethod
    def nothing() -> Followed:
        """Return nothing."""
        return Followed(PointTracks.empty(), FollowedSegments.empty())


def wants_keyframe(
    track_map: TrackMap, pose: FloatArray, followed: Followed, frames_since: int, options: TrackOptions
) -> bool:
    """Whether a tracked frame should become a keyframe."""
    gates, last = options.gates.keyframes, track_map.near
    now = len(followed.points)
    before = max(len(last.measured.points), 1)
    motion = se3.log(se3.compose(pose[None], se3.inverse(last.pose[None])))[0]
    depths = into(pose, track_map.points.xyz[followed.points.index[track_map.points.alive[followed.points.index]]])
    depth = float(np.median(depths[:, 2])) if len(depths) else 1.0
    shift, turn = float(np.linalg.norm(motion[:3])) / max(depth, 1e-6), float(np.linalg.norm(motion[3:]))
    if shift > options.keyframe_motion or turn > options.keyframe_turn:
        return True
    if frames_since >= 2 and now < options.keyframe_share * before:
        return True
    moved = shift > gates.moved * options.keyframe_motion or turn > gates.moved * options.keyframe_turn
    return moved and frames_since >= gates.max_frames


def keyframe_nearby(track_map: TrackMap, pose: FloatArray, options: TrackOptions) -> Keyframe | None:
    """Return the active keyframe with the most similar pose, if it is near enough."""
    living = [keyframe for keyframe in track_map.living() if keyframe.gray is not None]
    poses = np.array([keyframe.pose for keyframe in living])
    motion = se3.log(se3.compose(np.tile(pose, (len(living), 1)), se3.inverse(poses)))
    depth = np.array([keyframe.depth for keyframe in living])
    shift = np.linalg.norm(motion[:, :3], axis=1) / depth / options.keyframe_motion
    turn = np.linalg.norm(motion[:, 3:], axis=1) / options.keyframe_turn
    far = np.maximum(shift, turn)
    far[[keyframe.index == track_map.reference for keyframe in living]] = np.inf
    best = int(far.argmin())
    return living[best] if far[best] < options.gates.keyframes.nearby else None


def add_keyframe(track_map: TrackMap, data: FrameFeatures, pose: FloatArray, followed: Followed) -> Followed:
    """Make a keyframe of a frame with a pose; return the features tracked from now on."""
    index = len(track_map.keyframes)
    tracks, features = _add_points(track_map, data, pose, followed.points, index)
    segments, lines = followed.lines, LineMeasurements.empty()
    if data.options.lines:
        segments, lines = _add_lines(track_map, data, pose, followed.lines, index)
    planes = _add_planes(track_map, data, pose) if data.planes is not None else PlaneMeasurements.empty()
    measured = Measurements(measure_points(track_map, data, pose, tracks), lines, planes)
    name, time = data.frame.name, data.frame.timestamp
    keyframe = Keyframe(index, time, name, pose.copy(), data.gray, measured, features, data.depth_grid)
    alive = measured.points.index[track_map.points.alive[measured.points.index]]
    if len(alive):
        keyframe.depth = max(float(np.median(into(pose, track_map.points.xyz[alive])[:, 2])), 1e-6)
    track_map.keyframes.append(keyframe)
    track_map.reference = index
    return Followed(tracks, segments)


def measure_points(
    track_map: TrackMap, data: FrameFeatures, pose: FloatArray, tracks: PointTracks
) -> PointMeasurements:
    """Return the measurements of tracked points: pixel, and depth or right column where known."""
    count, camera = len(tracks), data.camera
    unknown = np.full(count, np.nan)
    depth, right = unknown, np.full((count, 2), np.nan)
    if data.frame.depth is not None:
        depth = data.depths(tracks.pixel)
    elif data.frame.right is not None:
        z = np.where(track_map.points.alive[tracks.index], into(pose, track_map.points.xyz[tracks.index])[:, 2], np.nan)
        expected = tracks.pixel[:, 0] - camera.fx * camera.baseline / np.where(z > 0, z, np.nan)
        right = data.right_pixels(tracks.pixel, expected)
    sigma = np.full(count, data.options.point_sigma_px)
    return PointMeasurements(tracks.index, tracks.pixel, sigma, depth, data.depth_sigma(depth), right)


# ---------------------------------------------------------------------------------------------------------- points


def _add_points(
    track_map: TrackMap, data: FrameFeatures, pose: FloatArray, tracks: PointTracks, index: int
) -> tuple[PointTracks, Features]:
    """Triangulate pending points, start new ones, and link described features to points."""
    points, options, features = track_map.points, data.options, data.features
    gates = options.gates.points
    _place_pending(track_map, data, pose, tracks)
    if len(tracks):
        points.keyframe[tracks.index], points.pixel[tracks.index], points.misses[tracks.index] = index, tracks.pixel, 0
    if not options.points:
        return tracks, features
    # Described features near tracked points belong to them.
    features = linked_to_points(features, tracks, gates.same_feature)
    depthless = data.frame.depth is None and data.frame.right is None
    if depthless and track_map.keyframes and points.alive[tracks.index].sum() < gates.few * options.num_points:
        # After a wide step few points are tracked, but many features match.
        before = track_map.near
        placed, features = place_by_motion(track_map, data.camera, before, features, pose, tracks.index, options)
        tracks = tracks.joined(placed)
    return _new_points(track_map, data, pose, tracks, features, index)


def _new_points(
    track_map: TrackMap, data: FrameFeatures, pose: FloatArray, tracks: PointTracks, features: Features, index: int
) -> tuple[PointTracks, Features]:
    """Start points where none is tracked: at described features first, then at corners where there are none."""
    points, camera, shape, cell = track_map.points, data.camera, data.gray.shape, data.corner_cell
    room = max(data.options.num_points - len(tracks), 0)
    free = np.flatnonzero(features.point < 0)
    free = free[spread(features.pixel[free], features.response[free], tracks.pixel, shape, room, cell)]
    pixel = features.pixel[free]
    if room > len(free):
        found, taken = data.corners, np.concatenate([tracks.pixel, pixel])
        rank = -np.arange(len(found), dtype=float)
        pixel = np.concatenate([pixel, found[spread(found, rank, taken, shape, room - len(free), cell)]])
    inside = camera.inside(pixel, data.options.gates.points.border)
    rows = points.extend(int(inside.sum()))
    every = np.full(len(pixel), -1, dtype=np.int64)
    every[inside] = rows
    features, pixel = features.linked(free, every[: len(free)]), pixel[inside]
    points.keyframe[rows], points.pixel[rows] = index, pixel
    points.first_keyframe[rows], points.first_pixel[rows] = index, pixel
    _place_by_depth(track_map, data, pose, rows, pixel)
    return tracks.joined(PointTracks(rows, pixel)), features


def _place_by_depth(
    track_map: TrackMap, data: FrameFeatures, pose: FloatArray, index: IntArray, pixel: FloatArray
) -> BoolArray:
    """Place points where the frame has a depth; return which (n,)."""
    depth = data.depths(pixel)
    known = np.isfinite(depth)
    track_map.points.xyz[index[known]] = back(pose, data.camera.bearings(pixel[known]) * depth[known, None])
    track_map.points.state[index[known]] = ALIVE
    return known


def _place_pending(track_map: TrackMap, data: FrameFeatures, pose: FloatArray, tracks: PointTracks) -> None:
    """Initialise pending points by depth, or by triangulation with the keyframe that first saw them."""
    points = track_map.points
    pending = np.flatnonzero(points.state[tracks.index] == PENDING)
    if not len(pending):
        return
    index, pixel = tracks.index[pending], tracks.pixel[pending]
    known = _place_by_depth(track_map, data, pose, index, pixel)
    index, pixel = index[~known], pixel[~known]
    if len(index):
        first = _poses_of(track_map, points.first_keyframe[index])
        gates = data.options.gates.points
        places, good = triangulate(data.camera, first, points.first_pixel[index], pose, pixel, gates)
        points.xyz[index[good]] = places[good]
        points.state[index[good]] = ALIVE


def _poses_of(track_map: TrackMap, keyframes: IntArray) -> FloatArray:
    """Poses (n, 7) of keyframes."""
    unique, which = np.unique(keyframes, return_inverse=True)
    return np.array([track_map.pose_of(int(k)) for k in unique])[which]


# ----------------------------------------------------------------------------------------------------------- lines


def _add_lines(
    track_map: TrackMap, data: FrameFeatures, pose: FloatArray, followed: FollowedSegments, index: int
) -> tuple[FollowedSegments, LineMeasurements]:
    """Assign detected segments to tracked lines and to lines of the map, and start new lines with the rest."""
    lines, detected, gates = track_map.lines, data.detected, data.options.gates.lines
    segments = detected.segments
    of_segment = np.full(len(segments), -1)
    # Segments of tracked lines.
    rows, hits = assign(followed.ends, segments.ends, gates.distance, SEGMENTS.angle, gates=gates)
    of_segment[hits] = followed.index[rows]
    # Segments of other lines of the map.
    alive = np.flatnonzero(lines.alive)
    alive = alive[~np.isin(alive, of_segment)]
    expected, seen = expected_segments(data.camera, lines, alive, pose, gates)
    alive, expected = alive[seen], expected[seen]
    free = np.flatnonzero(of_segment < 0)
    middle = 1.0 / np.maximum(into(pose, lines.segment[alive].mean(axis=1))[:, 2], 1e-6)
    inverse = detected.inverse_depth.mean(axis=1)
    rows, hits = assign(expected, segments.ends[free], gates.distance, SEGMENTS.angle, middle, inverse[free], gates)
    of_segment[free[hits]] = alive[rows]
    # New lines: initialised by depth along the segment, else tracked until they can be triangulated.
    free = np.flatnonzero(of_segment < 0)[: max(data.options.num_lines - int((of_segment >= 0).sum()), 0)]
    new = lines.extend(len(free))
    of_segment[free] = new
    lines.strength[new] = segments.strength[free]
    lines.first_keyframe[new], lines.first_ends[new] = index, segments.ends[free]
    _place_from_depth(track_map, data, pose, new, free)
    rows = np.flatnonzero(of_segment >= 0)
    known = of_segment[rows]
    _place_pending_lines(track_map, data, pose, known, rows, index)
    lines.strength[known] = segments.strength[rows]
    _extend_lines(track_map, data, pose, known, rows)
    sigma = np.maximum(segments.sigma[rows], gates.min_sigma)
    table = LineMeasurements(
        known, segments.ends[rows], sigma, detected.inverse_depth[rows], detected.inverse_depth_sigma[rows]
    )
    # A line is tracked by its longest segment only.
    followed = FollowedSegments(known, segments.ends[rows], sigma, segments.strength[rows])
    first = np.unique(known, return_index=True)[1]
    return followed.take(first), table.take(first)


def _place_from_depth(
    track_map: TrackMap, data: FrameFeatures, pose: FloatArray, index: IntArray, rows: IntArray
) -> None:
    """Initialise lines ``index`` whose detected segment, one of ``rows``, has a sufficiently certain depth."""
    camera, detected, gates = data.camera, data.detected, data.options.gates.lines
    ends = detected.segments.ends[rows]
    inverse, sigma = detected.inverse_depth[rows], detected.inverse_depth_sigma[rows]
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = 1.0 / inverse
        noise = (sigma * depth**2).max(axis=1)
        in_cam = np.stack([camera.bearings(ends[:, :2]), camera.bearings(ends[:, 2:])], axis=1) * depth[..., None]
        length = np.linalg.norm(in_cam[:, 1] - in_cam[:, 0], axis=1)
        good = (depth > 0).all(axis=1) & (length > gates.min_length_share * depth.mean(axis=1))
        good &= noise < gates.max_angle * length
    _place(track_map, index[good], back(pose, in_cam[good]))


def _place(track_map: TrackMap, index: IntArray, segments: FloatArray) -> None:
    if len(index):
        table = Lines.through(segments)
        track_map.lines.plucker[index], track_map.lines.segment[index] = table.plucker, table.segments
        track_map.lines.state[index] = ALIVE


def _place_pending_lines(
    track_map: TrackMap, data: FrameFeatures, pose: FloatArray, known: IntArray, rows: IntArray, index: int
) -> None:
    """Initialise pending lines by depth, or by the planes through two camera centres and the segments.

    Line ``known[k]`` is seen as the detected segment ``rows[k]`` in keyframe ``index``.
    """
    lines, camera, gates = track_map.lines, data.camera, data.options.gates.lines
    pending = np.flatnonzero((lines.state[known] == PENDING) & (lines.first_keyframe[known] < index))
    if not len(pending):
        return
    _place_from_depth(track_map, data, pose, known[pending], rows[pending])
    pending = pending[lines.state[known[pending]] == PENDING]
    if not len(pending):
        return
    row, segment = known[pending], data.detected.segments.ends[rows[pending]]
    first = _poses_of(track_map, lines.first_keyframe[row])
    normal1, center1 = _ray_planes(camera, first, lines.first_ends[row])
    normal2, center2 = _ray_planes(camera, np.tile(pose, (len(row), 1)), segment)
    direction = np.cross(normal1, normal2)
    sine = np.linalg.norm(direction, axis=1)
    good = sine > gates.min_sine
    # Intersections of the rays of the current ends with the first plane.
    out = np.zeros((len(row), 2, 3))
    for k in (0, 1):
        ray = back(pose, camera.bearings(segment[:, 2 * k : 2 * k + 2])) - center2
        slope = (ray * normal1).sum(axis=1)
        share = ((center1 - center2) * normal1).sum(axis=1) / np.where(np.abs(slope) > 1e-9, slope, 1e-9)
        good &= share > 0
        out[:, k] = center2 + share[:, None] * ray
    depth = into(pose, out)[..., 2]
    length = np.linalg.norm(out[:, 1] - out[:, 0], axis=1)
    good &= depth.max(axis=1) < gates.max_depth_ratio * depth.min(axis=1)
    good &= length > gates.min_length_share * depth.mean(axis=1)
    _place(track_map, row[good], out[good])


def _ray_planes(camera: TrackCamera, poses: FloatArray, ends: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit normals (n, 3) in the world of the planes through camera centres and segments, and the centres."""
    world = se3.inverse(poses)
    center = world[:, 4:]
    one = se3.transform_points(world, camera.bearings(ends[:, :2])) - center
    two = se3.transform_points(world, camera.bearings(ends[:, 2:])) - center
    normal = np.cross(one, two)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12), center


def _extend_lines(
    track_map: TrackMap, data: FrameFeatures, pose: FloatArray, known: IntArray, segments: IntArray
) -> None:
    """Extend the lines ``known`` to the detected segments that show them."""
    lines = track_map.lines
    alive = np.flatnonzero(lines.alive[known])
    rows = known[alive]
    if not len(rows):
        return
    seen, good = line_ends(data.camera, pose, lines.plucker[rows], data.detected.segments.ends[segments[alive]])
    direction = lines.plucker[rows, 3:]
    foot = np.cross(direction, lines.plucker[rows, :3])
    along = np.einsum("lej,lj->le", np.concatenate([lines.segment[rows], seen], axis=1), direction)
    old = np.abs(along[:, 1] - along[:, 0])
    low, high = along.min(axis=1), along.max(axis=1)
    good &= (high - low) < data.options.gates.lines.max_extension * old + 1e-9
    segment = foot[:, None] + np.stack([low, high], axis=1)[..., None] * direction[:, None]
    forward = ((lines.segment[rows, 1] - lines.segment[rows, 0]) * direction).sum(axis=1) > 0
    segment = np.where(forward[:, None, None], segment, segment[:, ::-1])
    lines.segment[rows[good]] = segment[good]


# ---------------------------------------------------------------------------------------------------------- planes


def _add_planes(track_map: TrackMap, data: FrameFeatures, pose: FloatArray) -> PlaneMeasurements:
    """Assign planes of the frame to planes of the map, which are extended, and start new ones with the rest."""
    seen = data.planes
    assert seen is not None
    gates = data.options.gates.planes
    index, rows = assign_planes(track_map.planes, seen, pose, gates)
    for k, row in zip(index, rows, strict=True):
        grow(track_map.planes, int(k), back(pose, seen.places_of(row)), float(seen.support[row]), gates)
    rest = np.setdiff1d(np.arange(len(seen)), rows)
    # No new plane near an existing one that did not agree well enough.
    _, ambiguous = assign_planes(track_map.planes, seen, pose, gates, gates.wider)
    rest = np.setdiff1d(rest, ambiguous)
    index = np.concatenate([index, add_planes(track_map.planes, seen, rest, pose, gates)])
    rows = np.concatenate([rows, rest])
    return PlaneMeasurements(index, seen.plane[rows], seen.sqrt_information[rows])
