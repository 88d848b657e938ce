# SPDX-License-Identifier: BSD-3-Clause
"""Keep the map small: points that are never found go, and keyframes that only repeat what others see."""

from __future__ import annotations

import numpy as np

from groma.geometry import se3
from groma.tracking.gates import CullingGates
from groma.tracking.map.landmarks import DEAD
from groma.tracking.map.track_map import Keyframe, TrackMap


def drop_unseen(track_map: TrackMap, max_misses: int) -> None:
    """Take out points that were in view many times and not found."""
    points = track_map.points
    points.state[points.alive & (points.misses > max_misses)] = DEAD


def drop_repeating_keyframes(track_map: TrackMap, busy: list[Keyframe], gates: CullingGates) -> None:
    """Drop at most one keyframe whose points others see as well."""
    living = track_map.living()
    if len(living) <= gates.newest + 2:
        return
    newest = living[-1]
    others = living[1 : -gates.newest]
    shared = track_map.shared(newest, others)
    used = {keyframe.index for keyframe in busy}
    counts = np.zeros(len(track_map.points), np.int32)
    for keyframe in living:
        counts[keyframe.measured.points.index] += 1  # once, if a point is there twice
    for k in np.flatnonzero(shared > gates.min_shared):
        keyframe = others[k]
        if (
            keyframe.index == track_map.reference
            or keyframe.index in used
            or keyframe.index in track_map.pinned
            or any(keyframe.index in loop[:2] for loop in track_map.loops)
        ):
            continue
        rows = keyframe.measured.points.index
        rows = rows[track_map.points.alive[rows]]
        if len(rows) > gates.min_shared and (counts[rows] - 1 >= gates.seen_by).mean() > gates.repeated:
            _drop(track_map, keyframe, living, gates.heirs)
            return


def _drop(track_map: TrackMap, keyframe: Keyframe, living: list[Keyframe], num_heirs: int) -> None:
    position = next(k for k, other in enumerate(living) if other is keyframe)
    parent = living[position - 1]
    keyframe.parent = parent.index
    keyframe.from_parent = se3.compose(keyframe.pose[None], se3.inverse(parent.pose[None]))[0]
    keyframe.alive = False
    # Patches and first views go to another keyframe that sees the point.
    points = track_map.points
    for other in (living[position + 1 :] + living[:position][::-1])[:num_heirs]:
        table = other.measured.points
        for owner, pixel in ((points.keyframe, points.pixel), (points.first_keyframe, points.first_pixel)):
            of = np.flatnonzero(owner[table.index] == keyframe.index)
            pixel[table.index[of]] = table.pixel[of]
            owner[table.index[of]] = other.index
    keyframe.forget()
