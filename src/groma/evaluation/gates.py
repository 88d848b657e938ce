# SPDX-License-Identifier: BSD-3-Clause
"""Numbers of the scores: conventions of the field and of the benchmarks that they are compared with."""

from __future__ import annotations

import math
from dataclasses import dataclass

from groma.gates import gate

_KITTI = "convention: KITTI odometry benchmark"


@dataclass(frozen=True)
class ScoreGates:
    """When an estimate counts as right."""

    line_shares: tuple[float, ...] = gate(
        (0.001, 0.005, 0.01), "share", "thresholds of line scores, of the reference's extent, where none are given",
        "convention: LIMAP gives 1, 5 and 10 mm in rooms of a metre and more",
    )  # fmt: skip
    strict_share: float = gate(0.9, "share", "of a line that is near, for strict precision", "convention: nearly all")
    max_anchors: int = gate(200_000, "places", "places on a reference that distances are sought from", "cost: memory")
    max_places: int = gate(1000, "places", "places on one segment", "cost: memory")
    plane_angle_deg: float = gate(10.0, "deg", "angle of planes that are the same", "convention: of plane benchmarks")
    pose_angles_deg: tuple[float, ...] = gate(
        (1.0, 3.0, 5.0, 10.0), "deg", "thresholds of the area under the curve", "convention: image matching benchmarks"
    )
    time_difference: float = gate(0.01, "s", "times of poses that belong together", "convention: half of TUM's 0.02 s")
    but_for_scale: float = gate(0.25, "share", "of the error that a free scale leaves", "convention: 15/16 of squares")
    unrelated_deg: float = gate(60.0, "deg", "mean angle that is warned of", "derived from random rotations: half")
    segment_lengths: tuple[float, ...] = gate(
        (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0), "m", "lengths of the segments of a drift", _KITTI
    )
    known_rotation: float = gate(math.radians(1.0), "rad", "of rotations known from centres", "convention: a degree")
    segment_step: int = gate(10, "poses", "step between their first poses", _KITTI)


#: The numbers in use.
SCORES = ScoreGates()
