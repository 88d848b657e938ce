# SPDX-License-Identifier: BSD-3-Clause
"""Options of a track."""

from __future__ import annotations

from dataclasses import dataclass, field

from groma.errors import InputError
from groma.features.contract import SegmentDetector
from groma.features.registry import DETECTORS
from groma.tracking.gates import TrackingGates


@dataclass(frozen=True)
class TrackOptions:
    """Options of tracking. The defaults suit hand-held cameras and cars at 10 frames a second and more."""

    #: Which landmarks are used.
    points: bool = True
    lines: bool = True
    planes: bool = True
    #: Points tracked at a time (cost: time).
    num_points: int = 450
    #: Features described in each keyframe, for place recognition (cost: time).
    num_features: int = 1000
    #: Lines tracked at a time, the longest (cost: time).
    num_lines: int = 100
    #: Minimum segment length, pixels.
    min_segment_length: float = 30.0
    #: Segment detector: an object, or a name of :data:`groma.features.registry.DETECTORS`.
    detector: str | SegmentDetector = "lsd"
    #: Depths beyond this are not used, scene units.
    max_depth: float = 6.0
    #: Standard deviation of a tracked point, pixels.
    point_sigma_px: float = 1.0
    #: A keyframe is made when fewer than this share of the points of the last one are still tracked ...
    keyframe_share: float = 0.6
    #: ... or the camera moved by this share of the median depth, or turned by this many radians.
    keyframe_motion: float = 0.12
    keyframe_turn: float = 0.2
    #: Keyframes adjusted together after each new one; older covisible ones are held (cost: time).
    window: int = 7
    #: Recognise revisited places and close loops.
    close_loops: bool = True
    #: Use relations between landmarks that the data support: lines on planes, parallel and perpendicular planes.
    relations: bool = True
    #: Use several threads; the result is the same. A keyframe (not before 45 ms by the time stamps) and the
    #: adjustment of its window are integrated two frames later, with threads or without.
    threaded: bool = True
    #: Tuned numbers: thresholds, with unit, meaning and origin.
    gates: TrackingGates = field(default_factory=TrackingGates)

    def make_detector(self) -> SegmentDetector:
        """Return the detector; :class:`~groma.errors.InputError` if there is none of that name."""
        return DETECTORS.make(self.detector, min_length=self.min_segment_length, max_segments=2 * self.num_lines)

    def __post_init__(self) -> None:
        if not (self.points or self.lines or self.planes):
            raise InputError("Nothing to track: switch on points, lines or planes.")
        for name in ("num_points", "num_features", "window"):
            if getattr(self, name) < 2:
                raise InputError(f"{name} must be at least 2; got {getattr(self, name)}.")
        for name in ("min_segment_length", "max_depth", "point_sigma_px", "keyframe_motion", "keyframe_turn"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} must be positive; got {getattr(self, name)}.")
