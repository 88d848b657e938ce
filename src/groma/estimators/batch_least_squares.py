# SPDX-License-Identifier: BSD-3-Clause
r"""Many small least-squares problems of one kind at once: Levenberg-Marquardt on each, compiled.

The problems share nothing but their kind, and have a few parameters each: 3D lines with known cameras, for example. For
every problem

::

    repeat
        repeat   solve (H + damping diag H) x = g, move, linearise    H = sum w J^T J,  g = -sum w J^T r
        until the cost fell                         (damping * 10 after a failure, / 10 after a success)
    until it hardly fell

optionally under a Cauchy loss. It is the loop of :func:`groma.solver.solve.minimise` for problems so small that calling
Python once for each would take longer than solving them.

A kind of problem is three kernels, and is registered with a number (:func:`problem_kind`)::

    frame(x, B)                         write to B the quantities at the state x that the two other kernels need
    residuals(shared, k, own, m, x, B, r, J)
                                        write the residuals of an observation and their derivatives by a step
    move(x, B, step, out)               write the state after a step

An observation has its own row of numbers, ``own[m]`` (a segment), and one that it may share with others,
``shared[k]`` (its camera). The arrays are passed whole: views of rows would take half of the time.

The loop takes the kind as a tuple of ``None`` whose length is the number, so it is compiled for each kind and calls the
kernels directly, as :mod:`groma.cameras.dispatch` does for camera models.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba.extending import overload

from groma._kernels.digest import ByLength
from groma._numba import kernel, loop
from groma._simd import width
from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError
from groma.execution import map_ranges

# ---------------------------------------------------------------------------------------------------------- Kernels
# Kernels by number of the kind. Filled by problem_kind.

_FRAME: ByLength[Callable[..., None]] = ByLength()
_RESIDUALS: ByLength[Callable[..., None]] = ByLength()
_MOVE: ByLength[Callable[..., None]] = ByLength()

#: Damping of the first step, at least, and refused steps after which a problem is left (cost: steps).
FIRST_DAMPING, MIN_DAMPING, MAX_ATTEMPTS = 1e-4, 1e-12, 8
#: A pivot below this fraction of its diagonal entry means a singular system.
PIVOT_TOLERANCE = 1e-12
#: Problems, or lines, that one piece of work solves; a problem takes some ten microseconds (cost: time only).
PROBLEMS_AT_ONCE = 128


def _frame(kind, x, B):
    _FRAME[len(kind)](x, B)


def _residuals(kind, shared, k, own, m, x, B, r, J):
    _RESIDUALS[len(kind)](shared, k, own, m, x, B, r, J)


def _move(kind, x, B, step, out):
    _MOVE[len(kind)](x, B, step, out)


@overload(_frame, inline="always")
def _overload_frame(kind, x, B):
    chosen = _FRAME[kind.count]
    return lambda kind, x, B: chosen(x, B)


@overload(_residuals, inline="always")
def _overload_residuals(kind, shared, k, own, m, x, B, r, J):
    chosen = _RESIDUALS[kind.count]
    return lambda kind, shared, k, own, m, x, B, r, J: chosen(shared, k, own, m, x, B, r, J)


@overload(_move, inline="always")
def _overload_move(kind, x, B, step, out):
    chosen = _MOVE[kind.count]
    return lambda kind, x, B, step, out: chosen(x, B, step, out)


@kernel
def solve_damped(H, g, damping, L, x, parameters):
    """Solve (H + damping diag H) x = g by Cholesky, from the lower triangle of H; False if not positive definite."""
    size = len(parameters)
    for m in range(size):
        for n in range(m + 1):
            s = H[m, n]
            if m == n:
                s += damping * H[m, m] + 1e-300
            for k in range(n):
                s -= L[m, k] * L[n, k]
            if m == n:
                if not s > PIVOT_TOLERANCE * H[m, m]:
                    return False
                L[m, m] = math.sqrt(s)
            else:
                L[m, n] = s / L[n, n]
    for m in range(size):
        s = g[m]
        for k in range(m):
            s -= L[m, k] * x[k]
        x[m] = s / L[m, m]
    for m in range(size - 1, -1, -1):
        s = x[m]
        for k in range(m + 1, size):
            s -= L[k, m] * x[k]
        x[m] = s / L[m, m]
    return True


@kernel
def _cost_of(square, cauchy):
    """The cost of a squared residual; ``cauchy`` is one over the squared scale of the loss, 0 for none."""
    return math.log1p(square * cauchy) if cauchy > 0.0 else square


@kernel
def _linearize(kind, shared, index, own, begin, end, active, x, B, cauchy, r, J, H, g, parameters, rows):
    """Write the normal equations of one problem, lower triangle; return the cost."""
    H[:, :] = 0.0
    g[:] = 0.0
    cost = 0.0
    for m in range(begin, end):
        if not active[m]:
            continue
        _residuals(kind, shared, index[m], own, m, x, B, r, J)
        square = 0.0
        for k in range(len(rows)):
            square += r[k] * r[k]
        cost += _cost_of(square, cauchy)
        weight = 1.0 / (1.0 + square * cauchy)
        for a in range(len(parameters)):
            s = 0.0
            for k in range(len(rows)):
                s += J[k, a] * r[k]
            g[a] -= weight * s
            for b in range(a + 1):
                s = 0.0
                for k in range(len(rows)):
                    s += J[k, a] * J[k, b]
                H[a, b] += weight * s
    return cost


@loop
def _solve_all(
    kind, shared, index, own, pointers, active, x, B, rules, cost, information, steps, converged, parameters, rows
):
    """Minimise every problem from its row of x, in place."""
    max_steps, tolerance, floor, cauchy = rules
    size = len(parameters)
    r, J, H, g = np.zeros(len(rows)), np.zeros((len(rows), size)), np.zeros((size, size)), np.zeros(size)
    L, step, trial, trial_frame = np.zeros((size, size)), np.zeros(size), np.zeros(x.shape[1:]), np.zeros(B.shape[1:])
    trial_H, trial_g = np.zeros((size, size)), np.zeros(size)
    for n in range(len(pointers) - 1):
        begin, end, here, frame = pointers[n], pointers[n + 1], x[n], B[n]
        damping, before, attempts, first, done, ended = FIRST_DAMPING, np.inf, 0, True, False, False
        for k in range(trial.size):
            trial.flat[k] = here.flat[k]
        while True:
            # The start, then trials, which are linearised at once, as most are accepted; in the end without the loss.
            _frame(kind, trial, trial_frame)
            after = _linearize(
                kind, shared, index, own, begin, end, active, trial, trial_frame, 0.0 if ended else cauchy, r, J,
                trial_H, trial_g, parameters, rows,
            )  # fmt: skip
            better = first or ended or after <= before
            done = not first and after >= before * (1.0 - tolerance) - floor
            if better:
                for k in range(trial.size):
                    here.flat[k] = trial.flat[k]
                for k in range(trial_frame.size):
                    frame.flat[k] = trial_frame.flat[k]
                H, trial_H, g, trial_g, before = trial_H, H, trial_g, g, after
            if ended:
                break
            if not better:
                damping *= 10.0
            else:
                if not first:
                    damping = max(damping * 0.1, MIN_DAMPING)
                converged[n], ended = done, done or steps[n] >= max_steps
                if not ended:
                    steps[n] += 1
                    attempts, done = 0, False
            first = solved = False
            while not (solved or ended):
                if attempts == MAX_ATTEMPTS:
                    converged[n], ended = done, True
                    break
                attempts += 1
                solved = solve_damped(H, g, damping, L, step, parameters)
                if not solved:
                    damping *= 10.0
            if solved:
                _move(kind, here, frame, step, trial)
            elif cauchy > 0.0:
                for k in range(trial.size):
                    trial.flat[k] = here.flat[k]
            else:
                break
        cost[n] = before
        for a in range(size):
            for b in range(a + 1):
                information[n, a, b] = information[n, b, a] = H[a, b]


# ----------------------------------------------------------------------------------------------------------- Public


@dataclass(frozen=True)
class ProblemKind:
    """A kind of small problem."""

    number: int
    #: Parameters of a problem, and residuals of an observation.
    num_parameters: int
    num_rows: int
    #: Shape of what the kernel ``frame`` writes.
    frame_shape: tuple[int, ...]


@dataclass(frozen=True)
class Observations:
    """What small problems are made of."""

    #: (K, ...) rows that observations share, and the one (M,) of each.
    shared: FloatArray
    shared_idx: IntArray
    #: (M, ...) what each observation has for itself.
    own: FloatArray
    #: (N + 1,) bounds of the observations of each problem.
    pointers: IntArray
    #: (M,) whether they take part.
    active: BoolArray


@dataclass(frozen=True)
class BatchSolution:
    """Minima of many small problems."""

    #: (N, ...) states.
    states: FloatArray
    #: (N, *frame_shape) what the kind's kernel wrote at the states; steps are measured in it.
    frames: FloatArray
    #: (N,) sums of squared residuals, without the loss.
    cost: FloatArray
    #: (N, parameters, parameters) J^T J at the states, without the loss.
    information: FloatArray
    #: (N,) how many steps were taken.
    steps: IntArray
    #: (N,) whether the cost hardly fell in the last step, or no step lowers it.
    converged: BoolArray


def problem_kind(
    number: int,
    num_parameters: int,
    num_rows: int,
    frame_shape: tuple[int, ...],
    frame: Callable[..., None],
    residuals: Callable[..., None],
    move: Callable[..., None],
) -> ProblemKind:
    """Register a kind of problem under a new number; its kernels are made with ``groma._numba.kernel``."""
    known = _RESIDUALS.get(number)
    if number < 1 or (known is not None and known is not residuals):
        raise InputError(f"The number of a kind of problem must be positive and its own; got {number}.")
    _FRAME[number], _RESIDUALS[number], _MOVE[number] = frame, residuals, move
    return ProblemKind(number, num_parameters, num_rows, frame_shape)


def solve_batch(
    kind: ProblemKind,
    observations: Observations,
    states: FloatArray,
    max_steps: int = 20,
    tolerance: float = 1e-9,
    floor: float = 1e-12,
    cauchy_scale: float = math.inf,
) -> BatchSolution:
    """Minimise many small problems.

    Parameters
    ----------
    kind
        What the problems are.
    observations
        Of all problems.
    states : (N, ...) float64
        Initial states; not changed.
    max_steps
        Most steps of a problem.
    tolerance, floor
        A problem has converged when its cost falls by less than this fraction, or by less than ``floor``.
    cauchy_scale
        Scale of a Cauchy loss on the norm of each observation's residuals; infinite for least squares.
    """
    count, found = len(states), np.array(states, np.float64, order="C")
    frames = np.zeros((count, *kind.frame_shape))
    cost, information = np.zeros(count), np.zeros((count, kind.num_parameters, kind.num_parameters))
    steps, converged = np.zeros(count, np.int64), np.zeros(count, np.bool_)
    rules = (max_steps, tolerance, floor, 1.0 / cauchy_scale**2)
    seen = observations

    def solve(part: slice) -> None:
        _solve_all(
            width(kind.number), seen.shared, seen.shared_idx, seen.own, seen.pointers[part.start : part.stop + 1],
            seen.active, found[part], frames[part], rules, cost[part], information[part], steps[part], converged[part],
            width(kind.num_parameters), width(kind.num_rows),
        )  # fmt: skip

    map_ranges(solve, count, PROBLEMS_AT_ONCE)
    return BatchSolution(found, frames, cost, information, steps, converged)
