# SPDX-License-Identifier: BSD-3-Clause
r"""Whether the lines that should be seen at a pose are seen there.

A pose is proposed by points, so lines bear witness: at the right pose about as many are found again as keyframes find
of each other's, elsewhere about as many as at poses beside, where all is seen a little off. Both numbers are counted,
and of Poisson variables with these means, :math:`\mu` and :math:`\lambda`, :math:`k` lines are more likely the former
by :math:`e^{\lambda - \mu} (\mu / \lambda)^k`.
"""

from __future__ import annotations

import math

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.features.segments import SEGMENTS
from groma.localization.pose.gates import VERDICT
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.map.lines import expected_segments
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.pose.relocalise import match_lines
from groma.tracking.pose.rivals import poses_beside


def line_odds(
    track_map: TrackMap, camera: TrackCamera, data: FrameFeatures, keyframes: list[Keyframe], pose: FloatArray
) -> float | None:
    """Return the logarithm of how much more likely a pose is, by the lines that keyframes near it saw, than others.

    None if the right pose could not be told by them: too few are expected.
    """
    gates = data.options.gates
    if not data.options.lines:
        return None
    expected = _in_view(track_map, camera, data, keyframes, pose)
    limits = gates.lines.distance, SEGMENTS.angle
    beside = list(poses_beside(camera, pose, VERDICT.distinct * gates.finding.near))
    found, *elsewhere = (
        len(match_lines(track_map, camera, data, place, *limits, expected)[0].index) for place in [pose, *beside]
    )
    right = len(expected) * _found_again(track_map, camera, data, keyframes)
    wrong = (1.0 + sum(elsewhere)) / len(beside)
    odds = [wrong - right + count * math.log(right / wrong) for count in (found, right)] if right > wrong else [0.0] * 2
    return odds[0] if odds[1] > gates.verification.odds else None


def _in_view(
    track_map: TrackMap, camera: TrackCamera, data: FrameFeatures, keyframes: list[Keyframe], pose: FloatArray
) -> IntArray:
    """Lines that some keyframes saw and that a pose has in view."""
    lines = track_map.lines
    index = np.unique(np.concatenate([np.zeros(0, np.int64), *(k.measured.lines.index for k in keyframes)]))
    index = index[lines.alive[index]]
    return index[expected_segments(camera, lines, index, pose, data.options.gates.lines)[1]]


def _found_again(track_map: TrackMap, camera: TrackCamera, data: FrameFeatures, keyframes: list[Keyframe]) -> float:
    """How often a keyframe saw what the others did and it has in view; of one keyframe, always."""
    asked = found = 1
    for keyframe in keyframes:
        others = [other for other in keyframes if other is not keyframe]
        expected = _in_view(track_map, camera, data, others, keyframe.pose)
        asked += len(expected)
        found += int(np.isin(expected, keyframe.measured.lines.index).sum())
    return found / asked
