# SPDX-License-Identifier: BSD-3-Clause
r"""Loops of a map with a metric scale: each moves the path as far as the map leaves it open.

The map itself says how well it knows the way from one keyframe to another: with the one held, the covariance
:math:`P` of the other's pose, and its covariance :math:`P_k` with every keyframe k, are those of the adjustment of
all. A place that is recognised measures that pose once more, with the covariance R
(:mod:`groma.tracking.backend.place_again`). With the difference e of both poses (left twist), keyframes move by

.. math:: \delta_k = P_k\,(P + R)^{-1} e,

the least squares of both, to first order. Where the map is surer than the loop, it hardly moves. A loop farther away
than both deviations allow is another place that looks alike, and left out.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.errors import ProblemError
from groma.factors.contract import Ref
from groma.factors.priors.pose_between import PoseBetween
from groma.geometry import se3
from groma.problem.problem import Problem
from groma.solver.covariance.clusters import with_kept
from groma.solver.covariance.marginals import Covariances
from groma.tracking.backend.local_adjustment import job_of
from groma.tracking.backend.loop_closure import move
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
    known, best, corrected = KnownMap(track_map, camera), None, None
    for keyframe, first, second in pairs:
        if not (keyframe.alive and newest.alive):
            continue
        place = measure_place(known, known, keyframe, newest, (first, second), options)
        if place is None or (best is not None and len(place.pairs) <= len(best.pairs)):
            continue
        poses = corrected_path(track_map, camera, place, options)
        if poses is not None:
            best, corrected = place, poses
    if best is None or corrected is None:
        return False
    track_map.loops.append((best.keyframe.index, newest.index, best.keyframe_from_newest))
    move(track_map, track_map.living(), np.column_stack([corrected, np.ones(len(corrected))]))
    join_place(track_map, best, options)
    return True


def corrected_path(
    track_map: TrackMap, camera: TrackCamera, place: PlaceAgain, options: TrackOptions
) -> FloatArray | None:
    """Return the poses (K, 7) of the living keyframes with a place measured again; None where it contradicts them.

    The first keyframe stays where it is.
    """
    living = track_map.living()
    first, last = living.index(place.keyframe), living.index(place.newest)
    shared = _covariances_with(track_map, camera, first, last, options)
    if shared is None:
        return None
    poses = np.array([keyframe.pose for keyframe in living])
    error = se3.log(se3.compose(place.pose[None], se3.inverse(poses[last : last + 1])))[0]
    pull = np.linalg.solve(shared[last] + place.covariance[:6, :6], error)
    if error @ pull > len(error) * options.gates.loops.jump**2:
        return None
    moved = se3.compose(se3.exp(shared @ pull), poses)
    anchor = se3.compose(se3.inverse(moved[:1]), poses[:1])
    return se3.compose(moved, np.tile(anchor, (len(moved), 1)))


def _covariances_with(
    track_map: TrackMap, camera: TrackCamera, held: int, last: int, options: TrackOptions
) -> FloatArray | None:
    """Covariances (K, 6, 6) of the living keyframes' poses with that of one of them, another one held."""
    living = track_map.living()
    job = job_of(track_map, camera, living, np.arange(len(living)) == held, options.relations)
    if job is None:
        return None
    problem = Problem(job.problem.variables, [*job.problem.factors, _steps(living, options.gates.loops)])
    try:
        found = with_kept(Covariances(problem), "frames", last)["frames"]
    except ProblemError:
        return None
    return found if np.isfinite(found).all() else None


def _steps(living: list[Keyframe], gates: LoopGates) -> PoseBetween:
    """Steps from keyframe to keyframe, loosely: they count where a map was followed over a gap without landmarks."""
    poses, row = np.array([keyframe.pose for keyframe in living]), np.arange(len(living) - 1)
    depth = np.array([keyframe.depth for keyframe in living[1:]])
    sigma = gates.jump * np.repeat([[gates.shift_sigma, gates.turn_sigma]], 3, axis=1) * np.ones((len(row), 6))
    sigma[:, :3] *= depth[:, None]
    return PoseBetween(
        first=Ref("frames", row),
        second=Ref("frames", row + 1),
        first_from_second=se3.compose(poses[:-1], se3.inverse(poses[1:])),
        sqrt_information=np.eye(6) / sigma[:, None],
    )


__all__ = ["close_loop", "corrected_path"]
