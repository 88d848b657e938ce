# SPDX-License-Identifier: BSD-3-Clause
"""Steps of one pose to the minimum of a robust cost: damped least squares without the machinery of large problems.

A photograph asks for a dozen fits of six unknowns. What a general solver prepares for each, layouts, orders and
threads, takes longer than the sums themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groma._numba import loop
from groma._typing import BoolArray, FloatArray, IntArray
from groma.factors.losses import Loss, loss_derivatives
from groma.gates import gate
from groma.localization.pose.records import records
from groma.localization.pose.residuals import near_of
from groma.problem.problem import Problem


@dataclass(frozen=True)
class FitGates:
    """When the steps of a fit end."""

    gain: float = gate(1e-5, "share", "of the cost, that a step must gain", "cost: of steps")
    steps: int = gate(12, "steps", "at most", "cost: of steps")


#: Of a fit that only collects what is near, and of the last one.
ROUGHLY, FINELY = FitGates(gain=1e-3), FitGates()

#: First damping, relative to the diagonal of the normal equations, and by how much it changes (cost: of steps).
_DAMPING, _CHANGE = 1e-6, 10.0
#: Largest step of the logarithm of a focal length: what is near changes by more.
_FARTHEST = 0.3


# ---------------------------------------------------------------------------------------------------------- Kernels
@loop
def _weigh(record, weight, near, loss_tag, parameters):
    """Whiten records in place and scale them by the root of the loss' weight, those that are far by zero.

    Return the cost, and how many that are near cannot be evaluated: those are zero.
    """
    cost, hidden, last = 0.0, 0, record.shape[2] - 1
    for n in range(record.shape[0]):
        root = 0.0
        if near[n]:
            r, s = record[n, 0, last], record[n, 1, last]
            first = weight[n, 0, 0] * r + weight[n, 0, 1] * s
            second = weight[n, 1, 0] * r + weight[n, 1, 1] * s
            square = first * first + second * second
            rho, slope, _ = loss_derivatives(loss_tag, parameters, square)
            cost += 0.5 * rho
            hidden += int(square == 0.0)
            root = np.sqrt(slope)
        for j in range(record.shape[2]):
            u, v = root * record[n, 0, j], root * record[n, 1, j]
            record[n, 0, j] = weight[n, 0, 0] * u + weight[n, 0, 1] * v
            record[n, 1, j] = weight[n, 1, 0] * u + weight[n, 1, 1] * v
    return cost, hidden


# ----------------------------------------------------------------------------------------------------------- Public
def fit_pose(
    problem: Problem,
    weights: Sequence[FloatArray],
    near: tuple[BoolArray, BoolArray],
    loss: Loss,
    gates: FitGates,
    focal: IntArray | None = None,
) -> dict[str, FloatArray]:
    """Return the states of a problem of one pose that a robust cost is least at; landmarks are held.

    Parameters
    ----------
    problem, weights
        Of one pose, and the inverse noise (n, 2, 2) of its factors.
    near
        Which of its points and lines take part.
    loss
        On squared whitened residuals.
    gates
        When it ends.
    focal
        The focal lengths among the parameters of its camera, if all of them may change by one factor; else they are
        held.
    """
    kept: dict[str, BoolArray] = dict(zip(("points", "lines"), near, strict=True))
    fit = _Fit(problem, weights, [near_of(factor, kept) for factor in problem.factors], loss, focal)
    states = {name: group.state for name, group in problem.variables.items() if fit.moves(name)}
    cost, hidden, total = fit.equations(states)
    damping = _DAMPING
    for _ in range(gates.steps):
        step, promised = _step(total, damping)
        if not promised > 0.0:
            break
        moved = fit.moved(states, step)
        if promised <= gates.gain * cost:
            return moved
        new = fit.equations(moved)
        if new[0] < cost and new[1] <= hidden:
            gained = cost - new[0]
            states, (cost, hidden, total), damping = moved, new, max(damping / _CHANGE, _DAMPING)
            if gained <= gates.gain * cost:
                break
        else:
            damping *= _CHANGE
    return states


@dataclass(frozen=True, eq=False)
class _Fit:
    """What a fit evaluates: factors with their weights, which of their rows are near, and what moves."""

    problem: Problem
    weights: Sequence[FloatArray]
    near: Sequence[BoolArray]
    loss: Loss
    focal: IntArray | None

    def moves(self, group: str) -> bool:
        """Whether a group of variables moves."""
        return group == "frames" or (self.focal is not None and group.startswith("intrinsics"))

    def moved(self, states: dict[str, FloatArray], step: FloatArray) -> dict[str, FloatArray]:
        """States after a step of the pose, and of the logarithm of the focal length."""
        pose = self.problem.variables["frames"].manifold
        found = {"frames": pose.retract(states["frames"], step[None, :6])}
        for name, state in states.items():
            if name != "frames":
                found[name] = state.copy()
                found[name][:, self.focal] *= np.exp(np.clip(step[6], -_FARTHEST, _FARTHEST))
        return found

    def equations(self, states: dict[str, FloatArray]) -> tuple[float, int, FloatArray]:
        """The cost, how many cannot be evaluated, and the products of weighted derivatives and residuals."""
        cost, hidden, total = 0.0, 0, 0.0
        problem = self.problem.with_states(states)
        lens = next((state[0] for name, state in states.items() if name != "frames"), None)
        wanted = {"pose": 6} if lens is None else {"pose": 6, "intrinsics": len(lens)}
        for factor, weight, near in zip(problem.factors, self.weights, self.near, strict=True):
            record = records(problem, factor, wanted)
            own, blind = _weigh(record, weight, near, self.loss.tag, self.loss.parameters)
            rows = record.reshape(-1, record.shape[2])
            if lens is not None:
                by_focal = rows[:, 6:-1][:, self.focal] @ lens[self.focal]
                rows = np.column_stack([rows[:, :6], by_focal, rows[:, -1]])
            cost, hidden, total = cost + own, hidden + blind, total + rows.T @ rows
        return cost, hidden, np.asarray(total)


def _step(total: FloatArray, damping: float) -> tuple[FloatArray, float]:
    """The step of damped normal equations, and by how much it promises to lower the cost; zero without one."""
    H, g = total[:-1, :-1], total[:-1, -1]
    diagonal = np.diag(H)
    if not (diagonal > 0.0).all():
        return np.zeros(len(g)), 0.0
    scale = 1.0 / np.sqrt(diagonal)
    try:
        step = -scale * np.linalg.solve(H * np.outer(scale, scale) + damping * np.eye(len(g)), scale * g)
    except np.linalg.LinAlgError:
        return np.zeros(len(g)), 0.0
    return step, float(-(g @ step) - 0.5 * step @ H @ step)
