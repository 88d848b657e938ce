# SPDX-License-Identifier: BSD-3-Clause
r"""Restart of lines in wrong local minima, between two stages of an adjustment, with cameras held.

The reprojection cost of a line has several local minima. A start on the wrong side of a short baseline converges to one
that small steps never leave, and a few such lines hold up the whole adjustment because cameras adapt to them. Once the
cameras are nearly right, the linear triangulation of a line is close to its global minimum. A line that fits much worse
than the median is therefore solved from there as well, and the better of the two results is kept.

The cost of a line that is seen almost along its length is strongly nonlinear: Gauss-Newton steps overshoot, and joint
steps of all variables are rejected because of one line. Lines that start at their minimum for the current cameras
hardly move in later steps.

All lines, and the second starts as additional lines, are one problem of independent variables. It is laid out once, and
each line stops when it has converged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from groma._rows import pointers_of
from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.assemble import disassemble
from groma.adjustment.terms.lines import LINE_FACTORS
from groma.cameras import model as camera_model
from groma.estimators.line_ends import SegmentRays, trim
from groma.estimators.line_triangulation import triangulate_planes
from groma.estimators.trimming import TrimStatus, trim_to_ray
from groma.factors.contract import Factor, Ref
from groma.gates import SURVEYED, gate
from groma.geometry import line3, quaternion, segment2
from groma.problem.problem import Problem
from groma.problem.residuals import squared_norms
from groma.problem.variables import Variables
from groma.scene import Scene
from groma.solver.options import SolverOptions
from groma.solver.solve import solve


@dataclass(frozen=True)
class RestartGates:
    """Which lines are started again, and which of them went elsewhere."""

    suspicious: float = gate(
        2.0,
        "1",
        "mean squared residual over the median of all lines, from which a line is started twice",
        "cost: a few right lines are started twice; some wrong minima fit hardly worse than the right one",
    )
    min_views: int = gate(3, "observations", "of a line that can be suspicious", "derived from two that fix a line")
    elsewhere: float = gate(0.02, "1", "distance over its length by which a line moved", SURVEYED)
    max_steps: int = gate(20, "steps", "of a line on its own", "cost: most need two or three")


GATES = RestartGates()


def renew_lines(scene: Scene, problem: Problem, threads: int | None = None) -> tuple[Problem, IntArray]:
    """Return the problem with each line at a minimum of its cost, all else held, and the restarted lines that moved.

    Parameters
    ----------
    scene : Scene
        What the problem was made from.
    problem : Problem
        A problem at any state, with its lines in the order of the scene; returned unchanged if no line is free.
    threads : int, optional
        Threads; None takes one for small problems and all cores for large ones.
    """
    lines = problem.variables.get("lines")
    factors = [
        factor
        for factor in problem.factors
        if len(factor) and [ref.group for _, ref in factor.references()].count("lines") == 1
    ]
    if lines is None or lines.is_constant or not factors:
        return problem, np.zeros(0, np.int64)
    chosen, second = _second_starts(scene, problem, factors)
    doubled = [_with_second(factor, chosen, len(lines)) for factor in factors]
    used = {ref.group for factor in factors for _, ref in factor.references()} - {"lines"}
    held = {name: replace(problem.variables[name], constant=True) for name in used}
    starts = Problem({**held, "lines": _joined(lines, chosen, second)}, doubled)
    options = SolverOptions(max_iterations=GATES.max_steps, threads=threads)
    solved = solve(starts, options).problem
    first, other = np.split(solved.variables["lines"].state, [len(lines)])
    cost = _line_costs(solved, doubled)[0] if len(chosen) else np.zeros(len(lines))
    better: BoolArray = cost[len(lines) :] < cost[chosen]
    first = first.copy()
    first[chosen[better]] = other[better]
    moved = problem.with_states({"lines": first})
    before, after = (p.variables["lines"].ambient()[chosen] for p in (problem, moved))
    return moved, chosen[went_elsewhere(scene.lines.segments[chosen], before, after)]


def went_elsewhere(segments: FloatArray, before: FloatArray, after: FloatArray) -> BoolArray:
    """Whether the places of segments (n, 2, 3) on lines before (n, 6) are far from the lines after; also if unknown."""
    feet = line3.closest_point(before[:, None], segments)
    away = line3.distance_to_point(after[:, None], feet).max(axis=1)
    return np.asarray(~(away <= GATES.elsewhere * np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)))


def _slot_of_lines(factor: Factor) -> str:
    return next(slot.name for slot, ref in factor.references() if ref.group == "lines")


def _line_of(factor: Factor) -> IntArray:
    return getattr(factor, _slot_of_lines(factor)).index


def _with_second(factor: Factor, chosen: IntArray, count: int) -> Factor:
    """Return the factors, and once more those of the chosen lines, for the lines from ``count`` on."""
    if len(chosen) == 0:
        return factor
    number = np.full(count, -1)
    number[chosen] = count + np.arange(len(chosen))
    line = _line_of(factor)
    again = np.flatnonzero(number[line] >= 0)
    both = factor.take(np.concatenate([np.arange(len(factor)), again]))
    index = Ref("lines", np.concatenate([line, number[line[again]]]))
    return replace(both, **{_slot_of_lines(factor): index})


def _joined(lines: Variables, chosen: IntArray, second: FloatArray) -> Variables:
    """Return the lines and after them the second starts (Plücker) of the chosen ones."""
    constant = lines.constant
    if not isinstance(constant, bool | np.bool_):
        constant = np.concatenate([constant, constant[chosen]])
    state = np.concatenate([lines.state, lines.manifold.from_ambient(second)])
    return replace(lines, state=state, constant=constant)


def _second_starts(scene: Scene, problem: Problem, factors: list[Factor]) -> tuple[IntArray, FloatArray]:
    """Return the lines that are suspicious, and each triangulated anew, (n, 6)."""
    cost, count = _line_costs(problem, [factor for factor in factors if factor.type_name in LINE_FACTORS])
    enough: BoolArray = np.asarray(count >= GATES.min_views)
    per_view = cost / np.maximum(count, 1)
    usual = float(np.median(per_view[enough])) if enough.any() else 0.0
    chosen = np.flatnonzero(enough & (per_view > GATES.suspicious * max(usual, 1e-12)))
    if len(chosen) == 0:
        return chosen, np.zeros((0, 6))
    triangulated, found = triangulated_anew(with_cameras(scene, problem), chosen)
    return chosen[found], triangulated[found]


def with_cameras(scene: Scene, problem: Problem) -> Scene:
    """Return the scene with the cameras of the problem."""
    landmarks = ("points", "lines", "planes", "directions")
    cameras = {name: group for name, group in problem.variables.items() if name not in landmarks}
    return disassemble(scene, Problem(cameras, []))


def _line_costs(problem: Problem, factors: list[Factor]) -> tuple[FloatArray, IntArray]:
    """Return the cost of each line, with noise and loss, and how many of the factors there are for it."""
    total = np.zeros(len(problem.variables["lines"]))
    count = np.zeros(len(total), dtype=np.int64)
    for factor in factors:
        squared = squared_norms(factor, problem.variables)
        total += np.bincount(_line_of(factor), weights=factor.loss.evaluate(squared)[0], minlength=len(total))
        count += np.bincount(_line_of(factor), minlength=len(total))
    return total, count


def triangulated_anew(scene: Scene, lines: IntArray) -> tuple[FloatArray, BoolArray]:
    """Return Plücker lines (n, 6) where the planes of their views meet best, and which of them are finite."""
    table = scene.line_observations
    rows = np.flatnonzero(np.isin(table.line_idx, lines))
    rows = rows[np.argsort(table.line_idx[rows], kind="stable")]
    center, rays = viewing_rays(scene, rows)
    normal = np.cross(rays[:, 0], rays[:, 1])
    planes = np.concatenate([normal, -np.einsum("ni,ni->n", normal, center)[:, None]], axis=1)
    usable: BoolArray = np.asarray(np.isfinite(planes).all(axis=1))
    weight = np.where(usable, np.linalg.norm(np.where(usable[:, None], normal, 0.0), axis=1), 0.0)
    pointers = pointers_of(np.bincount(table.line_idx[rows], minlength=scene.num_lines)[lines])
    result = triangulate_planes(planes, pointers, center, weight)
    found: BoolArray = np.asarray(line3.is_finite(result.line) & (np.abs(result.line) > 0).any(axis=1))
    return result.line, found


def with_seen_ends(scene: Scene, lines: IntArray) -> Scene:
    """Return the scene with new end points of lines that went elsewhere: where its images end them.

    The projections of the old end points may lie anywhere on such a line. New ones follow the rule of mapping
    (:mod:`groma.estimators.line_ends`), starting at the medians of the ends of the segments.
    """
    table = scene.line_observations
    rows = np.flatnonzero(np.isin(table.line_idx, lines))
    center, rays = viewing_rays(scene, rows)
    plucker = scene.lines.plucker[table.line_idx[rows]]
    seen = trim_to_ray(plucker[:, None], center[:, None], rays)
    good = np.flatnonzero((seen.status == TrimStatus.OK).all(axis=1))
    owner, d = table.line_idx[rows[good]], plucker[good, 3:] / np.linalg.norm(plucker[good, 3:], axis=1, keepdims=True)
    along = np.sort(np.einsum("nej,nj->ne", seen.point[good], d), axis=1)
    chosen, first, count = np.unique(np.sort(owner), return_index=True, return_counts=True)
    segments, plucker = scene.lines.segments.copy(), scene.lines.plucker[chosen]
    length = np.linalg.norm(plucker[:, 3:], axis=1, keepdims=True)
    foot = np.cross(plucker[:, 3:], plucker[:, :3]) / length**2
    for end, middle in enumerate((count // 2, (count - 1) // 2)):
        place = along[np.lexsort((along[:, end], owner))[first + middle], end]
        segments[chosen, end] = foot + place[:, None] * plucker[:, 3:] / length
    by_line = good[np.argsort(owner, kind="stable")]
    pixels = segment2.length(table.segment[rows])
    seen_from = SegmentRays(center, np.arange(len(rows)), rays, pixels)
    everything = np.ones(len(good), np.bool_)
    X, _ = trim(seen_from, np.append(first, len(good)), by_line, everything, segments[chosen])
    backward = ((X[:, 1] - X[:, 0]) * plucker[:, 3:]).sum(axis=1) < 0.0
    X[backward] = X[backward, ::-1]
    segments[chosen] = X
    table = scene.line_intervals
    kept = table.take(~np.isin(table.line_idx, chosen))  # what was seen of the others is no longer there
    return scene.replace(lines=scene.lines.replace(segments=segments), line_intervals=kept)


def viewing_rays(scene: Scene, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return camera centres (n, 3) and the directions (n, 2, 3) of the ends of observed segments, in the world.

    Directions are NaN where the camera model has none.
    """
    table = scene.line_observations
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
    center = -quaternion.rotate(world_from_cam, poses[:, 4:])
    return center, quaternion.rotate(world_from_cam[:, None], bearings)
