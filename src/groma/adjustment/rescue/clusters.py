# SPDX-License-Identifier: BSD-3-Clause
"""Restart of lines together with the points that lie on them, with cameras held.

A line and the points related to it form a *cluster*. In a wrong local minimum they hold each other in place, so moving
the line alone (:mod:`groma.adjustment.rescue.restart`) does not help. A cluster that fits much worse than the median is
solved twice, from its present state and with its lines triangulated again, and the better result is kept. With cameras
and planes held, clusters are independent; all suspicious ones form one small problem.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from groma._rows import connected_parts
from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.assemble import POINT_FACTORS
from groma.adjustment.rescue.restart import GATES, triangulated_anew, went_elsewhere, with_cameras
from groma.adjustment.terms.lines import LINE_FACTORS
from groma.factors.contract import Factor, Ref
from groma.problem.problem import Problem
from groma.problem.residuals import squared_norms
from groma.problem.variables import Variables
from groma.scene import Scene
from groma.solver.options import SolverOptions
from groma.solver.solve import solve


def renew_clusters(scene: Scene, problem: Problem, threads: int | None = None) -> tuple[Problem, IntArray]:
    """Return the problem with suspicious clusters at the better of two minima, and their lines that moved.

    Parameters
    ----------
    scene : Scene
        What the problem was made from.
    problem : Problem
        A problem at any state, with its lines in the order of the scene; returned unchanged if no point is related to
        a free line.
    threads : int, optional
        Threads; None takes one for small problems and all cores for large ones.
    """
    variables, nothing = problem.variables, np.zeros(0, np.int64)
    ties = [factor for factor in problem.factors if factor.type_name == "point_on_line" and len(factor)]
    if not ties or variables["lines"].is_constant or variables["points"].is_constant:
        return problem, nothing
    cluster, count = _clusters(ties, variables)
    factors = [factor for factor in problem.factors if len(factor)]
    labels = [_label_of(factor, cluster) for factor in factors]
    ill_fitting = _ill_fitting(factors, labels, count, variables)
    chosen = {group: np.flatnonzero(ill_fitting[label]) for group, label in cluster.items()}
    lines = chosen["lines"]
    if len(lines) == 0:
        return problem, nothing
    triangulated, found = triangulated_anew(with_cameras(scene, problem), lines)
    second = {group: variables[group].state[members] for group, members in chosen.items()}
    second["lines"][found] = variables["lines"].manifold.from_ambient(triangulated[found])
    rows = [np.flatnonzero(ill_fitting[label]) for label in labels]
    doubled = [_doubled(factor, mine, chosen) for factor, mine in zip(factors, rows, strict=True) if len(mine)]
    starts = {
        name: _joined(group, chosen[name], second[name]) if name in chosen else replace(group, constant=True)
        for name, group in variables.items()
    }
    solved = solve(
        Problem(starts, doubled), SolverOptions(max_iterations=GATES.max_steps, threads=threads)
    ).problem.variables
    ends = np.zeros(2 * count)
    mine = [label[kept] for label, kept in zip(labels, rows, strict=True) if len(kept)]
    for factor, label in zip(doubled, mine, strict=True):
        ends += _costs(factor, np.concatenate([label, label + count]), 2 * count, solved)
    better: BoolArray = ends[count:] < ends[:count]
    states = {}
    for group, members in chosen.items():
        first, other = np.split(solved[group].state, 2)
        states[group] = variables[group].state.copy()
        states[group][members] = np.where(better[cluster[group][members]][:, None], other, first)
    moved = problem.with_states(states)
    before, after = (p.variables["lines"].ambient()[lines] for p in (problem, moved))
    return moved, lines[went_elsewhere(scene.lines.segments[lines], before, after)]


def _clusters(ties: list[Factor], variables: Mapping[str, Variables]) -> tuple[dict[str, IntArray], int]:
    """Return the cluster of each line and of each point, -1 where nothing is tied to it, and how many there are."""
    indices = [{ref.group: ref.index for _, ref in factor.references()} for factor in ties]
    line, point = (np.concatenate([index[group] for index in indices]) for group in ("lines", "points"))
    num_lines, size = len(variables["lines"]), len(variables["lines"]) + len(variables["points"])
    ends = line, num_lines + point
    label = connected_parts(*ends, size)
    tied = np.zeros(size, bool)
    tied[np.concatenate(ends)] = True
    used = np.zeros(size, bool)
    used[label[tied]] = True
    label = np.where(tied, (np.cumsum(used) - 1)[label], -1)
    return {"lines": label[:num_lines], "points": label[num_lines:]}, int(used.sum())


def _label_of(factor: Factor, cluster: dict[str, IntArray]) -> IntArray:
    """Return the cluster of each factor; -1 for none, or for a factor that reaches outside of its cluster."""
    labels = [cluster[ref.group][ref.index] for _, ref in factor.references() if ref.group in cluster]
    if not labels:
        return np.full(len(factor), -1)
    return np.where(np.all(np.equal(labels, labels[0]), axis=0), labels[0], -1)


def _ill_fitting(
    factors: Sequence[Factor], labels: list[IntArray], count: int, variables: Mapping[str, Variables]
) -> BoolArray:
    """Return which clusters cost far more per observation than usual, (count + 1,); the last stands for no cluster."""
    cost, views = np.zeros(count + 1), np.zeros(count + 1)
    for factor, label in zip(factors, labels, strict=True):
        label = np.where(label < 0, count, label)
        cost += _costs(factor, label, count + 1, variables)
        if factor.type_name in LINE_FACTORS + POINT_FACTORS:
            views += np.bincount(label, minlength=count + 1)
    per_view = (cost / np.maximum(views, 1.0))[:count]
    seen = views[:count] > 0
    usual = float(np.median(per_view[seen])) if seen.any() else 0.0
    return np.append(seen & (per_view > GATES.suspicious * max(usual, 1e-12)), False)


def _costs(factor: Factor, label: IntArray, count: int, variables: Mapping[str, Variables]) -> FloatArray:
    """Return the sums of the costs of factors by label, (count,)."""
    return np.bincount(label, factor.loss.evaluate(squared_norms(factor, variables))[0], count).astype(np.float64)


def _doubled(factor: Factor, rows: IntArray, chosen: Mapping[str, IntArray]) -> Factor:
    """Return these factors of the chosen lines and points, and once more those of the second starts behind them."""
    both, changes = factor.take(np.concatenate([rows, rows])), {}
    for slot, ref in both.references():
        if ref.group in chosen:
            index = np.searchsorted(chosen[ref.group], ref.index)
            index[len(rows) :] += len(chosen[ref.group])
            changes[slot.name] = Ref(ref.group, index)
    return replace(both, **changes)


def _joined(group: Variables, members: IntArray, second: FloatArray) -> Variables:
    """Return some variables of a group, and after them their second starts."""
    constant = group.constant
    if not isinstance(constant, bool | np.bool_):
        constant = np.concatenate([constant[members], constant[members]])
    return replace(group, state=np.concatenate([group.state[members], second]), constant=constant)
