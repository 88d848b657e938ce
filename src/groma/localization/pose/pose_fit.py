# SPDX-License-Identifier: BSD-3-Clause
"""One pose, with what is free of a lens where that is wanted, fitted by damped least squares.

A photograph asks for a dozen fits of six unknowns. What a problem of many variables is prepared with, layouts, orders
and threads, takes longer than the sums themselves; here they are one product of weighted records. The loop is that of
:func:`groma.solver.solve.minimise`: the same damping, the same criteria.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from groma._numba import loop
from groma._typing import BoolArray, FloatArray
from groma.factors.losses import Loss, loss_derivatives
from groma.localization.pose.free_lens import FreeLens
from groma.localization.pose.one_pose import OnePose
from groma.solver.damped_problem import Trial
from groma.solver.levenberg_marquardt import NielsenDamping
from groma.solver.linear.lapack import potrf, potrs
from groma.solver.options import SolverOptions
from groma.solver.termination import cost_converged

#: Of a fit that only collects what is near, and of the last one (cost: of steps).
ROUGHLY, FINELY = (SolverOptions(max_iterations=12, function_tolerance=share) for share in (1e-3, 1e-5))
#: First damping: what agrees is near its minimum (cost: of steps).
_DAMPING = 1e-6


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
    start: OnePose,
    weights: Sequence[FloatArray],
    near: tuple[BoolArray, BoolArray],
    loss: Loss,
    options: SolverOptions,
    lens: FreeLens | None = None,
) -> OnePose:
    """Return the pose, and lens, that a robust cost is least at; landmarks are held.

    Parameters
    ----------
    start, weights
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
    rows = np.concatenate([np.zeros(0, bool), *(part.of_rows(kept) for part in start.parts)])
    at = _Sums(start, weights, rows, loss, lens)
    here, damping, fell, count = at(start), NielsenDamping(_DAMPING), 0.0, int(rows.sum())
    if not math.isfinite(here.cost) or here.hidden == count:
        return start
    share = here.cost / max(1, count)
    for iteration in range(options.max_iterations):
        found = _step(here.total, damping.value)
        if found is None or found.slope <= options.gradient_tolerance:
            break
        params = here.one.params if lens is None else lens.moved(here.one.params, found.step[6:])
        moved = here.one.after(found.step[:6], params)
        if found.promised <= options.function_tolerance * here.cost:
            # The last step is taken without asking the cost; where the start is as good, none is.
            return moved if iteration else start
        tried = at(moved)
        ratio = (here.cost - tried.cost) / found.promised
        if not tried.cost + max(0, tried.hidden - here.hidden) * share < here.cost:
            fell = 0.0
            if damping.refuse(Trial(tried.cost)) is not None:
                break
            continue
        damping.accept(ratio)
        before, fell, held = fell, (here.cost - tried.cost) / here.cost, found.withheld / here.cost
        here = tried
        if cost_converged(fell, before, ratio, held, options.function_tolerance):
            break
    return here.one


def full_step(one: OnePose, weights: Sequence[FloatArray], loss: Loss, lens: FreeLens) -> FloatArray | None:
    """Return the undamped step (6 + k,) of a pose and a lens by all matches; None where they do not determine it."""
    found = _step(_Sums(one, weights, np.ones(sum(map(len, weights)), bool), loss, lens)(one).total, 0.0)
    return None if found is None else found.step


@dataclass(frozen=True, eq=False)
class _Sum:
    """A pose, the cost there, matches that cannot be evaluated, and products of weighted derivatives and residuals."""

    one: OnePose
    cost: float
    hidden: int
    total: FloatArray


class _Sums:
    """Sums over the matches that are near, at one pose after the other; all are written to one array."""

    def __init__(
        self, one: OnePose, weights: Sequence[FloatArray], near: BoolArray, loss: Loss, lens: FreeLens | None
    ) -> None:
        self._near, self._lens, self._loss = near, lens, (loss.tag, loss.parameters)
        self._weight = np.concatenate([np.zeros((0, 2, 2)), *weights])
        self._record = np.zeros((len(near), 2, 7 + (0 if lens is None else len(one.params))))

    def __call__(self, one: OnePose) -> _Sum:
        one.write(self._record, self._lens is not None)
        cost, hidden = _weigh(self._record, self._weight, self._near, *self._loss)
        rows = self._record.reshape(-1, self._record.shape[2])
        total = rows.T.copy() @ rows  # faster than a product that BLAS knows to be symmetric
        if self._lens is not None:
            directions = self._lens.directions(one.params)
            moved = np.zeros((len(total), 7 + directions.shape[1]))
            moved[:6, :6], moved[6:-1, 6:-1], moved[-1, -1] = np.eye(6), directions, 1.0
            prior = self._lens.prior(one.params)
            cost, total = cost + 0.5 * float(prior[-1, -1]), moved.T @ total @ moved + prior
        return _Sum(one, cost, hidden, total)


class _Step(NamedTuple):
    """A damped step, the decrease that the quadratic model promises and what the damping holds back of it, and the
    largest component of the gradient, each divided by the root of its curvature.
    """

    step: FloatArray
    promised: float
    withheld: float
    slope: float


def _step(total: FloatArray, damping: float) -> _Step | None:
    """The damped step by products of derivatives and residuals; None where there is none."""
    scale = np.sqrt(total.diagonal())
    scale[-1] = 1.0
    if not scale.min() > 0.0:
        return None
    scaled = total / np.outer(scale, scale)
    scaled.flat[:: len(scaled) + 1] = 1.0 + damping
    gradient = scaled[:-1, -1]
    factor, failed = potrf(scaled[:-1, :-1])
    if failed:
        return None
    step = potrs(factor, -gradient)[0]
    held = damping * float(step @ step)
    promised = 0.5 * (held - float(gradient @ step))
    return _Step(step / scale[:-1], promised, held, float(np.abs(gradient).max()))
