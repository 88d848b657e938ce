# SPDX-License-Identifier: BSD-3-Clause
r"""Lines that settled in a minimum of their own are triangulated anew, and all of them settle under held cameras.

The reprojection cost of a line has several local minima: a start on the wrong side of a short baseline ends in one that
small steps never leave. A few such lines hold up the whole adjustment, because cameras move to please them. With the
cameras nearly right the linear triangulation of a line is near its global minimum. It replaces a line that fits
:data:`SUSPICIOUS` times worse than lines usually do, if after some steps on its own its cost is lower.

A line that is seen nearly along its length is strongly bent: Gauss-Newton steps of it overshoot, and joint steps of all
variables are refused because of one line. Lines that start in the minimum that the cameras at hand give them hardly
move in later steps.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.cameras import model as camera_model
from groma.estimators.line_triangulation import triangulate_planes
from groma.factors._factor import Factor
from groma.geometry import line3, quaternion
from groma.problem.problem import Problem
from groma.scene import Scene
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

#: A line is suspicious if its mean squared residual is this many times the median of all lines.
SUSPICIOUS = 4.0
#: Steps of a suspicious line on its own, from both starts.
STEPS = 10
#: Most steps of all lines on their own; most need two or three.
SETTLING_STEPS = 20


def restart_lines(scene: Scene, problem: Problem, line_factors: tuple[str, ...]) -> Problem | None:
    """Return the problem with better lines, or None if there are none.

    Parameters
    ----------
    scene : Scene
        The scene at the states of the problem.
    problem : Problem
        A problem with a group ``lines`` in the order of the scene.
    line_factors : tuple of str
        Type names of the factors that observe lines.
    """
    factors = [factor for factor in problem.factors if factor.type_name in line_factors and len(factor)]
    variables = problem.variables.get("lines")
    if variables is None or variables.is_constant or not factors:
        return None
    cost, count = _line_costs(problem, factors)
    enough: BoolArray = np.asarray(count >= 3)
    if not enough.any():
        return None
    per_view = cost / np.maximum(count, 1)
    chosen = np.flatnonzero(enough & (per_view > SUSPICIOUS * max(float(np.median(per_view[enough])), 1e-12)))
    if len(chosen) == 0:
        return None
    triangulated, found = _triangulated(scene, chosen)
    if not found.any():
        return None
    chosen = chosen[found]
    mine = [_of_lines(factor, chosen) for factor in factors]
    alone = {name: replace(group, constant=name != "lines") for name, group in problem.variables.items()}
    anew = variables.state.copy()
    anew[chosen] = variables.manifold.from_ambient(triangulated[found])
    trials = []
    for state in (variables.state, anew):
        start = Problem({**alone, "lines": replace(variables, state=state)}, mine)
        settled = solve(start, SolverOptions(max_iterations=STEPS, threads=1)).problem
        trials.append((settled.variables["lines"].state, _line_costs(settled, mine)[0]))
    (old_state, old_cost), (new_state, new_cost) = trials
    best = np.where((new_cost < old_cost)[:, None], new_state, old_state)
    better = np.zeros(len(cost), dtype=bool)
    better[chosen] = np.minimum(new_cost, old_cost)[chosen] < cost[chosen] * (1.0 - 1e-3)
    if not better.any():
        return None
    state = np.where(better[:, None], best, variables.state)
    return Problem({**problem.variables, "lines": replace(variables, state=state)}, problem.factors)


def settle_lines(problem: Problem, threads: int | None = None) -> Problem:
    """Return the problem with each line at the minimum of its own cost, everything else held.

    Parameters
    ----------
    problem : Problem
        A problem; without free lines it comes back as it is.
    threads : int, optional
        Threads; None takes one for small problems and all cores for large ones.
    """
    lines = problem.variables.get("lines")
    mine = [factor for factor in problem.factors if any(ref.group == "lines" for _, ref in factor.references())]
    if lines is None or lines.is_constant or not mine:
        return problem
    used = {ref.group for factor in mine for _, ref in factor.references()}
    alone = {n: replace(group, constant=True) for n, group in problem.variables.items() if n in used and n != "lines"}
    options = SolverOptions(max_iterations=SETTLING_STEPS, threads=threads)
    settled = solve(Problem({**alone, "lines": lines}, mine), options).problem.variables["lines"]
    return Problem({**problem.variables, "lines": settled}, problem.factors)


def _of_lines(factor: Factor, lines: IntArray) -> Factor:
    return factor.take(np.flatnonzero(np.isin(_line_of(factor), lines)))


def _line_of(factor: Factor) -> IntArray:
    return next(ref.index for _, ref in factor.references() if ref.group == "lines")


def _line_costs(problem: Problem, factors: list[Factor]) -> tuple[FloatArray, IntArray]:
    """Return the cost of each line, with noise and loss, and how often it is seen."""
    total = np.zeros(len(problem.variables["lines"]))
    count = np.zeros(len(total), dtype=np.int64)
    for factor in factors:
        ambients = tuple(problem.variables[ref.group].ambient() for _, ref in factor.references())
        residual = np.empty((len(factor), factor.residual_size))
        factor.residuals(factor.prepare(ambients), 0, len(factor), residual)
        squared = (residual**2).sum(axis=1) * np.asarray(factor.sqrt_information) ** 2
        total += np.bincount(_line_of(factor), weights=factor.loss.evaluate(squared)[0], minlength=len(total))
        count += np.bincount(_line_of(factor), minlength=len(total))
    return total, count


def _triangulated(scene: Scene, lines: IntArray) -> tuple[FloatArray, BoolArray]:
    """Return Plücker lines (n, 6) where the planes of their views meet best, and which of them are finite."""
    table = scene.line_observations
    rows = np.flatnonzero(np.isin(table.line_idx, lines))
    rows = rows[np.argsort(table.line_idx[rows], kind="stable")]
    image = table.image_idx[rows]
    bearings = np.full((len(rows), 2, 3), np.nan)
    for c in np.unique(scene.images.camera_idx[image]):
        model = camera_model(scene.cameras.models[c])
        mine = np.flatnonzero(scene.images.camera_idx[image] == c)
        params = scene.cameras.params[c, : model.num_parameters]
        for end in (0, 1):
            pixels = np.ascontiguousarray(table.segment[rows[mine], 2 * end : 2 * end + 2])
            bearings[mine, end] = model.unproject(params, pixels)
    poses = scene.cam_from_world[image]
    world_from_cam = quaternion.conjugate(poses[:, :4])
    normal = quaternion.rotate(world_from_cam, np.cross(bearings[:, 0], bearings[:, 1]))
    center = -quaternion.rotate(world_from_cam, poses[:, 4:])
    planes = np.concatenate([normal, -np.einsum("ni,ni->n", normal, center)[:, None]], axis=1)
    usable: BoolArray = np.asarray(np.isfinite(planes).all(axis=1))
    weight = np.where(usable, np.linalg.norm(np.where(usable[:, None], normal, 0.0), axis=1), 0.0)
    pointers = np.concatenate([[0], np.cumsum(np.bincount(table.line_idx[rows], minlength=scene.num_lines)[lines])])
    result = triangulate_planes(planes, pointers, center, weight)
    found: BoolArray = np.asarray(line3.is_finite(result.line) & (np.abs(result.line) > 0).any(axis=1))
    return result.line, found
