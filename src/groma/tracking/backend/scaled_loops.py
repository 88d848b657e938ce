# SPDX-License-Identifier: BSD-3-Clause
"""Loops of a single camera: closed with their scale, which drifts like position and direction.

A place that is recognised is in the map twice, as it was seen first and as it was seen again, with a similarity between
both copies (:mod:`groma.tracking.backend.place_again`). A graph of similarities spreads the error, scale included,
over the keyframes (:mod:`groma.adjustment.graphs.similarity_graph`); landmarks follow the keyframes that saw them
first, and what was matched becomes one.
"""

from __future__ import annotations

import numpy as np

from groma.adjustment.graphs.similarity_graph import SimilarityGraphResult, SimilarityMotions, adjust_similarity_graph
from groma.geometry import sim3
from groma.solver.options import SolverOptions
from groma.tracking.backend.loop_closure import can_be, known_loops, move, neighbours, search_for_loop
from groma.tracking.backend.place_again import KnownMap, PlaceAgain, join_place, measure_place
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.gates import LoopGates
from groma.tracking.map.track_map import TrackMap
from groma.tracking.options import TrackOptions


def close_scaled_loops(track_map: TrackMap, camera: TrackCamera, options: TrackOptions) -> int:
    """Close the loops of a map whose scale may drift; return how many there are.

    Loops that the others contradict are left out.
    """
    gates, loops = options.gates.loops, _find_loops(track_map, camera, options)
    while loops:
        solved = _solved(track_map, loops, gates)
        errors = solved.chi_square[-len(loops) :]
        if errors.max() < gates.jump**2:
            track_map.loops += [(loop.keyframe.index, loop.newest.index, loop.keyframe_from_newest) for loop in loops]
            move(track_map, track_map.living(), solved.cam_from_world)
            for loop in loops:
                join_place(track_map, loop, options)
            break
        loops.pop(int(errors.argmax()))
    return len(loops)


def _find_loops(track_map: TrackMap, camera: TrackCamera, options: TrackOptions) -> list[PlaceAgain]:
    """Search all keyframes for places seen before; the map is not changed."""
    known, out, gates = KnownMap(track_map, camera), [], options.gates
    for newest in track_map.living():
        search, best = search_for_loop(track_map, newest, gates), None
        for keyframe, *matches in search.run() if search is not None else []:
            place = measure_place(known, known, keyframe, newest, (matches[0], matches[1]), options)
            if place is None or (best is not None and len(place.pairs) <= len(best.pairs)):
                continue
            if can_be(track_map, keyframe, newest, place.pose, gates.loops, place.log_scale):
                best = place
        if best is not None:
            out.append(best)
    return out


def _solved(track_map: TrackMap, loops: list[PlaceAgain], gates: LoopGates) -> SimilarityGraphResult:
    """Solve the graph of similarities of the living keyframes: neighbours, loops known before, and these loops."""
    living = track_map.living()
    place = {keyframe.index: k for k, keyframe in enumerate(living)}
    poses = np.array([np.append(keyframe.pose, 1.0) for keyframe in living])
    first, second = neighbours(track_map, living, gates)
    # Where maps were joined, keyframes follow each other that have nothing in common.
    common = [track_map.shared(living[one], [living[two]])[0] > 0 for one, two in zip(first, second, strict=True)]
    first, second = first[common], second[common]
    ends, known = known_loops(track_map, living)
    new = np.array([(place[loop.keyframe.index], place[loop.newest.index]) for loop in loops])
    every = np.concatenate([np.column_stack([first, second]), ends, new])
    drift = np.array([gates.shift_sigma] * 3 + [gates.turn_sigma] * 3 + [gates.shift_sigma])
    sigma = np.tile(drift, (len(every), 1))
    sigma[:, :3] *= np.array([living[k].depth for k in every[:, 1]])[:, None]
    covariance = sigma[:, :, None] ** 2 * np.eye(7)
    # Places that were recognised err like neighbours, and by what their points leave open.
    covariance[-len(loops) :] += [loop.covariance for loop in loops]
    relative = sim3.compose(poses[first], sim3.inverse(poses[second]))
    measured = np.concatenate([relative, known, [loop.keyframe_from_newest for loop in loops]])
    motions = SimilarityMotions(every[:, 0], every[:, 1], measured, covariance)
    options = SolverOptions(max_iterations=gates.max_iterations, threads=1)
    return adjust_similarity_graph(poses, motions, options=options)
