# SPDX-License-Identifier: BSD-3-Clause
"""What lines are mapped on."""

from __future__ import annotations

from dataclasses import dataclass, field

from groma.adjustment.survey.attach import Surveyed
from groma.mapping.depth.points import MeasuredDepths
from groma.scene import Scene, Similarity


@dataclass(frozen=True, eq=False)
class PointBase:
    """Poses and points of a map on its way, near the origin and in a usual unit."""

    #: The scene that went in.
    start: Scene
    #: From the frame of the result to this one; None: they are the same.
    near: Similarity | None = None
    #: The scene with adjusted points and poses, and with measurements; empty before the first adjustment.
    points: Scene = field(default_factory=Scene)
    #: How it got into the frame of measurements, and to the unit of depth maps, where there are any.
    surveyed: Surveyed | None = None
    depths: MeasuredDepths | None = None
