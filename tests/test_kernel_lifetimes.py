# SPDX-License-Identifier: BSD-3-Clause
"""Last uses of variables, found on demand: those that Numba finds, and Numba itself is as it was afterwards."""

import numba
import numpy as np
import pytest
from numba.core import analysis, ir
from numba.core.compiler import run_frontend
from numba.core.postproc import PostProcessor

from groma._kernels import lifetimes
from groma._numba import loop

pytestmark = [pytest.mark.kernels, pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")]


def _nested(values, limit):
    best, where = 0.0, -1
    for i in range(values.shape[0]):
        row = values[i]
        for j in range(len(row)):
            if row[j] > limit:
                continue
            best, where = row[j] * values[i, 0], i
        if best < 0.0:
            break
    else:
        where = where + 1
    values[where, 0], values[0][0] = best, limit
    return best, where


def _slices(values):
    values[1:, ::2] = 0.0
    first = [row[0] for row in values]
    del values
    return sum(first)


def _steps(function):
    """Blocks of a function, with what is forgotten after each statement, in any order where several are."""
    found = []
    for offset, block in function.blocks.items():
        for statement in block.body:
            if isinstance(statement, ir.Del) and isinstance(found[-1], set):
                found[-1].add(statement.value)
            else:
                found.append({statement.value} if isinstance(statement, ir.Del) else (offset, str(statement)))
    return found


def _forgotten(function):
    described = run_frontend(function)
    PostProcessor(described).run(emit_dels=True)
    return _steps(described), described


@pytest.mark.parametrize("function", [_nested, _slices])
def test_the_same_is_forgotten_after_each_statement(function):
    expected, described = _forgotten(function)
    uses = analysis.compute_use_defs(described.blocks)
    variables = [[v.name for v in s.list_vars()] for b in described.blocks.values() for s in b.body]
    with lifetimes.on_demand():
        found, _ = _forgotten(function)
        assert analysis.compute_use_defs is not lifetimes._uses_and_definitions
        assert analysis.compute_use_defs(described.blocks) == uses
        assert [[v.name for v in s.list_vars()] for b in described.blocks.values() for s in b.body] == variables
    assert found == expected
    assert any(isinstance(step, set) for step in found)


def test_numba_is_as_it_was():
    with pytest.raises(KeyError), lifetimes.on_demand(), lifetimes.on_demand():
        raise KeyError
    assert PostProcessor.run is lifetimes._process
    assert ir.Inst._rec_list_vars is lifetimes._list_variables
    assert analysis.compute_use_defs is lifetimes._uses_and_definitions


@loop
def _halves(values):
    for value in values:
        yield 0.5 * value
        yield -value


@loop
def _told(values):
    total = 0.0
    with numba.objmode(total="float64"):
        total = float(np.asarray(values).sum())
    return total + values[0]


@pytest.mark.filterwarnings("ignore:Code running in object mode")
def test_generators_and_plain_python_inside():
    assert list(_halves(np.array([2.0, 4.0]))) == [1.0, -2.0, 2.0, -4.0]
    assert _told(np.array([2.0, 4.0])) == 8.0


def _with_dictionary(value):
    return {1: value, **{2: 2 * value}}  # noqa: PIE800 - dictionaries that are joined are what is tested


@pytest.mark.parametrize(("function", "count"), [(_nested, 0), (_with_dictionary, 2)])
def test_steps_are_taken_where_there_is_something_to_find(function, count, monkeypatch):
    taken = []
    monkeypatch.setattr(lifetimes, "_post_process", lambda _self, steps, _function: taken.extend(steps))
    described = run_frontend(function)
    lifetimes._post_process_on_demand(None, lifetimes._LOOKING, described)
    assert len(taken) == count
