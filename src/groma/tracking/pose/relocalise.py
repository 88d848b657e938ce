# SPDX-License-Identifier: BSD-3-Clause
"""Find the pose of a frame without a good prediction: by described features, then by points, lines and planes.

Used when following fails between two frames, and to find the place again after the track was lost. Where a guess of
the pose exists, features are matched near where it says they are; otherwise each keyframe proposes a pose from all
matches, as a photograph is localised. Where that is not enough, planes of depth images propose poses. Guesses and
proposals are judged by the features and planes that agree with them, and the best are estimated from all that agrees:
points, lines and planes.
"""

from __future__ import annotations

import math
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.features.segments import SEGMENTS
from groma.gates import NORMAL
from groma.localization.pose.gates import VERDICT
from groma.localization.pose.hypotheses import Straight, propose
from groma.localization.pose.matches import Matches
from groma.tracking.beside import beside
from groma.tracking.frame.camera import TrackCamera, apart, back, into
from groma.tracking.frame.descriptor_pairs import PlacedFeatures, pair_anywhere, pair_near
from groma.tracking.frame.features import Descriptors, FrameFeatures
from groma.tracking.frame.measurements import LineMeasurements, Measurements, PlaneMeasurements, PointMeasurements
from groma.tracking.gates import DEFAULT
from groma.tracking.map.feature_points import points_of_features
from groma.tracking.map.landmarks import ALIVE
from groma.tracking.map.lines import FollowedSegments, assign, expected_segments
from groma.tracking.map.planes import assign_planes
from groma.tracking.map.points import PointTracks
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.pose.estimate import LOSSES, PoseEstimate, estimate_pose, rough_pose
from groma.tracking.pose.plane_poses import poses_on_planes


@dataclass(frozen=True)
class KnownFeatures:
    """Features of some keyframes whose place in the world is known."""

    keyframes: list[Keyframe]
    #: (n,) which of the keyframes, and which of its features.
    of: IntArray
    row: IntArray
    #: (n, 3) places in the world, (n, 32) descriptors.
    places: FloatArray
    descriptor: Descriptors


def known_features(track_map: TrackMap, camera: TrackCamera, keyframes: list[Keyframe]) -> KnownFeatures:
    """Collect the features of keyframes whose place is known."""
    of, row, places, descriptor = [], [], [], []
    for k, keyframe in enumerate(keyframes):
        every = np.arange(len(keyframe.features.pixel))
        place = feature_places(track_map, camera, keyframe, every)
        known = np.flatnonzero(np.isfinite(place[:, 0]))
        of.append(np.full(len(known), k))
        row.append(known)
        places.append(place[known])
        descriptor.append(keyframe.features.descriptor[known])
    return KnownFeatures(
        keyframes, np.concatenate(of), np.concatenate(row), np.concatenate(places), np.concatenate(descriptor)
    )


def match_near(
    camera: TrackCamera,
    known: KnownFeatures,
    features: PlacedFeatures,
    pose: FloatArray,
    radius: float,
    max_bits: int = DEFAULT.features.max_bits_near,
) -> IntArray:
    """Pair known features with features of a frame (n, 2): near where a pose says, and most alike for both."""
    expected = camera.project(into(pose, known.places))
    return pair_near(expected, known.descriptor, features, radius, max_bits)


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
    camera: TrackCamera,
    places: FloatArray,
    pixel: FloatArray,
    min_inliers: int = DEFAULT.finding.min_inliers,
    max_error: float = DEFAULT.finding.max_error,
) -> tuple[FloatArray, BoolArray] | None:
    """Pose (7,) from places in the world and their pixels, and which agree; None where chance explains them as well.

    It is the best that few matches propose, fitted to those that agree; :func:`estimate_pose` weighs them.
    """
    # Frames are free of distortion, so pixels are where they should be.
    every, none = np.ones(len(pixel), dtype=bool), np.zeros(0, dtype=bool)
    straight = Straight(camera.pinhole, Matches(pixel, places), every, none)
    # A pose that fewer agree with is of no interest; it need not be looked for as long.
    share = min_inliers / max(len(pixel), 1)
    pose = propose(straight, (max_error, max_error), 0, share, min_trials=DEFAULT.finding.min_trials)
    if pose is None:
        return None
    away = np.linalg.norm(camera.project(into(pose, places)) - pixel, axis=1)
    agree: BoolArray = away <= max_error  # what is behind the camera is NaN, and does not
    if agree.sum() < min_inliers or _log_alarms(camera, pixel, agree, max_error) > 0.0:
        return None
    return pose, agree


def _log_alarms(camera: TrackCamera, pixel: FloatArray, agree: BoolArray, max_error: float) -> float:
    """Natural logarithm of the number of poses that so much agrees with by chance: see the verdict of localisation.

    What agrees in one cell of the image counts once.
    """
    number = cells_of(camera, pixel)
    of, agreeing = len(np.unique(number)), len(np.unique(number[agree]))
    if agreeing <= 3:  # derived from three matches that fix a pose
        return math.inf
    chance = min(math.pi * max_error**2 / (camera.width * camera.height) * len(pixel) / of, 0.5)
    ways = math.comb(of, agreeing) * math.comb(agreeing, 3) * max(of - 3, 1)
    return math.log(ways) + (agreeing - 3) * math.log(chance)


def cells_of(camera: TrackCamera, pixel: FloatArray) -> IntArray:
    """Numbers (n,) of the cells of the image that pixels are in."""
    cell = np.floor(pixel / (camera.width / VERDICT.cells)).astype(np.int64)
    return cell[:, 1] * (2 * VERDICT.cells) + cell[:, 0]


@dataclass(frozen=True)
class Found:
    """A pose, what agrees with it, and what can be followed from there."""

    estimate: PoseEstimate
    known: KnownFeatures
    #: (n, 2) known features and features of the frame that agree; :func:`promote` makes followed points of them.
    pairs: IntArray
    lines: FollowedSegments
    score: float
    #: Share of the known features in view that agree: some do so by chance.
    share: float


def find_pose(
    track_map: TrackMap,
    camera: TrackCamera,
    data: FrameFeatures,
    keyframes: list[Keyframe],
    guesses: list[FloatArray],
    predicted: FloatArray,
    prior_sigma: FloatArray,
    pool: Executor | None = None,
) -> Found | None:
    """Find the pose of a frame near some keyframes; ``guesses`` are poses to be tried as well.

    What the first keyframe proposes hangs on no guess, and is worked out in a pool.
    """
    search = PoseSearch(track_map, camera, data, known_features(track_map, camera, keyframes), predicted, prior_sigma)
    gates = data.options.gates
    strong = gates.verification.strong
    first = beside(pool, partial(search.proposal, keyframes[0]))
    best: Found | None = None
    for guess in search.in_order(guesses):
        near = search.proposal_near(guess)
        best = search.best_of([guess] if near is None else [near, guess], most=1)
        if best is not None and best.score >= strong:
            break
    if best is not None and best.score >= strong:
        # What repeats itself agrees with a wrong guess, too; what no guess suggests may agree with more.
        keyframes = keyframes[:1]
    others = [first(), *(search.proposal(keyframe) for keyframe in keyframes[1:])]
    best = search.best_of([pose for pose in others if pose is not None], gates.finding.max_refined)
    if not guesses or (best is not None and best.score >= strong):
        return best
    return search.best_of(search.on_planes(), gates.finding.max_refined)


class PoseSearch:
    """One frame, the features it is compared with, and the best pose so far."""

    def __init__(self, track_map, camera, data, known, predicted, prior_sigma) -> None:
        self.track_map, self.camera, self.data, self.known = track_map, camera, data, known
        self.predicted, self.prior_sigma = predicted, prior_sigma
        self.gates, self.all_gates = data.options.gates.finding, data.options.gates
        self._best: Found | None = None
        self._tried: list[FloatArray] = []
        self._near: dict[tuple[bytes, float], IntArray] = {}
        self._planes: dict[bytes, PlaneMeasurements] = {}
        self._features = PlacedFeatures.of(data.features.pixel, data.features.descriptor)

    def near(self, pose: FloatArray, radius: float) -> IntArray:
        """Pairs (n, 2) of known features and features of the frame, near where a pose says; poses are asked again."""
        asked = pose.tobytes(), radius
        if asked not in self._near:
            max_bits = self.all_gates.features.max_bits_near
            self._near[asked] = match_near(self.camera, self.known, self._features, pose, radius, max_bits)
        return self._near[asked]

    def proposal_near(self, guess: FloatArray) -> FloatArray | None:
        """Pose from features matched in wide surroundings of where a guess says."""
        pairs = self.near(guess, self.gates.search * self.camera.width)
        return self._from_pairs(self.known.places[pairs[:, 0]], pairs[:, 1])

    def in_order(self, guesses: list[FloatArray]) -> list[FloatArray]:
        """Guesses, those first that most features agree with."""
        agree = np.array([len(self.near(guess, 3 * self.gates.near)) for guess in guesses])
        return [guesses[k] for k in np.argsort(-agree, kind="stable")]

    def proposal(self, keyframe: Keyframe) -> FloatArray | None:
        """Pose from features that match those of one keyframe, wherever they are.

        Those that agree with a pose which is there already take part: on what repeats itself a wrong pose agrees with
        the features of the right one.
        """
        first, second = keyframe.features, self.data.features
        rows, columns = pair_anywhere(first.descriptor, second.descriptor, self.all_gates.features.max_bits)
        places = feature_places(self.track_map, self.camera, keyframe, rows)
        known = np.isfinite(places[:, 0])
        return self._from_pairs(places[known], columns[known])

    def _from_pairs(self, places: FloatArray, second: IntArray) -> FloatArray | None:
        pixel = self.data.features.pixel[second]
        found = pose_from_matches(self.camera, places, pixel, self.gates.min_inliers, self.gates.max_error)
        return found[0] if found is not None else None

    def on_planes(self) -> list[FloatArray]:
        """Poses at which planes of the frame lie on planes of the keyframes, each where most agrees with it."""
        seen, planes, known = self.data.planes, self.track_map.planes, self.known
        if seen is None or not len(known.places):
            return []
        index = np.unique(np.concatenate([keyframe.measured.planes.index for keyframe in known.keyframes]))
        world, centre = planes.hesse[index[planes.alive[index]]], np.median(known.places, axis=0)
        ways = poses_on_planes(self.camera, seen, world, self.predicted, centre, self.all_gates)
        return [max(poses, key=self._agreeing) for poses in ways]

    def best_of(self, starts: list[FloatArray], most: int) -> Found | None:
        """Refine the starts that most agrees with, unless clearly more does with the best pose; return the best then.

        Beside what repeats itself a wrong pose agrees with about as much as the right one, before both are refined.
        """
        judged = [self._agreeing(start) for start in starts]
        for k in np.argsort(-np.array(judged), kind="stable")[:most]:
            if self._best is not None:
                agreeing = self._agreeing(self._best.estimate.pose)
                if judged[k] < agreeing - NORMAL.alike * math.sqrt(agreeing):
                    break
            if self._is_known(starts[k]):
                continue
            found = self.refine(starts[k])
            self._tried.append(starts[k])
            if found is not None:
                self._tried.append(found.estimate.pose)
                if self._best is None or found.score > self._best.score:
                    self._best = found
        return self._best

    def _agreeing(self, pose: FloatArray) -> float:
        """Features and planes that roughly agree with a pose."""
        count = float(len(self.near(pose, 3 * self.gates.near)))
        return count + self.gates.plane_weight * len(self._planes_at(pose)) if self.data.planes else count

    def _planes_at(self, pose: FloatArray) -> PlaneMeasurements:
        """Planes of the frame that agree with a pose; poses are asked again."""
        asked = pose.tobytes()
        if asked not in self._planes:
            self._planes[asked] = match_planes(self.track_map, self.data, pose)
        return self._planes[asked]

    def _is_known(self, start: FloatArray) -> bool:
        """Whether a start is as good as at a pose that was tried."""
        shift, turn = self.gates.same_shift * self.track_map.near.depth, self.gates.same_turn
        return any(way < shift and angle < turn for way, angle in (apart(start, one) for one in self._tried))

    def refine(self, start: FloatArray) -> Found | None:
        """Estimate the pose from all that agrees with a start, with narrowing gates."""
        track_map, camera, data, gates = self.track_map, self.camera, self.data, self.gates
        own = self.all_gates
        pose, estimate, lines = start, None, FollowedSegments.empty()
        pairs = np.zeros((0, 2), np.int64)
        for factor in gates.rounds:
            pairs = self.near(pose, factor * gates.near)
            # Features that are no point of the map yet take part by their place alone.
            temporary, table = _temporary_points(self.known, pairs, data)
            lines, line_table = match_lines(
                track_map, camera, data, pose, factor * own.lines.distance, factor * SEGMENTS.angle
            )
            planes = self._planes_at(pose)
            if len(pairs) + len(line_table) + len(planes) < 3:  # derived from three matches that fix a pose
                return None
            view = replace(track_map, points=temporary)
            around = (camera, view, Measurements(table, line_table, planes), self.predicted, self.prior_sigma, pose)
            if factor == gates.rounds[-1]:
                estimate = estimate_pose(*around, LOSSES[-1:])
                pose = estimate.pose
            else:
                pose = rough_pose(*around)
        assert estimate is not None
        agree = pairs[estimate.points] if data.options.points else pairs[:0]
        counts = estimate.counts
        score = counts["points"] + gates.line_weight * counts["lines"] + gates.plane_weight * counts["planes"]
        in_view = int(camera.inside(camera.project(into(pose, self.known.places))).sum())
        share = len(agree) / max(in_view, 1)
        return Found(estimate, self.known, agree, lines.take(estimate.lines), score, share)


class PlacesOnly:
    """Just the places of points, where an estimate wants a table of them, and which are in the map."""

    def __init__(self, xyz: FloatArray, state: IntArray | None = None) -> None:
        self.xyz, self.state = xyz, state


def _temporary_points(known: KnownFeatures, pairs: IntArray, data: FrameFeatures):
    rows = pairs[:, 1] if data.options.points else pairs[:0, 1]
    count = len(rows)
    depth = data.features.depth[rows]
    sigma = data.features.scale[rows] * data.options.point_sigma_px
    depth_sigma = data.depth_sigma(depth)
    unknown = np.full((count, 2), np.nan)
    table = PointMeasurements(np.arange(count), data.features.pixel[rows], sigma, depth, depth_sigma, unknown)
    return PlacesOnly(known.places[pairs[:, 0]]), table


def promote(track_map: TrackMap, found: Found, data: FrameFeatures) -> PointTracks:
    """Make points of the map of features that agree, where they are none yet; return them as followed points."""
    points, features, known = track_map.points, data.features, found.known
    tracks = PointTracks.empty()
    for k, keyframe in enumerate(known.keyframes):
        pairs = found.pairs[known.of[found.pairs[:, 0]] == k]
        if not len(pairs):
            continue
        own, here = known.row[pairs[:, 0]], pairs[:, 1]
        index = keyframe.features.point[own]
        usable = index >= 0
        usable[usable] = points.state[index[usable]] == ALIVE
        fresh = np.flatnonzero(~usable & np.isfinite(keyframe.features.depth[own]))
        if len(fresh):
            sigma = data.depth_sigma(keyframe.features.depth[own[fresh]])
            places = known.places[pairs[fresh, 0]]
            new = points_of_features(track_map, keyframe, own[fresh], places, sigma, data.options.point_sigma_px)
            index[fresh], usable[fresh] = new, True
        rows = np.flatnonzero(usable)
        tracks = tracks.joined(PointTracks(index[rows], features.pixel[here[rows]]))
    return tracks.take(np.unique(tracks.index, return_index=True)[1])


def match_lines(
    track_map: TrackMap, camera: TrackCamera, data: FrameFeatures, pose: FloatArray, distance: float, angle: float,
    among: IntArray | None = None,
) -> tuple[FollowedSegments, LineMeasurements]:  # fmt: skip
    """Assign detected segments to lines of the map, or some of them, by where a pose says they are, and how deep."""
    if not data.options.lines:
        return FollowedSegments.empty(), LineMeasurements.empty()
    lines, detected, gates = track_map.lines, data.detected, data.options.gates.lines
    alive = np.flatnonzero(lines.alive) if among is None else among
    expected, seen = expected_segments(camera, lines, alive, pose, gates)
    alive, expected = alive[seen], expected[seen]
    inverse = 1.0 / np.maximum(into(pose, lines.segment[alive].mean(axis=1))[:, 2], 1e-6)
    segments = detected.segments
    own = detected.inverse_depth.mean(axis=1)
    rows, hits = assign(expected, segments.ends, distance, angle, inverse, own, gates)
    sigma = np.maximum(segments.sigma[hits], gates.min_sigma)
    followed = FollowedSegments(alive[rows], segments.ends[hits], sigma, segments.strength[hits])
    table = LineMeasurements(
        alive[rows], segments.ends[hits], sigma, detected.inverse_depth[hits], detected.inverse_depth_sigma[hits]
    )
    return followed, table


def match_planes(track_map: TrackMap, data: FrameFeatures, pose: FloatArray) -> PlaneMeasurements:
    """Assign planes of a frame to planes of the map."""
    if data.planes is None:
        return PlaneMeasurements.empty()
    gates = data.options.gates.planes
    index, rows = assign_planes(track_map.planes, data.planes, pose, gates, gates.wider)
    return PlaneMeasurements(index, data.planes.plane[rows], data.planes.sqrt_information[rows])
