# SPDX-License-Identifier: BSD-3-Clause
"""Places seen before: recognised by described features, closed by a pose graph, and their landmarks joined.

Each new keyframe is compared with older ones that share nothing with it. Enough features must match, and agree on one
pose. The error found is spread over the keyframes between by a pose graph (odometry between neighbours, and the loops).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.pose_graph import motion_problem
from groma.factors.losses import Huber
from groma.geometry import se3
from groma.scene.landmarks import Lines
from groma.scene.pose_graph import Motions
from groma.solver.options import SolverOptions
from groma.solver.solve import solve
from groma.tracking.frame.camera import TrackCamera, back, into, planes_back, planes_into
from groma.tracking.gates import LoopGates, TrackingGates
from groma.tracking.map.feature_points import match_features
from groma.tracking.map.landmarks import DEAD
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.pose.depth_check import depth_agreement
from groma.tracking.pose.relocalise import feature_places, pose_from_matches


@dataclass(frozen=True)
class LoopSearch:
    """A new keyframe and older ones that it may close a loop with."""

    newest: Keyframe
    candidates: list[Keyframe]
    gates: TrackingGates

    def run(self) -> list[tuple[Keyframe, IntArray, IntArray]]:
        """Return the candidates whose descriptions match best, with the rows of the pairs; looks at no map."""
        features, gates, max_bits = self.newest.features, self.gates.loops, self.gates.features.max_bits
        strongest = np.argsort(-features.response, kind="stable")[: gates.voters]
        voters = replace(features, pixel=features.pixel[strongest], descriptor=features.descriptor[strongest])
        votes = np.array([len(match_features(other.features, voters, max_bits)[0]) for other in self.candidates])
        out = []
        for k in np.argsort(-votes, kind="stable")[: gates.searched]:
            first, second = match_features(self.candidates[k].features, features, max_bits)
            if len(first) >= gates.min_matches:
                out.append((self.candidates[k], first, second))
        return out


def search_for_loop(track_map: TrackMap, metric: bool, gates: TrackingGates) -> LoopSearch | None:
    """Return the search that the newest keyframe is worth, or None if it sees what older ones see anyway."""
    newest = track_map.last
    living = [k for k in track_map.living() if k.index < newest.index - gates.loops.gap]
    if not living or not metric:
        return None
    shared = track_map.shared(newest, living)
    if shared.max(initial=0) >= gates.loops.shared:
        return None
    chosen = np.unique(np.linspace(0, len(living) - 1, gates.loops.compared).astype(int))
    return LoopSearch(newest, [living[k] for k in chosen], gates)


def close_loop(
    track_map: TrackMap,
    camera: TrackCamera,
    newest: Keyframe,
    pairs: list[tuple[Keyframe, IntArray, IntArray]],
    gates: TrackingGates,
) -> bool:
    """Close a loop with what a search found, if the places agree on one pose; return whether the map was changed."""
    best = None
    for keyframe, first, second in pairs:
        if not (keyframe.alive and newest.alive):
            continue
        found = agreeing_pose(track_map, camera, keyframe, newest, first, second, gates)
        better = found is not None and (best is None or len(found[1]) > len(best[2]))
        if found is not None and better and _can_be(track_map, keyframe, newest, found[0], gates.loops):
            best = (keyframe, *found)
    if best is None:
        return False
    keyframe, pose, first, second = best
    measured = se3.compose(keyframe.pose[None], se3.inverse(pose[None]))[0]
    track_map.loops.append((keyframe.index, newest.index, measured))
    _spread_error(track_map, gates.loops)
    join_points(track_map, keyframe, newest, first, second)
    return True


def _can_be(track_map: TrackMap, keyframe: Keyframe, newest: Keyframe, pose: FloatArray, gates: LoopGates) -> bool:
    """Whether errors that add up at random between two keyframes explain how far the newest is from a pose (7,)."""
    way = [one for one in track_map.living() if keyframe.index <= one.index <= newest.index]
    centers = se3.inverse(np.array([one.pose for one in way]))[:, 4:]
    lever = float(np.linalg.norm(centers - centers[-1], axis=1).max())
    away = se3.log(se3.compose(pose[None], se3.inverse(newest.pose[None])))[0]
    many = gates.jump * math.sqrt(newest.index - keyframe.index)
    went = np.linalg.norm(away[:3]) < many * (gates.shift_sigma * newest.depth + gates.turn_sigma * lever)
    return bool(went and np.linalg.norm(away[3:]) < many * gates.turn_sigma)


def agreeing_pose(
    track_map: TrackMap,
    camera: TrackCamera,
    keyframe: Keyframe,
    newest: Keyframe,
    first: IntArray,
    second: IntArray,
    gates: TrackingGates,
) -> tuple[FloatArray, IntArray, IntArray] | None:
    """Pose (7,) of a keyframe by matches to features of another in a map, and the matches that agree; None without."""
    places = feature_places(track_map, camera, keyframe, first)
    known = np.isfinite(places[:, 0])
    first, second, places = first[known], second[known], places[known]
    found = pose_from_matches(
        camera, places, newest.features.pixel[second], gates.loops.min_inliers, gates.finding.max_error
    )
    if found is None:
        return None
    through = depth_agreement(camera, [keyframe], newest.depth_grid, found[0], gates)[1]
    if through > gates.depth_check.denies:
        return None
    return found[0], first[found[1]], second[found[1]]


def _spread_error(track_map: TrackMap, gates: LoopGates) -> None:
    """Solve the pose graph and move keyframes with what they first saw."""
    living = track_map.living()
    place = {keyframe.index: k for k, keyframe in enumerate(living)}
    poses = np.array([keyframe.pose for keyframe in living])
    first, second = [np.arange(len(living) - 1)], [np.arange(1, len(living))]
    relative = [se3.compose(poses[:-1], se3.inverse(poses[1:]))]
    # Keyframes that see the same hold each other too.
    for k, keyframe in enumerate(living):
        begin = max(0, k - gates.held_by)
        earlier = living[begin : max(0, k - 1)]
        if earlier:
            index = np.flatnonzero(track_map.shared(keyframe, earlier) > 2 * gates.shared) + begin
            first.append(index)
            second.append(np.full(len(index), k))
            relative.append(se3.compose(poses[index], se3.inverse(np.tile(poses[k], (len(index), 1)))))
    for one, two, measured in track_map.loops:
        if one in place and two in place:
            first.append(np.array([place[one]]))
            second.append(np.array([place[two]]))
            relative.append(measured[None])
    held = np.zeros(len(living), dtype=bool)
    held[0] = True
    sigma = np.array([gates.shift_sigma] * 3 + [gates.turn_sigma] * 3)
    motions = Motions(
        np.concatenate(first),
        np.concatenate(second),
        np.concatenate(relative),
        np.tile(np.diag((1.0 / sigma) ** 2), (sum(map(len, first)), 1, 1)),
    )
    problem = motion_problem(poses, held, motions, [(np.arange(len(motions)), Huber(gates.loss))])
    solved = solve(problem, SolverOptions(max_iterations=gates.max_iterations, threads=1))["poses"]
    _move(track_map, living, solved)


def _move(track_map: TrackMap, living: list[Keyframe], poses: FloatArray) -> None:
    points, lines, planes = track_map.points, track_map.lines, track_map.planes
    of_plane = np.full(len(planes), -1)
    for keyframe, new in zip(living, poses, strict=True):
        rows = np.flatnonzero(points.first_keyframe == keyframe.index)
        points.xyz[rows] = back(new, into(keyframe.pose, points.xyz[rows]))
        rows = np.flatnonzero((lines.first_keyframe == keyframe.index) & lines.alive)
        if len(rows):
            table = Lines.through(back(new, into(keyframe.pose, lines.segment[rows])))
            lines.segment[rows], lines.plucker[rows] = table.segments, table.plucker
        rows = keyframe.measured.planes.index
        rows = np.unique(rows[of_plane[rows] < 0])
        of_plane[rows] = keyframe.index
        planes.hesse[rows] = planes_back(new, planes_into(keyframe.pose, planes.hesse[rows]))
        planes.samples[rows] = back(new, into(keyframe.pose, planes.samples[rows]))
        keyframe.pose = new.copy()


def join_points(track_map: TrackMap, old: Keyframe, new: Keyframe, first: IntArray, second: IntArray) -> None:
    """Points of both keyframes at matched features become one: the older one stays."""
    keep, drop = old.features.point[first], new.features.point[second]
    both = (keep >= 0) & (drop >= 0) & (keep != drop)
    both[both] &= (track_map.points.state[keep[both]] != DEAD) & (track_map.points.state[drop[both]] != DEAD)
    keep, drop = keep[both], drop[both]
    if not len(keep):
        return
    renamed = np.arange(len(track_map.points))
    renamed[drop] = keep
    for keyframe in track_map.living():
        table = keyframe.measured.points
        if np.isin(table.index, drop).any():
            index = renamed[table.index]
            unique = np.unique(index, return_index=True)[1]
            keyframe.measured = replace(keyframe.measured, points=replace(table, index=index).take(unique))
        linked = np.flatnonzero(keyframe.features.point >= 0)
        keyframe.features = keyframe.features.linked(linked, renamed[keyframe.features.point[linked]])
    track_map.points.keyframe[keep], track_map.points.pixel[keep] = new.index, new.features.pixel[second][both]
    track_map.points.state[drop] = DEAD


__all__ = ["LoopSearch", "agreeing_pose", "close_loop", "join_points", "search_for_loop"]
