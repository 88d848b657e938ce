# SPDX-License-Identifier: BSD-3-Clause
"""Maps that were begun anew after the track was lost, and how they are joined when a place is recognised."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from groma._counted import counted
from groma._typing import FloatArray, IntArray
from groma.geometry import se3
from groma.io.trajectories import Trajectory
from groma.scene import Scene
from groma.scene.landmarks import Lines
from groma.tracking.backend.loop_closure import (
    LoopSearch,
    agreeing_pose,
    join_points,
)
from groma.tracking.frame.camera import TrackCamera, into, planes_into
from groma.tracking.gates import TrackingGates
from groma.tracking.map.track_map import Keyframe, TrackMap


@dataclass(frozen=True)
class Part:
    """A part of a track that could not be joined to the longest one; its world is its own."""

    trajectory: Trajectory
    scene: Scene
    #: Time stamps of the keyframes, in the order of the scene's images.
    keyframes: FloatArray


@dataclass(frozen=True)
class Joint:
    """A keyframe of a newer map that sees what a keyframe of an older map saw."""

    older: int
    keyframe: Keyframe
    newest: Keyframe
    #: (7,) pose of the newer camera in terms of the older one.
    keyframe_from_newest: FloatArray
    #: Matched features that agree.
    first: IntArray
    second: IntArray

    def older_from_newer(self) -> FloatArray:
        """Pose (7,) that moves the world of the newer map into that of the older one, as both stand now."""
        there = se3.compose(se3.inverse(self.keyframe.pose[None]), self.keyframe_from_newest[None])
        return se3.compose(there, self.newest.pose[None])[0]


def search_older_maps(maps: list[TrackMap], newest: Keyframe, gates: TrackingGates) -> LoopSearch | None:
    """Return the search for the newest keyframe in all maps but the last, or None if there are no keyframes."""
    keyframes = [keyframe for older in maps[:-1] for keyframe in older.living()]
    if not keyframes:
        return None
    chosen = np.unique(np.linspace(0, len(keyframes) - 1, 2 * gates.loops.compared).astype(int))
    return LoopSearch(newest, [keyframes[k] for k in chosen], gates)


def find_joint(
    maps: list[TrackMap],
    camera: TrackCamera,
    newest: Keyframe,
    pairs: list[tuple[Keyframe, IntArray, IntArray]],
    gates: TrackingGates,
) -> Joint | None:
    """Return how the newest map joins an older one, if what a search found agrees on one pose."""
    best: Joint | None = None
    for keyframe, first, second in pairs:
        older = next(k for k, part in enumerate(maps) if keyframe in part.living())
        found = agreeing_pose(maps[older], camera, keyframe, newest, first, second, gates)
        if found is not None and (best is None or len(found[1]) > len(best.first)):
            pose, first, second = found
            relative = se3.compose(keyframe.pose[None], se3.inverse(pose[None]))[0]
            best = Joint(older, keyframe, newest, relative, first, second)
    return best


def join_maps(maps: list[TrackMap], joints: dict[int, Joint]) -> dict[int, tuple[int, int]]:
    """Put each map that has a joint into the older one.

    Returns where each map now is: the map that holds it, and what was added to the numbers of its keyframes.
    """
    where = {k: (k, 0) for k in range(len(maps))}
    for k in sorted(joints):
        joint = joints[k]
        root = where[joint.older][0]
        # The keyframes of the older map may have been moved into another world; the joint looks at where they are now.
        shift = _absorb(maps[root], maps[k], joint.older_from_newer())
        where[k] = (root, shift)
        maps[root].loops.append((joint.keyframe.index, joint.newest.index, joint.keyframe_from_newest))
        join_points(maps[root], joint.keyframe, joint.newest, joint.first, joint.second)
    return where


def _absorb(track_map: TrackMap, other: TrackMap, here_from_there: FloatArray) -> int:
    """Add all of another map, moved by a pose; return what was added to the numbers of its keyframes."""
    shift = len(track_map.keyframes)
    start = {}
    for kind in ("points", "lines", "planes"):
        mine, theirs = getattr(track_map, kind), getattr(other, kind)
        start[kind] = len(mine)
        rows = mine.extend(len(theirs))
        for name in theirs._columns:
            getattr(mine, name)[rows] = getattr(theirs, name)
        for name in ("keyframe", "first_keyframe"):
            if name in theirs._columns:
                column = getattr(mine, name)
                column[rows] = _shifted(column[rows], shift)
    points, lines, planes = (slice(start[kind], None) for kind in ("points", "lines", "planes"))
    track_map.points.xyz[points] = into(here_from_there, track_map.points.xyz[points])
    alive = np.flatnonzero(track_map.lines.alive[lines]) + start["lines"]
    if len(alive):
        moved = Lines.through(into(here_from_there, track_map.lines.segment[alive]))
        track_map.lines.segment[alive], track_map.lines.plucker[alive] = moved.segments, moved.plucker
    track_map.lines.plane[lines] = _shifted(track_map.lines.plane[lines], start["planes"])
    track_map.planes.hesse[planes] = planes_into(here_from_there, track_map.planes.hesse[planes])
    track_map.planes.samples[planes] = into(here_from_there, track_map.planes.samples[planes])
    track_map.planes.merged_into[planes] = _shifted(track_map.planes.merged_into[planes], start["planes"])
    there_from_here = se3.inverse(here_from_there[None])
    for keyframe in other.keyframes:
        keyframe.pose = se3.compose(keyframe.pose[None], there_from_here)[0]
        keyframe.index += shift
        keyframe.parent = keyframe.parent + shift if keyframe.parent >= 0 else -1
        measured = keyframe.measured
        keyframe.measured = replace(
            measured,
            **{
                kind: replace(getattr(measured, kind), index=getattr(measured, kind).index + start[kind])
                for kind in ("points", "lines", "planes")
            },
        )
        keyframe.features.point[:] = _shifted(keyframe.features.point, start["points"])
    track_map.loops += [(one + shift, two + shift, pose) for one, two, pose in other.loops]
    track_map.keyframes += other.keyframes
    return shift


def about_parts(breaks: list[tuple[float, float]], where: dict[int, tuple[int, int]], others: list[int]) -> list[str]:
    """Say where a track broke, and what became of its maps.

    Parameters
    ----------
    breaks
        Times of losses, and of the new maps.
    where
        Of :func:`join_maps`.
    others
        Number of frames of each part that is not the longest.
    """
    out = [f"The track was lost at {since:.3f} s; a new map was begun at {until:.3f} s." for since, until in breaks]
    joined = sum(root != part for part, (root, _) in where.items())
    if joined:
        out.append(f"Joined to an older map, where a place was recognised: {counted(joined, 'new maps')}.")
    if others:
        out.append(
            f"Not joined to the longest part of the track: {counted(len(others), 'parts')} "
            f"({', '.join(f'{number:,}' for number in others)} frames), each in a world of its own."
        )
    return out


def _shifted(index: IntArray, by: int) -> IntArray:
    return np.where(index >= 0, index + by, -1)


__all__ = ["Joint", "Part", "about_parts", "find_joint", "join_maps", "search_older_maps"]
