# SPDX-License-Identifier: BSD-3-Clause
"""A solved problem in another frame of its world: scenes far from the origin are solved near it, and moved back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.assemble import point_variables
from groma.factors.contract import Factor
from groma.factors.priors.distance import Distance
from groma.factors.priors.on_known_plane import OnKnownPlane
from groma.factors.priors.pose_prior import PosePrior
from groma.factors.priors.position_prior import PositionPrior
from groma.factors.priors.vector_prior import VectorPrior
from groma.factors.relations.line_on_plane import SegmentOnPlane
from groma.factors.relations.on_plane_pixels import SegmentOnPlanePixels
from groma.geometry import quaternion, se3
from groma.geometry.manifold import Euclidean
from groma.problem.problem import Problem
from groma.scene import Scene


def problem_at(problem: Problem, scene: Scene, shifted: bool = True) -> Problem:
    """Return the problem with frames and landmarks where a scene has them.

    Where that is the same scene, its world shifted, what factors measure in the world is shifted with it; not if only
    the scene moved.
    """
    variables = dict(problem.variables)
    states = {
        "frames": scene.frames.rig_from_world,
        "sensors": scene.sensors.cam_from_rig,
        "control_points": scene.control_points.xyz,
        "directions": scene.directions.vectors,
    }
    for name, group in problem.variables.items():
        if name in states:
            state = states[name]
        elif name == "points":
            state = point_variables(scene, "euclidean" if isinstance(group.manifold, Euclidean) else "auto").state
        elif name in ("lines", "planes"):
            state = group.manifold.from_ambient(scene.lines.plucker if name == "lines" else scene.planes.hesse)
        else:
            continue
        variables[name] = group.with_state(state)
    if not shifted or "frames" not in variables or not any(isinstance(factor, _IN_WORLD) for factor in problem.factors):
        return Problem(variables, problem.factors)
    before, after = (se3.inverse(group["frames"].state)[:, 4:] for group in (problem.variables, variables))
    shift = np.median(after - before, axis=0)
    return Problem(variables, [_shifted(factor, shift) for factor in problem.factors])


_IN_WORLD = (PositionPrior, PosePrior, VectorPrior, Distance, OnKnownPlane, SegmentOnPlane, SegmentOnPlanePixels)


def _shifted(factor: Factor, shift: FloatArray) -> Factor:
    """Return factors that measure in the world after it was shifted."""
    if isinstance(factor, PositionPrior):
        return replace(factor, cam_center_in_world=factor.cam_center_in_world + shift)
    if isinstance(factor, VectorPrior) and factor.variable.group in ("points", "control_points"):
        return replace(factor, measured=factor.measured + shift)
    if isinstance(factor, PosePrior) and factor.pose.group == "frames":
        poses = factor.cam_from_world.copy()
        poses[:, 4:] -= quaternion.rotate(poses[:, :4], np.tile(shift, (len(poses), 1)))
        return replace(factor, cam_from_world=poses)
    if isinstance(factor, Distance) and factor.first_camera is None:
        return replace(factor, first_arm=factor.first_arm + shift)
    if isinstance(factor, SegmentOnPlanePixels) or (isinstance(factor, SegmentOnPlane) and factor.frame is None):
        return replace(factor, ends=factor.ends + shift)
    if isinstance(factor, OnKnownPlane):
        known = factor.known.copy()
        known[:, 3] -= known[:, :3] @ shift
        return replace(factor, known=known, arm=factor.arm if factor.camera is not None else factor.arm + shift)
    return factor
