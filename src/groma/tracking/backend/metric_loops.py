# SPDX-License-Identifier: BSD-3-Clause
"""Loops of a map with a metric scale: each is one more measurement of the map, as sure as its features are.

A place that is recognised measures the motion between two keyframes, with a covariance
(:mod:`groma.tracking.backend.place_again`). All keyframes and landmarks are adjusted together with it, so the path
moves as far as the map leaves it open, and where it does. Twice the rise of the cost over that of the map alone is the
squared distance of the loop from the path in standard deviations of both; one that is too far is another place that
looks alike, and left out. Deviations of a path by its map are too small by a factor of two or three, so too far is
several times them, on the average of six components.
"""

from __future__ import annotations

import numpy as np

from groma._typing import IntArray
from groma.adjustment.assemble import assemble
from groma.adjustment.graphs.pose_graph import motion_factors
from groma.geometry import se3
from groma.problem.problem import Problem
from groma.scene.pose_graph import Motions
from groma.solver.options import SolverOptions
from groma.solver.solve import solve
from groma.tracking.backend.local_adjustment import AdjustmentJob, job_of
from groma.tracking.backend.place_again import KnownMap, PlaceAgain, join_place, measure_place
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.gates import LoopGates
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.options import TrackOptions


def close_loop(
    track_map: TrackMap,
    camera: TrackCamera,
    newest: Keyframe,
    pairs: list[tuple[Keyframe, IntArray, IntArray]],
    options: TrackOptions,
) -> bool:
    """Close a loop with what a search found, if the map allows for it; return whether the map was changed."""
    known, best, adjusted = KnownMap(track_map, camera), None, None
    for keyframe, first, second in pairs:
        if not (keyframe.alive and newest.alive):
            continue
        place = measure_place(known, known, keyframe, newest, (first, second), options)
        if place is None or (best is not None and len(place.pairs) <= len(best.pairs)):
            continue
        job = adjusted_with(track_map, camera, place, options)
        if job is not None:
            best, adjusted = place, job
    if best is None or adjusted is None:
        return False
    track_map.loops.append((best.keyframe.index, newest.index, best.keyframe_from_newest))
    adjusted.apply(track_map)
    join_place(track_map, best, options)
    return True


def adjusted_with(
    track_map: TrackMap, camera: TrackCamera, place: PlaceAgain, options: TrackOptions
) -> AdjustmentJob | None:
    """Return the adjustment of a map with a place measured again; None where that contradicts the map.

    The first keyframe stays where it is.
    """
    living, gates = track_map.living(), options.gates.loops
    job = job_of(track_map, camera, living, np.arange(len(living)) == 0, options.relations, gates.max_iterations)
    if job is None:
        return None
    start = assemble(job.scene, job.options).problem
    alone = Problem(start.variables, [*start.factors, motion_factors(_steps(living, gates), "frames")])
    again = Motions(
        np.array([living.index(place.keyframe)]),
        np.array([living.index(place.newest)]),
        se3.compose(place.keyframe.pose[None], se3.inverse(place.pose[None])),
        np.asarray(np.linalg.inv(place.covariance[None, :6, :6]), np.float64),
    )
    settings = SolverOptions(max_iterations=gates.max_iterations, function_tolerance=1e-4, threads=1)
    before = solve(alone, settings)
    after = solve(Problem(before.problem.variables, [*alone.factors, motion_factors(again, "frames")]), settings)
    job.solved, job.report = after.problem, after.report
    rise = 2.0 * (after.report.final_cost - before.report.final_cost)
    return job if rise < 6.0 * gates.jump**2 else None  # derived from the six numbers of a motion


def _steps(living: list[Keyframe], gates: LoopGates) -> Motions:
    """Steps from keyframe to keyframe, loosely: they count where a map was followed over a gap without landmarks."""
    poses, row = np.array([keyframe.pose for keyframe in living]), np.arange(len(living) - 1)
    depth = np.array([keyframe.depth for keyframe in living[1:]])
    sigma = gates.jump * np.repeat([[gates.shift_sigma, gates.turn_sigma]], 3, axis=1) * np.ones((len(row), 6))
    sigma[:, :3] *= depth[:, None]
    relative = se3.compose(poses[:-1], se3.inverse(poses[1:]))
    return Motions(row, row + 1, relative, np.eye(6) / sigma[:, :, None] ** 2)
