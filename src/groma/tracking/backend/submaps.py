# SPDX-License-Identifier: BSD-3-Clause
"""Maps that were begun anew after the track was lost, and how they are joined when a place is recognised."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from groma._counted import counted
from groma._typing import FloatArray, IntArray
from groma.geometry import se3, sim3
from groma.io.trajectories import Trajectory
from groma.scene import Scene
from groma.scene.landmarks import Lines
from groma.tracking.backend.loop_closure import LoopSearch, join_points
from groma.tracking.backend.place_again import KnownMap, measure_place
from groma.tracking.frame.camera import TrackCamera, into, planes_into
from groma.tracking.gates import TrackingGates
from groma.tracking.map.track_map import Keyframe, TrackMap, in_unit
from groma.tracking.options import TrackOptions


@dataclass(frozen=True)
class Submap:
    """A submap of a track that could not be joined to the longest one; its world is its own."""

    trajectory: Trajectory
    scene: Scene
    #: Time stamps of the keyframes, in the order of the scene's images.
    keyframes: FloatArray


@dataclass(frozen=True)
class Joint:
    """A keyframe of one map that sees what a keyframe of another map saw; maps and keyframes by their numbers."""

    older: int
    keyframe: int
    newer: int
    newest: int
    #: (8,) similarity of the newer camera in terms of the older one; its scale is not 1 for maps of a single camera.
    keyframe_from_newest: FloatArray
    #: Matched features that agree.
    first: IntArray
    second: IntArray


@dataclass(frozen=True)
class PlacedMaps:
    """Maps, some of them put into others."""

    maps: tuple[TrackMap, ...]
    #: For each map that was begun: the map that holds it, and what was added to the numbers of its keyframes.
    where: tuple[tuple[int, int], ...]

    @classmethod
    def apart(cls, maps: Sequence[TrackMap]) -> PlacedMaps:
        """Return maps of which each is on its own."""
        return cls(tuple(maps), tuple((k, 0) for k in range(len(maps))))

    def joined(self, joint: Joint) -> PlacedMaps:
        """Put the map of one side of a joint into that of the other; where both are in one map, it is a loop."""
        (root, before), (other, after) = self.where[joint.older], self.where[joint.newer]
        old, new, relative = before + joint.keyframe, after + joint.newest, joint.keyframe_from_newest
        first, second = joint.first, joint.second
        if other < root:
            root, other, old, new, first, second = other, root, new, old, second, first
            relative = sim3.inverse(relative)
        if root == other:
            joined, where = self.maps[root].copy(), self.where
        else:
            here, there = self.maps[root].keyframes[old], self.maps[other].keyframes[new]
            moved = sim3.compose(sim3.inverse(np.append(here.pose, 1.0)), relative)
            joined = joined_map(self.maps[root], self.maps[other], sim3.compose(moved, np.append(there.pose, 1.0)))
            shift = len(self.maps[root].keyframes)
            where = tuple((root, number + shift) if held == other else (held, number) for held, number in self.where)
            new += shift
        joined.loops.append((old, new, relative))
        join_points(joined, joined.keyframes[old], joined.keyframes[new], first, second)
        return PlacedMaps((*self.maps[:root], joined, *self.maps[root + 1 :]), where)


def search_older_maps(maps: list[TrackMap], newest: Keyframe, gates: TrackingGates) -> LoopSearch | None:
    """Return the search for the newest keyframe in all maps but the last, or None if there are no keyframes."""
    keyframes = _evenly([keyframe for older in maps[:-1] for keyframe in older.living()], 2 * gates.loops.compared)
    return LoopSearch(newest, keyframes, gates) if keyframes else None


def find_joint(
    maps: Sequence[TrackMap],
    camera: TrackCamera,
    newer: int,
    newest: Keyframe,
    pairs: list[tuple[Keyframe, IntArray, IntArray]],
    options: TrackOptions,
) -> Joint | None:
    """Return how a keyframe of a map joins it to another, if what a search found agrees on one pose.

    Where a map has no metric scale, enough depths must agree on how its unit compares with that of the other.
    """
    joints = []
    for keyframe, first, second in pairs:
        older = next((k for k, submap in enumerate(maps) if keyframe in submap.living()), newer)
        if older == newer:
            continue
        known = [KnownMap(maps[k], camera) for k in (older, newer)]
        place = measure_place(known[0], known[1], keyframe, newest, (first, second), options)
        # No path tells how the maps lie to each other: what one saw may look like another part of the other.
        if place is None or not place.stands_out(camera, options.gates):
            continue
        relative, matches = place.keyframe_from_newest, place.matches(0)
        joints.append(Joint(older, keyframe.index, newer, newest.index, relative, *matches))
    return max(joints, key=lambda joint: len(joint.first), default=None)


def best_joint(
    maps: Sequence[TrackMap], camera: TrackCamera, one: int, two: int, options: TrackOptions
) -> Joint | None:
    """Return the joint of two maps that most agrees with, over an even choice of the keyframes of both."""
    gates = options.gates
    older, newer = (_evenly(maps[k].living(), 2 * gates.loops.compared) for k in (one, two))
    found = (find_joint(maps, camera, two, new, LoopSearch(new, older, gates).run(), options) for new in newer)
    return max((joint for joint in found if joint is not None), key=lambda joint: len(joint.first), default=None)


def _evenly(keyframes: list[Keyframe], count: int) -> list[Keyframe]:
    chosen = np.unique(np.linspace(0, len(keyframes) - 1, count).astype(int))
    return [keyframes[k] for k in chosen] if keyframes else []


def joined_map(track_map: TrackMap, other: TrackMap, here_from_there: FloatArray) -> TrackMap:
    """Return a map of all that two maps hold; the other is moved by a similarity (8,), and its keyframes come last."""
    out, shift = track_map.copy(), len(track_map.keyframes)
    pose, scale = here_from_there[:7], here_from_there[7]
    start = {}
    for kind in ("points", "lines", "planes"):
        mine, theirs = getattr(out, kind), getattr(other, kind)
        start[kind] = len(mine)
        rows = mine.extend(len(theirs))
        for name in theirs.columns:
            getattr(mine, name)[rows] = getattr(theirs, name)
        for name in ("keyframe", "first_keyframe"):
            if name in theirs.columns:
                getattr(mine, name)[rows] = _shifted(getattr(theirs, name), shift)
    points, lines, planes = (slice(start[kind], None) for kind in ("points", "lines", "planes"))
    out.points.xyz[points] = into(pose, scale * other.points.xyz)
    alive = np.flatnonzero(other.lines.alive)
    if len(alive):
        moved = Lines.through(into(pose, scale * other.lines.segment[alive]))
        rows = alive + start["lines"]
        out.lines.segment[rows], out.lines.plucker[rows] = moved.segments, moved.plucker
    out.points.plane[points] = _shifted(other.points.plane, start["planes"])
    out.lines.plane[lines] = _shifted(other.lines.plane, start["planes"])
    out.points.plane_sigma[points] *= scale
    out.lines.plane_sigma[lines] *= scale
    out.planes.hesse[planes] = planes_into(pose, other.planes.hesse * [1.0, 1.0, 1.0, scale])
    out.planes.samples[planes] = into(pose, scale * other.planes.samples)
    out.planes.merged_into[planes] = _shifted(other.planes.merged_into, start["planes"])
    out.keyframes += [_moved(keyframe, here_from_there, shift, start) for keyframe in other.keyframes]
    regrown = [np.concatenate([loop[:4], scale * loop[4:7], loop[7:]]) for *_, loop in other.loops]
    out.loops += [(one + shift, two + shift, loop) for (one, two, _), loop in zip(other.loops, regrown, strict=True)]
    out.pinned |= {index + shift for index in other.pinned}
    return out


def _moved(keyframe: Keyframe, here_from_there: FloatArray, shift: int, start: dict[str, int]) -> Keyframe:
    """Return a keyframe in the world of another map, under its numbers there."""
    tables = {kind: getattr(keyframe.measured, kind) for kind in start}
    measured = {kind: replace(table, index=table.index + start[kind]) for kind, table in tables.items()}
    features, scale = keyframe.features, here_from_there[7]
    there_from_here = se3.inverse(here_from_there[None, :7])
    return replace(
        keyframe,
        index=keyframe.index + shift,
        parent=keyframe.parent + shift if keyframe.parent >= 0 else -1,
        pose=se3.compose(in_unit(keyframe.pose, scale)[None], there_from_here)[0],
        unit=scale * keyframe.unit,
        depth=scale * keyframe.depth,
        measured=replace(keyframe.measured, **measured),
        features=replace(features, point=_shifted(features.point, start["points"])),
    )


def about_submaps(breaks: list[tuple[float, float]], where: Sequence[tuple[int, int]], others: list[int]) -> list[str]:
    """Say where a track broke, and what became of its maps.

    Parameters
    ----------
    breaks
        Times of losses, and of the new maps.
    where
        Of :class:`PlacedMaps`.
    others
        Number of frames of each submap that is not the longest.
    """
    out = [f"The track was lost at {since:.3f} s; a new map was begun at {until:.3f} s." for since, until in breaks]
    joined = sum(root != submap for submap, (root, _) in enumerate(where))
    if joined:
        out.append(f"Joined to an older map, where a place was recognised: {counted(joined, 'new maps')}.")
    if others:
        out.append(
            f"Not joined to the longest submap of the track: {counted(len(others), 'submaps')} "
            f"({', '.join(f'{number:,}' for number in others)} frames), each in a world of its own."
        )
    return out


def _shifted(index: IntArray, by: int) -> IntArray:
    return np.where(index >= 0, index + by, -1)
