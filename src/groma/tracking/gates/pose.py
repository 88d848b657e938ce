# SPDX-License-Identifier: BSD-3-Clause
"""Numbers of poses: predicted, followed, judged, found again; and of loops and new maps."""

from __future__ import annotations

from dataclasses import dataclass

from groma.gates import SEQUENCES, gate


@dataclass(frozen=True)
class MotionGates:
    """Constant velocity and its noise."""

    max_steps: float = gate(3.0, "frames", "a motion is extrapolated over at most so many steps", SEQUENCES)
    shift_floor: float = gate(0.01, "share", "smallest deviation of a position, of the depth", "derived from the turn")
    turn_floor: float = gate(0.01, "rad", "smallest standard deviation of a predicted rotation", SEQUENCES)
    start: float = gate(0.15, "share, rad", "error of predictions before any was seen", SEQUENCES)
    safety: float = gate(3.0, "ratio", "standard deviation in terms of the errors of recent predictions", SEQUENCES)
    velocity_share: float = gate(0.5, "share", "share of the predicted motion that is added to it", SEQUENCES)
    learnt: float = gate(0.2, "share", "weight of the last error against earlier ones", SEQUENCES)
    last: float = gate(0.5, "share", "the error is at least this share of the last one", SEQUENCES)


@dataclass(frozen=True)
class StartGates:
    """The first frames of a map."""

    min_known: int = gate(15, "points", "points with depth (a line counts 2, a plane 5)", SEQUENCES)
    min_displacement: float = gate(0.02, "share", "median shift, of the image's width", "chosen on rendered rooms")
    most_gone: float = gate(0.5, "share", "of the points gone, with which no shift is waited for", "convention: half")
    min_points: int = gate(60, "points", "points followed and placed", "chosen on rendered rooms")
    min_inliers: float = gate(0.6, "share", "share of the points in front of both cameras", "chosen on rendered rooms")
    depth_sigma: float = gate(0.15, "share", "deviation of the first depths and step", "convention: they are known")
    max_error: float = gate(1.0, "px", "distance from an epipolar line", "convention: one pixel")
    max_depth: float = gate(50.0, "median depths", "points beyond tell no position", "derived from their share: 1e-3")
    least_cost: float = gate(1e-4, "nats", "cost of a point that fits exactly", "convention: a hundredth of sigma")
    same_turn: float = gate(0.01, "rad", "two motions are one where they differ by less", "convention: half a degree")
    same_shift: float = gate(0.1, "share", "and by less than this share of the motion", "convention: a tenth")


@dataclass(frozen=True)
class DepthCheckGates:
    """Whether the depths of a frame go with a pose."""

    min_places: int = gate(40, "places", "places that must be known", SEQUENCES)
    confirms: float = gate(0.8, "share", "this share of the places confirms a pose", SEQUENCES)
    denies: float = gate(0.35, "share", "this share of the places seen through denies it", SEQUENCES)
    edges: float = gate(0.07, "share", "a right pose may look through at edges", "chosen on cabinet and kitchen")
    smooth: float = gate(0.15, "share", "depths are read where four neighbours differ by less", SEQUENCES)


@dataclass(frozen=True)
class FindingGates:
    """Poses found by described features. A score counts points; lines and planes count for more."""

    line_weight: float = gate(2.0, "points", "what a line counts: two ends", "convention: an end is a point across")
    plane_weight: float = gate(6.0, "points", "what a plane counts", SEQUENCES)
    near: float = gate(6.0, "px", "a feature agrees within this distance; coarse scales are not precise", SEQUENCES)
    search: float = gate(0.07, "share", "where features are looked for around a guess, of the image's width", SEQUENCES)
    max_refined: int = gate(4, "poses", "proposals that are refined", "cost: time to find a pose")
    same_shift: float = gate(0.01, "share", "of the depth, from a proposal tried before", "cost: time")
    same_turn: float = gate(0.006, "rad", "and this angle", "cost: time to find a pose")
    min_inliers: int = gate(10, "points", "points that agree on a proposal", SEQUENCES)
    max_error: float = gate(4.0, "px", "distance at which they do", SEQUENCES)
    planes: int = gate(4, "planes", "largest planes of a frame that are laid on planes of the map", "cost: time")
    crossing: float = gate(0.35, "1", "sine of the angle of two planes that tell a rotation", "convention: 20 degrees")
    shifts: int = gate(
        4, "steps", "along two planes, either way, as wide as features are looked for",
        "derived from the image: to a quarter of it",
    )  # fmt: skip
    min_trials: int = gate(
        50, "samples", "drawn at least for a proposal", "derived from confidence: one in 10 000 misses a share of 0.55"
    )
    rounds: tuple[float, ...] = gate((3.0, 1.0), "1", "factors of the distances, round by round", SEQUENCES)


@dataclass(frozen=True)
class VerificationGates:
    """Whether a pose is to be believed."""

    min_followed: int = gate(6, "score", "that a pose is estimated from (line 2, plane 3)", "derived from 6 unknowns")
    nearest: int = gate(3, "keyframes", "keyframes that are tried first", "cost: time to find a pose")
    tried: int = gate(30, "keyframes", "keyframes that are tried at all", "cost: time to find a pose")
    min_score: float = gate(18.0, "score", "points and lines (or planes alone) that agree with a pose", SEQUENCES)
    looser: float = gate(0.75, "share", "of a score, for a pose found by features or without points", SEQUENCES)
    min_share: float = gate(0.35, "share", "share of the searched points and lines that agree", SEQUENCES)
    most: float = gate(0.65, "share", "of the searched points and lines that agree, for a doubtful pose", SEQUENCES)
    min_kept: float = gate(0.12, "share", "share of what the last keyframe measured", SEQUENCES)
    confirmed_evidence: float = gate(6.0, "score", "points and lines where depth confirms a pose", SEQUENCES)
    min_agreeing: float = gate(0.03, "share", "share of the features in view that agree with a found pose", SEQUENCES)
    odds: float = gate(3.0, "nats", "lines bear out a pose that is more likely by it", "derived from odds of 1 in 20")
    surprise: float = gate(2.0, "sigma", "a pose farther from the prediction is verified again", SEQUENCES)
    wider: float = gate(3.0, "ratio", "the prior of a pose found by features is wider", SEQUENCES)
    jump: float = gate(6.0, "sigma", "distance of a found pose from the prediction", SEQUENCES)
    lost_frames: int = gate(5, "frames", "lost, after which the camera can be anywhere and a map is begun", SEQUENCES)
    restart_seconds: float = gate(0.5, "s", "and time", SEQUENCES)

    @property
    def sure(self) -> float:
        """Score of a pose that was found without a prediction, or that needs no share."""
        return 2.0 * self.min_score

    @property
    def strong(self) -> float:
        """Score below which depth must confirm a pose and half of its planes agree; above, a search ends."""
        return 4.0 * self.min_score


@dataclass(frozen=True)
class LoopGates:
    """Loops and joints of maps."""

    gap: int = gate(12, "keyframes", "keyframes between a new one and those it closes a loop with", SEQUENCES)
    compared: int = gate(25, "keyframes", "keyframes that are compared", "cost: time per keyframe")
    voters: int = gate(200, "features", "strongest features that vote for keyframes", "cost: time per keyframe")
    searched: int = gate(2, "keyframes", "keyframes with most votes that are matched", "cost: time per keyframe")
    min_matches: int = gate(60, "features", "features that match", SEQUENCES)
    min_inliers: int = gate(35, "features", "features that agree on a pose", SEQUENCES)
    shared: int = gate(30, "points", "a keyframe that shares so much with the new one is no loop", SEQUENCES)
    shift_sigma: float = gate(0.02, "share", "noise of a relative position, of the median depth, and scale", SEQUENCES)
    turn_sigma: float = gate(0.01, "rad", "noise of a relative rotation", SEQUENCES)
    jump: float = gate(6.0, "sigma", "of a loop from the path, mean of its components: places are alike", SEQUENCES)
    held_by: int = gate(8, "keyframes", "earlier ones that hold each in the pose graph", "cost: time of a loop")
    max_iterations: int = gate(30, "steps", "steps of the pose graph", "cost: converges in fewer")
    final_iterations: int = gate(15, "steps", "steps of the adjustment at the end, twice", "cost: converges in fewer")
