# SPDX-License-Identifier: BSD-3-Clause
"""One pose, with focal length and principal point where that is wanted, as a problem of the solver's loop.

A photograph asks for a dozen fits of six unknowns. What a problem of many variables is prepared with, layouts, orders
and threads, takes longer than the sums themselves; here they are one product of weighted records.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from groma._numba import loop
from groma._typing import BoolArray, FloatArray, IntArray
from groma.cameras import CameraModel
from groma.factors.losses import Loss, loss_derivatives
from groma.localization.pose.records import records_at
from groma.localization.pose.residuals import near_of
from groma.problem.problem import Problem
from groma.solver.damped_problem import Trial
from groma.solver.levenberg_marquardt import NielsenDamping, predicted_decrease
from groma.solver.options import SolverOptions
from groma.solver.report import SolveReport, Stopwatch
from groma.solver.solve import minimise
from groma.solver.steps import largest_slope
from groma.solver.termination import Termination

#: Of a fit that only collects what is near, and of the last one (cost: of steps).
ROUGHLY, FINELY = (SolverOptions(max_iterations=12, function_tolerance=share) for share in (1e-3, 1e-5))
#: First damping: what agrees is near its minimum (cost: of steps).
_DAMPING = 1e-6
#: Largest step of what is free of a lens: what is near changes by more.
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
@dataclass(frozen=True)
class FreeLens:
    """What is estimated of a lens: the logarithm of its focal lengths, which change by one factor, and the place of its
    principal point in units of them.
    """

    focal: IntArray
    #: The coordinates of the principal point that are estimated; none where it is held.
    center: IntArray

    def directions(self, params: FloatArray) -> FloatArray:
        """Derivatives (p, 1 + c) of the parameters (p,) of a camera by these unknowns."""
        found = np.zeros((len(params), 1 + len(self.center)))
        found[self.focal, 0] = params[self.focal]
        found[self.center, 1 + np.arange(len(self.center))] = params[self.focal].mean()
        return found

    def moved(self, params: FloatArray, step: FloatArray) -> FloatArray:
        """Parameters after a step (1 + c,), which is cut off where it is large."""
        step, found = np.clip(step, -_FARTHEST, _FARTHEST), params.copy()
        found[self.center] += step[1:] * params[self.focal].mean()
        found[self.focal] *= np.exp(step[0])
        return found


def free_lens(kind: CameraModel, center: bool) -> FreeLens:
    """What is estimated of a lens with its focal length, or with that and its principal point (center)."""
    return FreeLens(np.array(kind.focal_indices), np.array(kind.principal_point_indices * center, np.int64))


def fit_pose(
    problem: Problem,
    weights: Sequence[FloatArray],
    near: tuple[BoolArray, BoolArray],
    loss: Loss,
    options: SolverOptions,
    lens: FreeLens | None = None,
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
    options
        When it ends.
    lens
        What is estimated of the camera, too; else it is held.
    """
    kept: dict[str, BoolArray] = dict(zip(("points", "lines"), near, strict=True))
    rows = [near_of(factor, kept) for factor in problem.factors]
    fit = _PoseProblem(problem, weights, rows, loss, lens, options.function_tolerance)
    report = SolveReport()
    minimise(fit, options, report, Stopwatch(report))
    return fit.here.states


@dataclass(frozen=True, kw_only=True)
class _PoseTrial(Trial):
    """States, and the products of weighted derivatives and residuals there."""

    states: dict[str, FloatArray]
    total: FloatArray


class _PoseProblem:
    """Factors of one pose with their weights; a :class:`groma.solver.damped_problem.DampedProblem`.

    Costs come with derivatives, so that a step that is accepted is linearised already. A step that promises too little
    to go on is the last one, and is taken without asking the cost.
    """

    linear_iterations = 0

    def __init__(
        self,
        problem: Problem,
        weights: Sequence[FloatArray],
        near: Sequence[BoolArray],
        loss: Loss,
        lens: FreeLens | None,
        tolerance: float,
    ) -> None:
        self._problem, self._weights, self._near, self._lens = problem, weights, near, lens
        self._loss = loss.tag, loss.parameters
        self._held = {name: group.ambient() for name, group in problem.variables.items()}
        self._tolerance = tolerance
        self._damping = NielsenDamping(_DAMPING)
        moves = {n for n in problem.variables if n == "frames" or (lens is not None and n.startswith("intrinsics"))}
        self.here = self._evaluated({name: problem.variables[name].state for name in moves})

    @property
    def num_factors(self) -> int:
        return sum(int(near.sum()) for near in self._near)

    @property
    def damping(self) -> float:
        return self._damping.value

    def start(self) -> _PoseTrial:
        return self.here

    def linearize(self) -> None:
        """Do nothing: see the class."""

    def largest_gradient(self) -> float:
        return largest_slope(self.here.total[:-1, -1], np.diag(self.here.total)[:-1])

    def is_curved(self) -> bool:
        return bool(np.diag(self.here.total)[:-1].any())

    def try_step(self) -> _PoseTrial:
        H, g = self.here.total[:-1, :-1], self.here.total[:-1, -1]
        diagonal = np.diag(H)
        if not (diagonal > 0.0).all():
            return self.here.without_step()
        scale = 1.0 / np.sqrt(diagonal)
        try:
            scaled = H * np.outer(scale, scale) + self.damping * np.eye(len(g))
            step = -scale * np.linalg.solve(scaled, scale * g)
        except np.linalg.LinAlgError:
            return self.here.without_step()
        promised, withheld = predicted_decrease([(diagonal, g, step)], None, (0.0, 0.0), self.damping)
        moved = self._moved(step)
        if promised <= self._tolerance * self.here.cost:
            return replace(self.here, states=moved, promised=0.0)
        tried = self._evaluated(moved)
        ratio = (self.here.cost - tried.cost) / promised if promised > 0.0 else 0.0
        length = float(np.linalg.norm(step))
        return replace(tried, gain_ratio=ratio, promised=promised, withheld=withheld, length=length)

    def stretch(self, trial: _PoseTrial, factor: float) -> _PoseTrial:
        """Return the trial: another length costs as much as another step."""
        return trial

    def refine(self, trial: _PoseTrial) -> _PoseTrial:
        return trial

    def rescue(self, trial: _PoseTrial) -> _PoseTrial:
        return trial

    def accept(self, trial: _PoseTrial) -> None:
        self.here = trial
        self._damping.accept(trial.gain_ratio)

    def refuse(self, trial: _PoseTrial) -> Termination | None:
        return self._damping.refuse(trial) if trial.has_step else Termination.SINGULAR

    def _moved(self, step: FloatArray) -> dict[str, FloatArray]:
        """States after a step of the pose, and of what is free of the lens."""
        states = self.here.states
        pose = self._problem.variables["frames"].manifold
        found = {"frames": pose.retract(states["frames"], step[None, :6])}
        for name, state in states.items():
            if name != "frames" and self._lens is not None:
                found[name] = self._lens.moved(state[0], step[6:])[None]
        return found

    def _evaluated(self, states: dict[str, FloatArray]) -> _PoseTrial:
        """Evaluate costs and products at some states."""
        cost, hidden, total = 0.0, 0, 0.0
        groups = self._problem.variables
        read = self._held | {name: groups[name].manifold.ambient(state) for name, state in states.items()}
        lens = next((state[0] for name, state in states.items() if name != "frames"), None)
        wanted = {"pose": 6} if lens is None else {"pose": 6, "intrinsics": len(lens)}
        for factor, weight, near in zip(self._problem.factors, self._weights, self._near, strict=True):
            record = records_at(read, factor, wanted)
            own, blind = _weigh(record, weight, near, *self._loss)
            rows = record.reshape(-1, record.shape[2])
            if lens is not None and self._lens is not None:
                by_lens = rows[:, 6:-1] @ self._lens.directions(lens)
                rows = np.column_stack([rows[:, :6], by_lens, rows[:, -1]])
            cost, hidden, total = cost + own, hidden + blind, total + rows.T @ rows
        return _PoseTrial(cost=cost, num_hidden=hidden, states=states, total=np.asarray(total))
