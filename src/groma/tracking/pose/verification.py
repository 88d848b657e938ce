# SPDX-License-Identifier: BSD-3-Clause
"""Whether the pose of a frame is to be believed, and the search for a frame that could not be followed.

A pose needs enough points and lines that agree with it, of enough that were looked at. Fewer will do where the depth of
the frame confirms it: what the map knows to be somewhere is then measured there. Where few agree and
depth is known, it must; and a pose that was searched must not look through what the map knows.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.geometry import se3
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.options import TrackOptions
from groma.tracking.pose.depth_check import CONFIRMS, DENIES, depth_agreement
from groma.tracking.pose.estimate import PoseEstimate
from groma.tracking.pose.relocalise import LINE_WEIGHT, PLANE_WEIGHT, Found, find_pose

#: Keyframes that are tried first, and at most, to find a lost frame.
NEAREST, MOST = 3, 30
#: Least number of agreeing measurements (a line counts twice, a plane six times), and least share.
MIN_SCORE, MIN_SHARE = 18.0, 0.35
#: Least share of what the last keyframe measured.
MIN_KEPT = 0.12
#: Least number of agreeing points and lines (counted twice), where either is followed at all; this share of it for a
#: pose found by features.
MIN_EVIDENCE, FOUND_SHARE = 16.0, 0.75
#: The same where depth confirms a pose, and the share of what was looked at that must then agree.
CONFIRMED_EVIDENCE, CONFIRMED_SHARE = 6.0, 0.6
#: A pose found by features needs this score, or this share of the features in view.
CERTAIN, MIN_AGREEING = 40.0, 0.03
#: A pose found without a prediction needs this score; less where no points are followed. Above the second, no other
#: keyframe is tried.
ANYWHERE_SCORE, ENOUGH_SCORE = 36.0, 120.0
#: Below this score more than half of the planes must agree, where the frame sees any of the map, and depth must confirm
#: the pose, where it is known.
DOUBTFUL_SCORE = 80.0
#: A pose farther than this many standard deviations from the prediction is looked at twice, if less than this share of
#: what was looked at agrees: walls whose windows repeat are followed to the next window so.
SURPRISE, SURE_SHARE = 2.0, 0.7
#: The prior of a pose found by features is wider by this factor.
WIDER = 3.0
#: A pose found without one before may be this many standard deviations of the prediction away.
JUMP_GATE = 6.0


def evidence(counts: dict[str, int]) -> float:
    """Weight of points and lines alone: planes slide along each other, so a pose should not hang on them."""
    return counts["points"] + LINE_WEIGHT * counts["lines"]


class PoseVerification:
    """What is asked of a pose, in a track with some options."""

    def __init__(self, camera: TrackCamera, options: TrackOptions) -> None:
        self.camera, self.options = camera, options
        self._least_evidence = MIN_EVIDENCE if options.points or options.lines else 0.0

    def trusts(self, track_map: TrackMap, data: FrameFeatures, estimate: PoseEstimate) -> bool:
        """Whether enough agrees with the pose of a frame that was followed; depth decides where that is not much."""
        counts = estimate.counts
        score = score_of(estimate)
        if len(estimate.planes) >= 2 and 2 * counts["planes"] <= len(estimate.planes) and score < DOUBTFUL_SCORE:
            return False
        enough = score >= MIN_SCORE and evidence(counts) >= self._least_evidence
        if not enough or not _keeps(track_map, estimate) or _share(estimate) < MIN_SHARE or len(estimate.weak) == 6:
            return False
        return score >= DOUBTFUL_SCORE or not self._contradicted([track_map.near], data, estimate)

    def is_surprised(self, estimate: PoseEstimate, predicted: FloatArray, prior_sigma: FloatArray) -> bool:
        """Whether a pose that is trusted is far from the prediction, and much that was followed does not agree."""
        far = not is_near(estimate.pose, predicted, prior_sigma, SURPRISE)
        return far and _share(estimate) < SURE_SHARE

    def confirms(self, track_map: TrackMap, data: FrameFeatures, estimate: PoseEstimate) -> bool:
        """Whether depth confirms the pose of a frame that was followed with few points and lines."""
        return _keeps(track_map, estimate) and self._confirmed([track_map.near], data, estimate)

    def _confirmed(self, keyframes: list[Keyframe], data: FrameFeatures, estimate: PoseEstimate) -> bool:
        """Whether depth confirms a pose that few points and lines agree with."""
        if evidence(estimate.counts) < CONFIRMED_EVIDENCE or estimate.weak or _share(estimate) < CONFIRMED_SHARE:
            return False
        agree, _ = depth_agreement(self.camera, keyframes, data.depth_grid, estimate.pose)
        return agree > CONFIRMS

    def _contradicted(self, keyframes: list[Keyframe], data: FrameFeatures, estimate: PoseEstimate) -> bool:
        """Whether depth, where it is known, does not confirm a pose."""
        agree, _ = depth_agreement(self.camera, keyframes, data.depth_grid, estimate.pose)
        return agree < CONFIRMS

    def _denied(self, data: FrameFeatures, found: Found) -> bool:
        """Whether depth denies a pose."""
        _, through = depth_agreement(self.camera, found.known.keyframes, data.depth_grid, found.estimate.pose)
        return through > DENIES

    def find_near(
        self,
        track_map: TrackMap,
        data: FrameFeatures,
        guesses: list[FloatArray],
        predicted: FloatArray,
        prior_sigma: FloatArray,
    ) -> Found | None:
        """Find a frame by described features, near the last keyframes."""
        nearest = track_map.living()[::-1][:NEAREST]
        found = find_pose(track_map, self.camera, data, nearest, guesses, predicted, WIDER * prior_sigma)
        if found is None or not is_near(found.estimate.pose, predicted, prior_sigma) or self._denied(data, found):
            return None
        # Rooms are alike at both ends, in depth too: of the features in view some must agree.
        if not (found.score >= CERTAIN or found.share >= MIN_AGREEING or not self.options.points):
            return None
        enough = evidence(found.estimate.counts) >= FOUND_SHARE * self._least_evidence
        if enough and found.score >= MIN_SCORE and len(found.estimate.weak) <= 2:
            return found
        return found if self._confirmed(nearest, data, found.estimate) else None

    def find_anywhere(self, track_map: TrackMap, data: FrameFeatures) -> Found | None:
        """Find a frame by described features, among recent keyframes and an even choice of the others."""
        living = track_map.living()
        wide = np.array([1e3] * 3 + [10.0] * 3)
        best = None
        for keyframe in living[::-1][:: max(1, len(living) // MOST)][:MOST]:
            found = find_pose(track_map, self.camera, data, [keyframe], [], keyframe.pose, wide)
            if found is not None and (best is None or found.score > best.score):
                best = found
            if best is not None and best.score > ENOUGH_SCORE:
                break
        least = ANYWHERE_SCORE if self.options.points else 0.75 * ANYWHERE_SCORE
        if best is None or best.score < least or best.estimate.weak:
            return None
        # Two places may have like features; planes that are seen and are not there tell them apart.
        seen = 0 if data.planes is None else len(data.planes)
        if seen >= 2 and not best.estimate.planes.any() and best.score < DOUBTFUL_SCORE:
            return None
        if best.score < DOUBTFUL_SCORE and self._contradicted(best.known.keyframes, data, best.estimate):
            return None
        return None if self._denied(data, best) else best


def score_of(estimate: PoseEstimate) -> float:
    """Weight of all that agrees with a pose."""
    return evidence(estimate.counts) + PLANE_WEIGHT * estimate.counts["planes"]


def is_near(pose: FloatArray, predicted: FloatArray, sigma: FloatArray, gate: float = JUMP_GATE) -> bool:
    """Whether the camera can have got, and turned, from where it was predicted to where a pose says."""
    centers = se3.inverse(np.stack([pose, predicted]))[:, 4:]
    turn = se3.log(se3.compose(pose[None], se3.inverse(predicted[None])))[0, 3:]
    went = np.linalg.norm(centers[1] - centers[0]) < gate * np.linalg.norm(sigma[:3])
    return bool(went and np.linalg.norm(turn) < gate * np.linalg.norm(sigma[3:]))


def _keeps(track_map: TrackMap, estimate: PoseEstimate) -> bool:
    """Whether enough is left of what the last keyframe measured."""
    before = track_map.near.measured
    return estimate.counts["points"] + estimate.counts["lines"] >= MIN_KEPT * (len(before.points) + len(before.lines))


def _share(estimate: PoseEstimate) -> float:
    """Share of the points and lines looked at that agree."""
    looked_at = len(estimate.points) + len(estimate.lines)
    return (estimate.counts["points"] + estimate.counts["lines"]) / looked_at if looked_at else 1.0


__all__ = ["PoseVerification", "evidence", "is_near", "score_of"]
