# SPDX-License-Identifier: BSD-3-Clause
"""Rigs whose cameras have other poses than the held ones, or are not synchronised.

In comes an adjusted problem of images on rigs; out comes a sentence, or none. From where the adjustment ended a few
steps are taken with more freedom: the places of the cameras on their rigs, if these were held; then a pose of its own
for every image. What either explains is the share of the variance of the residuals of points that disappears, by the
medians, which outliers do not move, less what as many unknowns take up of noise alone. If the first does, the rig is
another than the one that is held; if the second does still, there is no rig: the cameras move against each other, or
the images of a frame were taken at different times.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.adjustment.misfit.lens import LENS, median_px, of_points
from groma.adjustment.stages import with_loss
from groma.factors.contract import Factor, Ref
from groma.factors.losses import Cauchy
from groma.factors.observations.point_reprojection import PointReprojection
from groma.geometry import quaternion, se3
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.scene import Scene
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

#: The group of the places of cameras on their rigs, and that of places of single images.
SENSORS, ALONE = "sensors", "sensors, each image alone"


def rig_that_does_not_fit(scene: Scene, problem: Problem, threads: int | None = None) -> str | None:
    """Return a sentence on rigs that the images contradict, and its remedy; None where they fit or there are none.

    Parameters
    ----------
    scene, problem
        The images with their rigs, and the problem made of them, at its minimum.
    threads : int, optional
        For the few steps with free cameras.
    """
    on_rigs = [f for f in _seen(problem) if f.extrinsics is not None and f.extrinsics.group == SENSORS]
    if not on_rigs or SENSORS not in problem.variables:
        return None
    options, reference = (
        SolverOptions(max_iterations=LENS.rig_iterations, threads=threads),
        scene.sensors.is_reference == 1,
    )
    begun = with_loss(of_points(problem, LENS.max_observations), Cauchy(1.0))
    begun = solve(begun, options).problem
    before = median_px(_seen(begun), begun)
    if not before > 0.0:
        return None
    sensors = begun.variables[SENSORS]
    freed = solve(_with_free_sensors(begun, reference), options).problem if sensors.is_constant else begun
    alone = solve(_with_free_images(freed, reference), options).problem
    on_rig, apart = (median_px(_seen(found), found) for found in (freed, alone))
    if _explained(freed, alone, on_rig, apart) >= LENS.share:
        return (
            "The cameras are not fixed to each other, or their images were not taken at the same moments: with a pose "
            f"for each image the median residual of points would fall from {before:.2f} to {apart:.2f} px. Map without "
            "the rig."
        )
    if _explained(begun, freed, before, on_rig) < LENS.share:
        return None
    moved = _moved(sensors.state, freed.variables[SENSORS].state)
    return (
        "The rig does not fit the images: with free poses of its cameras the median residual of points would fall "
        f"from {before:.2f} to {on_rig:.2f} px, and they would {moved}. "
        "Repeat with --refine-rig, or correct the rig file."
    )


def _seen(problem: Problem) -> list[PointReprojection]:
    return [factor for factor in problem.factors if isinstance(factor, PointReprojection) and len(factor)]


def _explained(problem: Problem, freer: Problem, before: float, after: float) -> float:
    """Return the share of the variance that disappears, less what the additional unknowns take up of noise alone."""
    unknowns, more = (sum(group.num_free for group in one.variables.values()) for one in (problem, freer))
    redundancy = max(problem.num_residuals - unknowns, 1)
    return 1.0 - (after / before) ** 2 - (more - unknowns) / redundancy


def _with_free_sensors(problem: Problem, reference: BoolArray) -> Problem:
    """Return the problem with cameras that may move on their rigs."""
    old = problem.variables[SENSORS]
    return Problem({**problem.variables, SENSORS: Variables(old.manifold, old.state, reference)}, problem.factors)


def _with_free_images(problem: Problem, reference: BoolArray) -> Problem:
    """Return the problem with a pose on the rig for every pair of a frame and a sensor."""
    old = problem.variables[SENSORS]
    pairs = [np.column_stack([f.extrinsics.index, f.pose.index]) for f in _seen(problem) if f.extrinsics is not None]
    every, of = np.unique(np.vstack(pairs), axis=0, return_inverse=True)
    sensor = every[:, 0]
    variables = {**problem.variables, ALONE: Variables(old.manifold, old.state[sensor], reference[sensor])}
    factors: list[Factor] = []
    begin, of = 0, of.ravel()
    for factor in problem.factors:
        if isinstance(factor, PointReprojection) and len(factor) and factor.extrinsics is not None:
            factors.append(replace(factor, extrinsics=Ref(ALONE, of[begin : begin + len(factor)])))
            begin += len(factor)
        else:
            factors.append(factor)
    return Problem(variables, factors)


def _moved(held: FloatArray, found: FloatArray) -> str:
    """Say how far the camera that moves most would turn and shift."""
    change = se3.compose(found, se3.inverse(held))
    angle = np.degrees(np.linalg.norm(quaternion.log(change[:, :4]), axis=1))
    centers = [-quaternion.rotate(quaternion.conjugate(pose[:, :4]), pose[:, 4:]) for pose in (held, found)]
    shift = np.linalg.norm(centers[1] - centers[0], axis=1)
    return f"turn by up to {angle.max():.2g} degrees and shift by up to {shift.max():.2g} units of length"
