# SPDX-License-Identifier: BSD-3-Clause
"""Compiled code that was taken apart and put together again: it runs, and what others are compiled with comes later."""

import pickle

import numpy as np
import pytest
from numba import config, njit
from numba.core.registry import cpu_target
from numba.core.serialize import dumps

if config.DISABLE_JIT:  # type: ignore[attr-defined]
    pytest.skip("no compiled code without the compiler", allow_module_level=True)

from groma._kernels.loading import rebuilt


def _rebuilt(function, *example):
    function(*example)
    (compiled,) = function.overloads.values()
    payload = pickle.loads(dumps(compiled._reduce()))
    return rebuilt(cpu_target.target_context, payload)


def test_a_rebuilt_function_runs_and_is_parsed_when_another_is_compiled_with_it():
    scale = 2.5

    @njit
    def scaled_sum(values):
        total = 0.0
        for value in values:
            total += value * scale
        return total

    values = np.arange(5.0)
    found = _rebuilt(scaled_sum, values)
    assert found.entry_point(values) == 25.0
    assert found.library._parsed is None
    assert found.target_context is cpu_target.target_context
    module = found.library._get_module_for_linking()
    assert any(not function.is_declaration for function in module.functions)
    assert found.library._get_module_for_linking() is module
    assert found.library.get_pointer_to_function("no_such_function") == 0
