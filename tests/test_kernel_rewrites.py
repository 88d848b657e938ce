# SPDX-License-Identifier: BSD-3-Clause
"""Functions inside functions, lists and arithmetic on whole arrays compile, though loops of groma need none of them."""

import numba
import numpy as np
import pytest

from groma._kernels import rewrites
from groma._numba import loop

pytestmark = [pytest.mark.kernels, pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")]


@loop
def _inside(value):
    def twice(x):
        return 2.0 * x

    return twice(value) + 1.0


@loop
def _of_list(value):
    return np.array([value, 2.0 * value])


@loop
def _of_comprehension(count):
    return np.array([0.5 * k for k in range(count)])


@loop
def _arithmetic(a, b):
    return np.sqrt(a * 2.0 + b) - a


@loop
def _numbers(values):
    total = 0.0
    for value in values:
        total += np.sqrt(value)
    return total


def _steps_of(function, arguments, monkeypatch):
    """Return whether each of the two steps of Numba was taken while a function was compiled."""
    taken = []
    for step in (rewrites.NumbaInlineClosureLikes, rewrites.NumbaRewrites):
        before = step.run_pass
        monkeypatch.setattr(
            step, "run_pass", lambda self, state, step=step, before=before: taken.append(step) or before(self, state)
        )
    assert function._cache.cache_path  # opened, else the methods of what stands for it would be replaced
    monkeypatch.setattr(function._cache, "load_overload", lambda *_: None)
    monkeypatch.setattr(function._cache, "save_overload", lambda *_: None)
    found = function(*arguments)
    return found, [step in taken for step in (rewrites.NumbaInlineClosureLikes, rewrites.NumbaRewrites)]


@pytest.mark.parametrize(
    ("function", "arguments", "steps"),
    [
        (_inside, (3.0,), [True, False]),
        (_of_list, (3.0,), [True, True]),
        (_of_comprehension, (3,), [True, None]),
        (_arithmetic, (np.ones(3), np.arange(3.0)), [None, True]),
        (_numbers, (np.ones(3),), [False, False]),
    ],
)
def test_steps_are_taken_where_they_are_needed(function, arguments, steps, monkeypatch):
    found, taken = _steps_of(function, arguments, monkeypatch)
    np.testing.assert_allclose(found, function.py_func(*arguments), rtol=1e-15)
    assert all(wanted in (None, was) for wanted, was in zip(steps, taken, strict=True))
