# SPDX-License-Identifier: BSD-3-Clause
"""Places seen before: keyframes that recognise them by described features, and maps that are moved and joined there.

Each new keyframe is compared with older ones that share nothing with it. Enough features must match, and agree on one
pose. Its uncertainty is estimated by :mod:`groma.tracking.backend.place_again`; loops are closed by
:mod:`groma.tracking.backend.metric_loops` and :mod:`groma.tracking.backend.scaled_loops`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.geometry import se3
from groma.scene.landmarks import Lines
from groma.tracking.frame.camera import TrackCamera, back, into, planes_back, planes_into
from groma.tracking.frame.descriptor_pairs import pair_anywhere
from groma.tracking.gates import LoopGates, TrackingGates
from groma.tracking.map.feature_points import match_features
from groma.tracking.map.landmarks import ALIVE, DEAD
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.pose.depth_check import depth_agreement
from groma.tracking.pose.relocalise import PlacesOnly, feature_places, pose_from_matches


@dataclass(frozen=True)
class LoopSearch:
    """A new keyframe and older ones that it may close a loop with."""

    newest: Keyframe
    candidates: list[Keyframe]
    gates: TrackingGates
    #: Whether matches of a candidate agree on a pose; None: that is asked later.
    agrees: Callable[[Keyframe, IntArray, IntArray], bool] | None = None
    #: The candidates as they are when the search begins: meanwhile the map changes.
    _known: list[Keyframe] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_known", [copy(keyframe) for keyframe in self.candidates])

    def run(self) -> list[tuple[Keyframe, IntArray, IntArray]]:
        """Return the candidates whose descriptions match best, with the rows of the pairs; no access to the map."""
        features, gates, max_bits = self.newest.features, self.gates.loops, self.gates.features.max_bits
        voters = features.strongest(gates.voters)
        others = (other.features.strongest(gates.voters) for other in self._known)
        votes = np.array([len(pair_anywhere(other, voters, max_bits)[0]) for other in others])
        out = []
        for k in np.argsort(-votes, kind="stable")[: gates.searched]:
            first, second = match_features(self._known[k].features, features, max_bits)
            if len(first) >= gates.min_matches and (self.agrees is None or self.agrees(self._known[k], first, second)):
                out.append((self.candidates[k], first, second))
        return out


def search_for_loop(
    track_map: TrackMap, newest: Keyframe, gates: TrackingGates, camera: TrackCamera | None = None
) -> LoopSearch | None:
    """Return the search that a keyframe is worth, or None if it sees what older ones see anyway.

    With a camera, matches that agree on no pose in the map as it is now are left out.
    """
    living = [k for k in track_map.living() if k.index < newest.index - gates.loops.gap]
    if not living:
        return None
    shared = track_map.shared(newest, living)
    if shared.max(initial=0) >= gates.loops.shared:
        return None
    chosen = np.unique(np.linspace(0, len(living) - 1, gates.loops.compared).astype(int))
    agrees = None
    if camera is not None:
        points: Any = PlacesOnly(track_map.points.xyz.copy(), track_map.points.state.copy())
        agrees = partial(_agrees, replace(track_map, points=points), camera, newest, gates)
    return LoopSearch(newest, [living[k] for k in chosen], gates, agrees)


def _agrees(
    track_map: TrackMap,
    camera: TrackCamera,
    newest: Keyframe,
    gates: TrackingGates,
    keyframe: Keyframe,
    first: IntArray,
    second: IntArray,
) -> bool:
    return agreeing_pose(track_map, camera, keyframe, newest, first, second, gates) is not None


def can_be(
    track_map: TrackMap, keyframe: Keyframe, newest: Keyframe, pose: FloatArray, gates: LoopGates, log_scale: float
) -> bool:
    """Whether errors that add up at random between two keyframes explain how far the newest is from a pose (7,).

    The scale of a single camera is among them: ``log_scale`` is the logarithm of how much it has changed.
    """
    way = [one for one in track_map.living() if keyframe.index <= one.index <= newest.index]
    centers = se3.inverse(np.array([one.pose for one in way]))[:, 4:]
    lever = float(np.linalg.norm(centers - centers[-1], axis=1).max())
    away = se3.log(se3.compose(pose[None], se3.inverse(newest.pose[None])))[0]
    many = gates.jump * math.sqrt(newest.index - keyframe.index)
    turned = math.hypot(gates.turn_sigma, gates.shift_sigma)
    went = np.linalg.norm(away[:3]) < many * (gates.shift_sigma * newest.depth + turned * lever)
    grew = abs(log_scale) < many * gates.shift_sigma
    return bool(went and grew and np.linalg.norm(away[3:]) < many * gates.turn_sigma)


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


def neighbours(track_map: TrackMap, living: list[Keyframe], gates: LoopGates) -> tuple[IntArray, IntArray]:
    """Return which of the living keyframes hold each other: those that follow each other, or see much the same."""
    first, second = [np.arange(len(living) - 1)], [np.arange(1, len(living))]
    for k, keyframe in enumerate(living):
        begin = max(0, k - gates.held_by)
        earlier = living[begin : max(0, k - 1)]
        if earlier:
            index = np.flatnonzero(track_map.shared(keyframe, earlier) > 2 * gates.shared) + begin
            first.append(index)
            second.append(np.full(len(index), k))
    return np.concatenate(first), np.concatenate(second)


def known_loops(track_map: TrackMap, living: list[Keyframe]) -> tuple[IntArray, FloatArray]:
    """Return the loops of the map: positions (n, 2) among the living keyframes, and similarities (n, 8)."""
    place = {keyframe.index: k for k, keyframe in enumerate(living)}
    known = [loop for loop in track_map.loops if loop[0] in place and loop[1] in place]
    ends = np.array([(place[one], place[two]) for one, two, _ in known], dtype=np.int64).reshape(-1, 2)
    return ends, np.array([measured for *_, measured in known]).reshape(-1, 8)


def move(track_map: TrackMap, living: list[Keyframe], similarities: FloatArray) -> None:
    """Move keyframes, and the landmarks that they first saw, to similarities (n, 8), cam_from_world.

    Their scales go into the lengths: what a keyframe saw grows by the inverse of its scale.
    """
    points, lines, planes = track_map.points, track_map.lines, track_map.planes
    of_plane = np.full(len(planes), -1)
    grown = {}
    for keyframe, similarity in zip(living, similarities, strict=True):
        scale = similarity[7]
        new = np.concatenate([similarity[:4], similarity[4:7] / scale])
        rows = np.flatnonzero(points.first_keyframe == keyframe.index)
        points.xyz[rows] = back(new, into(keyframe.pose, points.xyz[rows]) / scale)
        rows = np.flatnonzero((lines.first_keyframe == keyframe.index) & lines.alive)
        if len(rows):
            table = Lines.through(back(new, into(keyframe.pose, lines.segment[rows]) / scale))
            lines.segment[rows], lines.plucker[rows] = table.segments, table.plucker
        rows = keyframe.measured.planes.index
        rows = np.unique(rows[of_plane[rows] < 0])
        of_plane[rows] = keyframe.index
        planes.hesse[rows] = planes_back(new, planes_into(keyframe.pose, planes.hesse[rows]) / [1.0, 1.0, 1.0, scale])
        planes.samples[rows] = back(new, into(keyframe.pose, planes.samples[rows]) / scale)
        keyframe.pose, keyframe.unit, keyframe.depth = new, keyframe.unit / scale, keyframe.depth / scale
        grown[keyframe.index] = 1.0 / scale
    track_map.loops = [
        (one, two, _regrown(measured, grown.get(one, 1.0), grown.get(two, 1.0)))
        for one, two, measured in track_map.loops
    ]


def _regrown(first_from_second: FloatArray, first: float, second: float) -> FloatArray:
    """Return a similarity (8,) between cameras whose units are so much longer now."""
    turn, shift, scale = first_from_second[:4], first_from_second[4:7], first_from_second[7]
    return np.concatenate([turn, first * shift, [scale * first / second]])


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


def join_lines(track_map: TrackMap, pairs: IntArray) -> None:
    """Lines (n, 2) that are the same become one: the first of each pair stays."""
    state = track_map.lines.state
    renamed = np.arange(len(track_map.lines))
    for keep, drop in pairs.tolist():
        # A pair found before may have joined one of them already.
        if state[keep] == ALIVE and state[drop] == ALIVE and keep != drop:
            renamed[renamed == drop] = keep
            state[drop] = DEAD
    for keyframe in track_map.living():
        table = keyframe.measured.lines
        index = renamed[table.index]
        if (index != table.index).any():
            unique = np.unique(index, return_index=True)[1]
            keyframe.measured = replace(keyframe.measured, lines=replace(table, index=index).take(unique))
