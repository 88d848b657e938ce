# SPDX-License-Identifier: BSD-3-Clause
"""Keep the map small: points that are never found go, and keyframes that only repeat what others see."""

from __future__ import annotations

import numpy as np

from groma.geometry import se3
from groma.tracking.map.landmarks import DEAD
from groma.tracking.map.track_map import Keyframe, TrackMap

#: A point looked for this often in a row and not found is dropped.
MAX_MISSES = 12
#: A keyframe repeats the others if this share of its points is seen by at least this many of them.
REPEATED, SEEN_BY = 0.85, 3
#: The newest keyframes are never dropped.
NEWEST = 4


def drop_unseen(track_map: TrackMap) -> None:
    """Take out points that were in view many times and not found."""
    points = track_map.points
    points.state[points.alive & (points.misses > MAX_MISSES)] = DEAD


def drop_repeating_keyframes(track_map: TrackMap, busy: list[Keyframe]) -> None:
    """Drop at most one keyframe whose points others see as well."""
    living = track_map.living()
    if len(living) <= NEWEST + 2:
        return
    newest = living[-1]
    others = living[1:-NEWEST]
    shared = track_map.shared(newest, others)
    used = {keyframe.index for keyframe in busy}
    counts = np.zeros(len(track_map.points), np.int32)
    for keyframe in living:
        counts[np.unique(keyframe.measured.points.index)] += 1
    for k in np.flatnonzero(shared > 20):
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
        if len(rows) > 20 and (counts[rows] - 1 >= SEEN_BY).mean() > REPEATED:
            _drop(track_map, keyframe, living)
            return


def _drop(track_map: TrackMap, keyframe: Keyframe, living: list[Keyframe]) -> None:
    position = next(k for k, other in enumerate(living) if other is keyframe)
    parent = living[position - 1]
    keyframe.parent = parent.index
    keyframe.from_parent = se3.compose(keyframe.pose[None], se3.inverse(parent.pose[None]))[0]
    keyframe.alive = False
    # Patches and first views go to another keyframe that sees the point.
    points = track_map.points
    for other in (living[position + 1 :] + living[:position][::-1])[:12]:
        table = other.measured.points
        for owner, pixel in ((points.keyframe, points.pixel), (points.first_keyframe, points.first_pixel)):
            of = np.flatnonzero(owner[table.index] == keyframe.index)
            pixel[table.index[of]] = table.pixel[of]
            owner[table.index[of]] = other.index
    keyframe.forget()


__all__ = ["drop_repeating_keyframes", "drop_unseen"]
