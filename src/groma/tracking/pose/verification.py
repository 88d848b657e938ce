# SPDX-License-Identifier: BSD-3-Clause
"""Whether the pose of a frame is to be believed, and the search for a frame that could not be followed.

A pose needs enough points and lines that agree with it, of enough that were looked at. Fewer will do where the depth of
the frame confirms it: what the map knows to be somewhere is then measured there. Where few agree and
depth is known, it must; and a pose that was searched must not look through what the map knows. Where few points agree
with it, lines must be seen where they should (:mod:`groma.tracking.pose.expected_lines`). Where nothing tells what the
camera sees, after a loss or many missing frames, its place must stand out (:mod:`groma.tracking.pose.rivals`), and it
must not be left open whether it is the place or its other side (:mod:`groma.tracking.pose.half_turns`).
"""

from __future__ import annotations

import math
from concurrent.futures import Executor

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.features.segments import SEGMENTS
from groma.gates import NORMAL
from groma.tracking.frame.camera import TrackCamera, apart, into
from groma.tracking.frame.descriptor_pairs import PlacedFeatures
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.gates import TrackingGates
from groma.tracking.map.points import PointTracks
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.options import TrackOptions
from groma.tracking.pose.depth_check import depth_agreement
from groma.tracking.pose.estimate import PoseEstimate
from groma.tracking.pose.expected_lines import line_odds
from groma.tracking.pose.half_turns import poses_left_open
from groma.tracking.pose.relocalise import Found, find_pose, match_lines, match_near
from groma.tracking.pose.rivals import num_cells, stands_out

#: Standard deviations (6,) of a prior that tells nothing: scene units, radians.
_ANYWHERE = np.array([1e3] * 3 + [10.0] * 3)


class PoseVerification:
    """What is asked of a pose, in a track with some options."""

    def __init__(self, camera: TrackCamera, options: TrackOptions) -> None:
        self.camera, self.options, self.gates = camera, options, options.gates.verification
        self._least_evidence = self.gates.min_score if options.points or options.lines else 0.0

    def evidence(self, estimate: PoseEstimate) -> float:
        """Weight of points and lines alone: planes slide along each other, so a pose should not hang on them."""
        counts = estimate.counts
        return counts["points"] + self.options.gates.finding.line_weight * counts["lines"]

    def score(self, estimate: PoseEstimate) -> float:
        """Weight of all that agrees with a pose."""
        return self.evidence(estimate) + self.options.gates.finding.plane_weight * estimate.counts["planes"]

    def is_near(self, pose: FloatArray, predicted: FloatArray, sigma: FloatArray, gate: float | None = None) -> bool:
        """Whether the camera can have got, and turned, from where it was predicted to where a pose says."""
        gate = self.gates.jump if gate is None else gate
        shift, turn = apart(pose, predicted)
        return bool(shift < gate * np.linalg.norm(sigma[:3]) and turn < gate * np.linalg.norm(sigma[3:]))

    def _says_nothing(self, track_map: TrackMap, sigma: FloatArray) -> bool:
        """Whether a prediction does not tell what the camera sees: it may have turned by all that it has in view, or
        moved as far as that is away.
        """
        view = 2.0 * math.atan(0.5 * self.camera.width / self.camera.fx)
        return bool(np.linalg.norm(sigma[3:]) > view or np.linalg.norm(sigma[:3]) > track_map.near.depth)

    def trusts(self, track_map: TrackMap, data: FrameFeatures, estimate: PoseEstimate) -> bool:
        """Whether enough agrees with the pose of a frame that was followed; depth decides where that is not much."""
        score = self.score(estimate)
        if (
            len(estimate.planes) >= 2
            and 2 * estimate.counts["planes"] <= len(estimate.planes)
            and score < self.gates.strong
        ):
            return False
        enough = score >= self.gates.min_score and self.evidence(estimate) >= self._least_evidence
        if not enough or _share(estimate) < self.gates.min_share or len(estimate.weak) == 6:
            return False
        if not self._keeps(track_map, estimate):
            return False
        return score >= self.gates.strong or not self._contradicted([track_map.near], data, estimate)

    def is_surprised(self, estimate: PoseEstimate, predicted: FloatArray, prior_sigma: FloatArray) -> bool:
        """Whether a pose that is trusted is far from the prediction, and much that was followed does not agree."""
        far = not self.is_near(estimate.pose, predicted, prior_sigma, self.gates.surprise)
        return far and _share(estimate) < self.gates.most

    def confirms(self, track_map: TrackMap, data: FrameFeatures, estimate: PoseEstimate) -> bool:
        """Whether depth confirms the pose of a frame that was followed with few points and lines."""
        return self._keeps(track_map, estimate) and self._confirmed([track_map.near], data, estimate)

    def _keeps(self, track_map: TrackMap, estimate: PoseEstimate) -> bool:
        """Whether enough is left of what the last keyframe measured."""
        before, counts = track_map.near.measured, estimate.counts
        return counts["points"] + counts["lines"] >= self.gates.min_kept * (len(before.points) + len(before.lines))

    def _confirmed(self, keyframes: list[Keyframe], data: FrameFeatures, estimate: PoseEstimate) -> bool:
        """Whether depth confirms a pose that few points and lines agree with."""
        if self.evidence(estimate) < self.gates.confirmed_evidence or estimate.weak:
            return False
        if _share(estimate) < self.gates.most:
            return False
        agree, _ = depth_agreement(self.camera, keyframes, data.depth_grid, estimate.pose, self.options.gates)
        return agree > self.options.gates.depth_check.confirms

    def _contradicted(self, keyframes: list[Keyframe], data: FrameFeatures, estimate: PoseEstimate) -> bool:
        """Whether depth, where it is known, does not confirm a pose."""
        agree, _ = depth_agreement(self.camera, keyframes, data.depth_grid, estimate.pose, self.options.gates)
        return agree < self.options.gates.depth_check.confirms

    def _denied(self, data: FrameFeatures, found: Found) -> bool:
        """Whether depth denies a pose."""
        keyframes, pose = found.known.keyframes, found.estimate.pose
        _, through = depth_agreement(self.camera, keyframes, data.depth_grid, pose, self.options.gates)
        return through > self.options.gates.depth_check.denies

    def _witnessed(self, track_map: TrackMap, data: FrameFeatures, found: Found) -> bool:
        """Whether lines, or depth where lines do not tell, bear out a pose that not much agrees with."""
        if found.score >= self.gates.strong:
            return True
        keyframes, estimate = found.known.keyframes, found.estimate
        odds = line_odds(track_map, self.camera, data, keyframes, estimate.pose)
        if odds is not None and not 0.0 <= odds < self.gates.odds:
            return odds > 0.0
        return not self._contradicted(keyframes, data, estimate)

    def _stands_out(self, track_map: TrackMap, data: FrameFeatures, found: Found) -> bool:
        """Whether clearly more points and lines agree with a pose than with others beside it."""
        gates, pixel, camera = self.options.gates, data.features.pixel, self.camera
        features = PlacedFeatures.of(pixel, data.features.descriptor)

        def pairs_at(pose: FloatArray) -> IntArray:
            return match_near(camera, found.known, features, pose, gates.finding.near, gates.features.max_bits_near)

        def votes_at(pose: FloatArray) -> int:
            lines = match_lines(track_map, camera, data, pose, gates.lines.distance, SEGMENTS.angle)[0]
            return num_cells(camera, pixel[pairs_at(pose)[:, 1]]) + len(lines.index)

        pose = found.estimate.pose
        pairs = found.pairs if self.options.points else pairs_at(pose)
        votes = num_cells(camera, pixel[pairs[:, 1]]) + len(found.lines.index)
        return stands_out(camera, pose, votes, votes_at, gates.finding.near)

    def _is_open(
        self, track_map: TrackMap, data: FrameFeatures, found: Found, predicted: FloatArray, sigma: FloatArray
    ) -> bool:
        """Whether a pose on another side, which is not much less likely by the prediction, is not denied."""

        def nats(pose: FloatArray) -> float:
            shift, turn = apart(pose, predicted)
            # derived from half the squares of three numbers each, whose sigmas are equal
            return 1.5 * float((shift / np.linalg.norm(sigma[:3])) ** 2 + (turn / np.linalg.norm(sigma[3:])) ** 2)

        others = poses_left_open(track_map, self.camera, data, self._chosen(track_map), found, sigma)
        return any(nats(other) < nats(found.estimate.pose) + self.gates.odds for other in others)

    def _chosen(self, track_map: TrackMap) -> list[Keyframe]:
        """Return recent keyframes and an even choice of the others, the last one first."""
        living = track_map.living()[::-1]
        return living[:: max(1, len(living) // self.gates.tried)][: self.gates.tried]

    def find(
        self,
        track_map: TrackMap,
        data: FrameFeatures,
        guesses: list[FloatArray],
        predicted: FloatArray,
        prior_sigma: FloatArray,
        lost_for: int,
        after_gap: bool,
        pool: Executor | None = None,
    ) -> Found | None:
        """Find a frame by described features: near the last keyframes first, then anywhere.

        After frames without a pose, lost or missing, it may be in a place that looks like one of the map.
        """
        says_nothing = self._says_nothing(track_map, prior_sigma)
        alone = lost_for > self.gates.lost_frames or ((after_gap or lost_for > 0) and says_nothing)
        if lost_for > self.gates.lost_frames:
            prior_sigma, found = _ANYWHERE, None
        else:
            found = self.find_near(track_map, data, guesses, predicted, prior_sigma, alone, pool)
        found = found or self.find_anywhere(track_map, data, alone)
        if found is None or not self.is_near(found.estimate.pose, predicted, prior_sigma):
            return None
        return None if alone and self._is_open(track_map, data, found, predicted, prior_sigma) else found

    def find_near(
        self,
        track_map: TrackMap,
        data: FrameFeatures,
        guesses: list[FloatArray],
        predicted: FloatArray,
        prior_sigma: FloatArray,
        alone: bool = False,
        pool: Executor | None = None,
    ) -> Found | None:
        """Find a frame by described features, near the last keyframes; a part of it in a pool.

        Where it is ``alone``, without a prediction that tells anything, its place must stand out.
        """
        nearest = track_map.living()[::-1][: self.gates.nearest]
        wider = self.gates.wider * prior_sigma
        found = find_pose(track_map, self.camera, data, nearest, guesses, predicted, wider, pool)
        if found is None or not self.is_near(found.estimate.pose, predicted, prior_sigma) or self._denied(data, found):
            return None
        # Rooms are alike at both ends, in depth too: of the features in view some must agree.
        if not (found.score >= self.gates.sure or found.share >= self.gates.min_agreeing or not self.options.points):
            return None
        if not self._witnessed(track_map, data, found) or (alone and not self._stands_out(track_map, data, found)):
            return None
        enough = self.evidence(found.estimate) >= self.gates.looser * self._least_evidence
        if enough and found.score >= self.gates.min_score and len(found.estimate.weak) <= 2:
            return found
        return found if self._confirmed(nearest, data, found.estimate) else None

    def find_anywhere(self, track_map: TrackMap, data: FrameFeatures, alone: bool = True) -> Found | None:
        """Find a frame by described features, among recent keyframes and an even choice of the others."""
        best = None
        for keyframe in self._chosen(track_map):
            found = find_pose(track_map, self.camera, data, [keyframe], [], keyframe.pose, _ANYWHERE)
            if found is not None and (best is None or found.score > best.score):
                best = found
            if best is not None and best.score > self.gates.strong:
                break
        least = self.gates.sure * (1.0 if self.options.points else self.gates.looser)
        if best is None or best.score < least or best.estimate.weak:
            return None
        # Two places may have like features; planes that are seen and are not there tell them apart.
        seen = 0 if data.planes is None else len(data.planes)
        if seen >= 2 and not best.estimate.planes.any() and best.score < self.gates.strong:
            return None
        if best.score < self.gates.strong and self._contradicted(best.known.keyframes, data, best.estimate):
            return None
        if self._denied(data, best) or not self._witnessed(track_map, data, best):
            return None
        if alone and not self._stands_out(track_map, data, best):
            return None
        return best


def misses_much(
    track_map: TrackMap, camera: TrackCamera, before: PointTracks, pose: FloatArray, count: int, gates: TrackingGates
) -> bool:
    """Whether most points of the frame before, of those in view of a pose, are not among ``count`` points there.

    Points that are followed over a wide step slide along what repeats itself, and then agree on a wrong pose.
    """
    index = before.index[track_map.points.alive[before.index]]
    expected = camera.project(into(pose, track_map.points.xyz[index]))
    return bool(count < NORMAL.majority * camera.inside(expected, gates.points.border).sum())


def _share(estimate: PoseEstimate) -> float:
    """Share of the points and lines looked at that agree."""
    looked_at = len(estimate.points) + len(estimate.lines)
    return (estimate.counts["points"] + estimate.counts["lines"]) / looked_at if looked_at else 1.0
