# SPDX-License-Identifier: BSD-3-Clause
"""How near to a survey photographs can bring their cameras at all."""

from dataclasses import replace

import numpy as np

import groma
from groma.adjustment.assemble import assemble, disassemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.pixel_residuals import squared_residuals_px
from groma.evaluation.alignment import align_points
from groma.factors import Ref
from groma.factors.priors.position_prior import PositionPrior
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.scene import Scene
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

#: Twice the logarithm of the likelihood that a result nearer the survey may cost.
PRICES = (4.0, 9.0, 25.0)


def one_among_surveyed(placed: Scene, options: groma.AdjustOptions) -> np.ndarray:
    """Distances (N,) of cameras from their surveyed places, each placed by the points while the others are held."""
    held = solved(placed, replace(options, refine_poses=False))
    frames, away = held.variables["frames"], np.zeros(placed.num_images)
    for image in range(placed.num_images):
        constant = np.ones((len(frames), 6), dtype=bool)
        constant[placed.images.frame_idx[image]] = False
        variables = {**held.variables, "frames": Variables(frames.manifold, frames.state, constant)}
        moved = disassemble(placed, solve(Problem(variables, held.factors), SolverOptions()).problem)
        away[image] = np.linalg.norm(moved.cam_centers_in_world[image] - placed.cam_centers_in_world[image])
    return away


def nearest_at(scene: Scene, centers: np.ndarray, options: groma.AdjustOptions) -> list[float]:
    """Root mean square of the centres at each of the prices, pulling the cameras to the survey ever harder."""
    # What an adjustment leaves is little against its cost, but not against these prices.
    exact = SolverOptions(function_tolerance=1e-9, max_iterations=100, landmark_steps=2)
    free = solve(solved(scene, replace(options, gauge="free")), exact)
    problem, factors, cost = free.problem, free.problem.factors, free.report.final_cost
    away = np.sqrt(np.mean((scene.cam_centers_in_world - centers) ** 2))
    path = []
    for sigma in away * np.geomspace(4.0, 0.05, 20):
        pull = PositionPrior(
            pose=Ref("frames", scene.images.frame_idx),
            cam_center_in_world=centers,
            sqrt_information=np.full(len(centers), 1.0 / sigma),
        )
        pulled = solve(Problem(problem.variables, [*factors, pull]), exact).problem
        problem = Problem(pulled.variables, factors)
        price = 2.0 * (solve(problem, SolverOptions(max_iterations=0)).report.final_cost - cost)
        found = disassemble(scene, problem)
        found = found.transformed(align_points(found.cam_centers_in_world, centers)).cam_centers_in_world
        path.append((price, float(np.sqrt(np.mean(((found - centers) ** 2).sum(axis=1))))))
        if price > PRICES[-1]:
            break
    prices, rms = np.array(path).T
    return np.interp(PRICES, np.maximum.accumulate(prices), rms).tolist()


def solved(scene: Scene, options: groma.AdjustOptions) -> Problem:
    """The adjusted problem, at its solution."""
    problem = groma.adjust(scene, options).problem
    assert problem is not None
    return problem


def calibrated(scene: Scene, options: groma.AdjustOptions) -> tuple[Scene, float]:
    """The points' adjustment with pinhole parameters and distortion estimated, and twice the likelihood it gains."""
    cameras = scene.cameras
    params = np.hstack([cameras.params[:, :4], np.zeros((len(cameras), 4))])
    bent = scene.replace(cameras=cameras.replace(models=("OPENCV",) * len(cameras), params=params))
    held = groma.adjust(scene, options)
    free = groma.adjust(bent, replace(options, refine_intrinsics=True, refine_principal_point=True))
    return free.scene, 2.0 * (held.report.solve.final_cost - free.report.solve.final_cost)


def tail_freedom(scene: Scene) -> float:
    """Degrees of freedom of Student's distribution that fits the points' residuals best; at most a hundred."""
    assembly = assemble(scene, AssemblyOptions(lines=False, planes=False))
    squares = squared_residuals_px(assembly, weighted=True)["points"]
    surprise = []
    for freedom in (freedoms := np.geomspace(1.0, 100.0, 60)):
        variance = np.median(squares)
        for _ in range(30):
            variance = 0.5 * np.mean((freedom + 2.0) * squares / (freedom + squares / variance))
        surprise.append(np.log(variance) + (freedom / 2 + 1) * np.mean(np.log1p(squares / (freedom * variance))))
    return float(freedoms[np.argmin(surprise)])
