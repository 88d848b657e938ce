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

    #: Which landmarks take part.
    points: bool = True
    lines: bool = True
    planes: bool = True
    #: Points followed at a time (cost: time).
    num_points: int = 450
    #: Features described in each keyframe, for finding the place again (cost: time).
    num_features: int = 1000
    #: Lines followed at a time, the longest (cost: time).
    num_lines: int = 100
    #: Shortest segment, pixels.
    min_segment_length: float = 30.0
    #: What finds the segments: an object, or a name of :data:`groma.features.registry.DETECTORS`.
    detector: str | SegmentDetector = "lsd"
    #: Depths beyond this are not used, scene units.
    max_depth: float = 6.0
    #: Standard deviation of a followed point, pixels.
    point_sigma_px: float = 1.0
    #: A keyframe is taken when fewer than this share of the points of the last one are still followed ...
    keyframe_share: float = 0.6
    #: ... or the camera moved by this share of the median depth, or turned by this many radians.
    keyframe_motion: float = 0.12
    keyframe_turn: float = 0.2
    #: Keyframes adjusted together after each new one; older ones that see the same are held (cost: time).
    window: int = 7
    #: Look for places seen before, and close loops.
    close_loops: bool = True
    #: Use relations between landmarks that the data support: lines on planes, parallel and perpendicular planes.
    relations: bool = True
    #: Work in several threads; the result is the same. A keyframe (not before 45 ms by the time stamps) and the
    #: adjustment of its window are taken up two frames later, with threads or without.
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
