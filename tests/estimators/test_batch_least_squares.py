"""Many small problems at once: the minima that SciPy finds, with and without a loss; what is singular, empty, wrong."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from groma._numba import kernel
from groma.errors import InputError
from groma.estimators.batch_least_squares import Observations, problem_kind, solve_batch

pytestmark = pytest.mark.kernels


@kernel
def _frame(x, B):
    B[0] = np.exp(x[1])  # what depends on the state alone is computed once for all observations


@kernel
def _residuals(shared, k, own, m, x, B, r, J):
    """y = a exp(-exp(b) t) + c, and a weak prior on c in the second row."""
    decay = np.exp(-np.exp(x[1]) * own[m, 0])
    r[0] = x[0] * decay + x[2] - own[m, 1]
    r[1] = shared[k, 0] * x[2]
    J[0, 0], J[0, 1], J[0, 2] = decay, -x[0] * B[0] * own[m, 0] * decay, 1.0
    J[1, 0], J[1, 1], J[1, 2] = 0.0, 0.0, shared[k, 0]


@kernel
def _move(x, B, step, out):
    for k in range(3):
        out[k] = x[k] + step[k]


DECAY = problem_kind(9, 3, 2, (1,), _frame, _residuals, _move)


def problems(seed, count=60, noise=0.02, wrong=0.0):
    rng = np.random.default_rng(seed)
    sizes = rng.integers(6, 40, count)
    pointers = np.concatenate([[0], np.cumsum(sizes)])
    truth = np.stack([rng.uniform(1, 4, count), rng.uniform(-1, 1, count), rng.uniform(-1, 1, count)], axis=1)
    owner = np.repeat(np.arange(count), sizes)
    t = rng.uniform(0, 3, len(owner))
    y = truth[owner, 0] * np.exp(-np.exp(truth[owner, 1]) * t) + truth[owner, 2] + noise * rng.normal(size=len(owner))
    y += np.where(rng.random(len(owner)) < wrong, rng.uniform(-3, 3, len(owner)), 0.0)
    return pointers, truth, t, y, truth + rng.normal(0, 0.2, truth.shape)


def observed(t, y, pointers, active=None):
    """All observations share the root of the prior's weight."""
    every = np.ones(len(t), bool) if active is None else active
    return Observations(np.full((1, 1), 0.01), np.zeros(len(t), np.int64), np.stack([t, y], axis=1), pointers, every)


def scipy_minimum(t, y, x, cauchy_scale):
    """The same problem: every observation has both rows under one loss, so SciPy gets the root of each cost."""

    def rows(p):
        decay = np.exp(-np.exp(p[1]) * t)
        square = (p[0] * decay + p[2] - y) ** 2 + (0.01 * p[2]) ** 2
        return np.sqrt(np.log1p(square / cauchy_scale**2)) * cauchy_scale if np.isfinite(cauchy_scale) else square**0.5

    return least_squares(rows, x, xtol=1e-15, ftol=1e-15, gtol=1e-12, max_nfev=1000)


@pytest.mark.parametrize("cauchy_scale", [np.inf, 0.05])
def test_finds_the_minima_that_scipy_finds(cauchy_scale):
    pointers, truth, t, y, start = problems(0, wrong=0.05 if np.isfinite(cauchy_scale) else 0.0)
    before = start.copy()
    found = solve_batch(DECAY, observed(t, y, pointers), start, 100, 1e-14, floor=0.0, cauchy_scale=cauchy_scale)
    np.testing.assert_array_equal(start, before)
    assert found.converged.mean() > 0.95
    for n in np.flatnonzero(found.converged):
        part = slice(pointers[n], pointers[n + 1])
        best = scipy_minimum(t[part], y[part], found.states[n], cauchy_scale)
        square = (
            found.states[n][0] * np.exp(-np.exp(found.states[n][1]) * t[part]) + found.states[n][2] - y[part]
        ) ** 2
        square += (0.01 * found.states[n][2]) ** 2
        np.testing.assert_allclose(found.cost[n], square.sum(), rtol=1e-9)
        cost = square if np.isinf(cauchy_scale) else np.log1p(square / cauchy_scale**2) * cauchy_scale**2
        assert cost.sum() <= 2.0 * best.cost * (1 + 1e-9) + 1e-15
    if np.isfinite(cauchy_scale):
        assert np.median(np.abs(found.states - truth)) < 0.05


def test_information_is_that_of_the_jacobian():
    pointers, _, t, y, start = problems(1, count=5)
    found = solve_batch(DECAY, observed(t, y, pointers), start, 100)
    for n, (a, b, _c) in enumerate(found.states):
        at = t[pointers[n] : pointers[n + 1]]
        decay = np.exp(-np.exp(b) * at)
        J = np.stack([decay, -a * np.exp(b) * at * decay, np.ones_like(at)], axis=1)
        wanted = J.T @ J + np.diag([0.0, 0.0, 1e-4 * len(at)])
        np.testing.assert_allclose(found.information[n], wanted, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.frames[n], np.exp(b), rtol=1e-12)


def test_what_is_left_out_has_no_part():
    pointers, _, t, y, start = problems(2)
    active = np.random.default_rng(3).random(len(t)) < 0.8
    kept = np.concatenate([[0], np.cumsum(active)])[pointers]
    with_all = solve_batch(DECAY, observed(t, np.where(active, y, 1e6), pointers, active), start, 50)
    alone = solve_batch(DECAY, observed(t[active], y[active], kept), start, 50)
    np.testing.assert_array_equal(with_all.states, alone.states)
    np.testing.assert_array_equal(with_all.steps, alone.steps)


def test_odd_cases():
    pointers, _, t, y, start = problems(4, count=4)
    active = np.ones(len(t), bool)
    nothing = solve_batch(DECAY, observed(t, y, np.zeros(1, np.int64)), start[:0])
    assert nothing.states.shape == (0, 3) and nothing.information.shape == (0, 3, 3)
    active[pointers[1] : pointers[2]] = False  # nothing is known of the second
    active[pointers[2] + 1 : pointers[3]] = False  # one observation does not determine three numbers
    found = solve_batch(DECAY, observed(t, y, pointers, active), start, 50)
    np.testing.assert_array_equal(found.states[1], start[1])
    assert found.cost[1] == 0.0 and np.isfinite(found.states).all()
    assert found.cost[2] < 1e-3
    np.testing.assert_allclose(
        found.states[[0, 3]], solve_batch(DECAY, observed(t, y, pointers), start, 50).states[[0, 3]], rtol=1e-12
    )
    untouched = solve_batch(DECAY, observed(t, y, pointers, active), start, 0)
    np.testing.assert_array_equal(untouched.states, start)
    assert not untouched.converged.any()


def test_numbers_of_kinds_are_their_own():
    assert problem_kind(9, 3, 2, (1,), _frame, _residuals, _move) == DECAY
    with pytest.raises(InputError, match="its own; got 9"):
        problem_kind(9, 3, 2, (1,), _frame, _move, _move)
    with pytest.raises(InputError, match="positive"):
        problem_kind(0, 3, 2, (1,), _frame, _residuals, _move)
