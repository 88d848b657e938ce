# SPDX-License-Identifier: BSD-3-Clause
"""The tuned numbers of the tracker, by what they decide: :class:`TrackingGates` is a field of the options."""

from __future__ import annotations

from dataclasses import dataclass, field

from groma.tracking.gates.frame import (
    CheckGates,
    DepthGates,
    FeatureGates,
    FramePlaneGates,
    RectificationGates,
    SparseDepthGates,
    StereoGates,
    TurnGates,
)
from groma.tracking.gates.map import CullingGates, KeyframeGates, LandmarkPlaneGates, LineGates, PlaneGates, PointGates
from groma.tracking.gates.pose import (
    DepthCheckGates,
    FindingGates,
    LoopGates,
    MotionGates,
    StartGates,
    VerificationGates,
)


@dataclass(frozen=True)
class TrackingGates:
    """All of them; exchange one with ``replace(gates, lines=LineGates(min_length=20.0))``."""

    checks: CheckGates = field(default_factory=CheckGates)
    turns: TurnGates = field(default_factory=TurnGates)
    depth: DepthGates = field(default_factory=DepthGates)
    sparse_depth: SparseDepthGates = field(default_factory=SparseDepthGates)
    frame_planes: FramePlaneGates = field(default_factory=FramePlaneGates)
    stereo: StereoGates = field(default_factory=StereoGates)
    rectification: RectificationGates = field(default_factory=RectificationGates)
    features: FeatureGates = field(default_factory=FeatureGates)
    keyframes: KeyframeGates = field(default_factory=KeyframeGates)
    points: PointGates = field(default_factory=PointGates)
    lines: LineGates = field(default_factory=LineGates)
    planes: PlaneGates = field(default_factory=PlaneGates)
    landmark_planes: LandmarkPlaneGates = field(default_factory=LandmarkPlaneGates)
    culling: CullingGates = field(default_factory=CullingGates)
    motion: MotionGates = field(default_factory=MotionGates)
    start: StartGates = field(default_factory=StartGates)
    depth_check: DepthCheckGates = field(default_factory=DepthCheckGates)
    finding: FindingGates = field(default_factory=FindingGates)
    verification: VerificationGates = field(default_factory=VerificationGates)
    loops: LoopGates = field(default_factory=LoopGates)


#: The defaults of functions that are called without options.
DEFAULT = TrackingGates()
