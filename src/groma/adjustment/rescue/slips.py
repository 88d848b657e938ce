# SPDX-License-Identifier: BSD-3-Clause
r"""Recovery of lines that moved through a camera, or behind it, because of a wrong observation.

A line through the centre of a camera fits every segment in that image, and under a robust loss it may move there at the
expense of its other observations. A line behind a camera also has an image, although it is invisible. With :math:`(m,
d)` the line in the camera and b the bearing of the middle of the segment, the ray meets the line, or passes it, at the
depth

.. math:: z = \frac{(d \times m)^\top b}{\|d\|^2 - (d^\top b)^2} .

An observation is false if z is negative, or very small compared with the other observations of the line. The line is
solved without its false observations, which then are the outliers they should be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.rescue.restart import GATES as RESTART_GATES
from groma.estimators.trimming import trim_to_ray
from groma.factors.observations.line_bearing import LineBearing
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.line_unprojection import LineUnprojection
from groma.gates import SURVEYED, gate
from groma.problem.problem import Problem
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

Observing = LineReprojection | LineBearing | LineUnprojection


@dataclass(frozen=True)
class SlipGates:
    """Which observations of a line are false."""

    nearest: float = gate(0.01, "1", "depth of a false segment over the usual one of its line", SURVEYED)


GATES = SlipGates()


def without_slips(problem: Problem, threads: int | None = None) -> tuple[Problem, IntArray]:
    """Return the problem with the lines recovered that slipped through or behind a camera, and which of them turned.

    Parameters
    ----------
    problem : Problem
        A problem at any state, with robust losses; returned unchanged if no line slipped.
    threads : int, optional
        Threads; None takes one for small problems and all cores for large ones.
    """
    lines = problem.variables.get("lines")
    observing = [factor for factor in problem.factors if isinstance(factor, Observing) and len(factor)]
    if lines is None or lines.is_constant or not observing:
        return problem, np.zeros(0, np.int64)
    slipped = _slipped(problem, observing)
    if not any(rows.any() for rows in slipped):
        return problem, np.zeros(0, np.int64)
    mine = np.unique(np.concatenate([f.line.index[rows] for f, rows in zip(observing, slipped, strict=True)]))
    false, factors = iter(slipped), []
    for factor in problem.factors:
        index = next((ref.index for _, ref in factor.references() if ref.group == "lines"), None)
        if index is None or len(factor) == 0:
            continue
        keep = np.isin(index, mine)
        if isinstance(factor, Observing):
            keep &= ~next(false)
        factors.append(factor.take(np.flatnonzero(keep)))
    used = {ref.group for factor in factors for _, ref in factor.references()} - {"lines"}
    held = {name: replace(problem.variables[name], constant=True) for name in used}
    options = SolverOptions(max_iterations=RESTART_GATES.max_steps, threads=threads)
    solved = solve(Problem({**held, "lines": lines}, factors), options).problem.variables["lines"]
    before, after = (group.ambient()[mine, 3:] for group in (lines, solved))
    sine = np.linalg.norm(np.cross(before, after), axis=1)
    turned = sine > RESTART_GATES.elsewhere * np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    return Problem({**problem.variables, "lines": solved}, problem.factors), mine[turned]


def _slipped(problem: Problem, factors: list[Observing]) -> list[BoolArray]:
    """Return for each group of observations which are false; none of a line that is behind most of its cameras."""
    depths = [_depths(problem, factor) for factor in factors]
    line, depth = np.concatenate([factor.line.index for factor in factors]), np.concatenate(depths)
    order = np.lexsort((depth, line))
    count = np.bincount(line, minlength=len(problem.variables["lines"]))
    first = np.cumsum(count) - count
    usual = np.zeros(len(count))
    seen = count > 0
    usual[seen] = depth[order[(first + count // 2)[seen]]]  # of two, the farther
    limit = np.where(usual > 0, GATES.nearest * usual, -np.inf)
    return [z < limit[factor.line.index] for z, factor in zip(depths, factors, strict=True)]


def _depths(problem: Problem, factor: Observing) -> FloatArray:
    """Return the depth along the middle of each segment at which its ray passes the line, (N,)."""
    ambient = {slot.name: problem.variables[ref.group].ambient()[ref.index] for slot, ref in factor.references()}
    m, d = ambient["line"][:, :3], ambient["line"][:, 3:]
    for name in ("pose", "extrinsics"):
        if name in ambient:
            T = ambient[name].reshape(-1, 3, 4)
            d = np.einsum("nij,nj->ni", T[:, :, :3], d)
            m = np.einsum("nij,nj->ni", T[:, :, :3], m) + np.cross(T[:, :, 3], d)
    if isinstance(factor, LineBearing):
        b = factor.start_bearings + factor.end_bearings
    else:
        middle = np.ascontiguousarray(0.5 * (factor.segments[:, :2] + factor.segments[:, 2:]))
        b = factor.camera.unproject(ambient["intrinsics"], middle)
    return trim_to_ray(np.concatenate([m, d], axis=1), np.zeros(3), b, min_sine=0.0).depth
