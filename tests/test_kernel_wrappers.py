# SPDX-License-Identifier: BSD-3-Clause
"""Calls of compiled loops from Python: arguments arrive, errors are raised, nobody keeps an array that was passed."""

import sys

import numba
import numpy as np
import pytest

from groma._numba import loop

pytestmark = [
    pytest.mark.kernels,
    pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled"),
]


@loop
def _all_kinds(tag, numbers, whole, factor, is_negative, pair, out):
    for row in range(numbers.shape[0]):
        value = numbers[row, 1] * factor + whole[row] + pair[0] - pair[1] + len(tag)
        out[row] = -value if is_negative else value


@loop
def _same(first, second):
    return first if first[0] > second[0] else second


@loop
def _refuse_negative(first, second):
    if second[0] < 0:
        raise ValueError("negative")
    return first[0]


@loop
def _length(name, values):
    return len(name) + len(values)


def _counts(*arrays):
    return [sys.getrefcount(array) for array in arrays]


@pytest.mark.parametrize("layout", ["C", "F", "A"])
def test_arguments_of_all_kinds_arrive(layout):
    numbers = {"C": np.arange(6.0).reshape(3, 2), "F": np.asfortranarray(np.arange(6.0).reshape(3, 2)),
               "A": np.arange(24.0).reshape(6, 4)[::2, ::2]}[layout]  # fmt: skip
    whole, out = np.arange(3, dtype=np.int32), np.empty(3)
    expected = numbers[:, 1] * 2.5 + whole + 4 - 7 + 2
    before = _counts(numbers, whole, out)
    for is_negative in (False, True):
        _all_kinds((None, None), numbers, whole, 2.5, is_negative, (4, 7), out)
        np.testing.assert_array_equal(out, -expected if is_negative else expected)
    assert _counts(numbers, whole, out) == before


def test_a_returned_argument_belongs_to_its_receiver():
    first, second = np.ones(3), np.zeros(3)
    before = _counts(first, second)
    found = _same(first, second)
    assert found is first or np.shares_memory(found, first)
    del found
    assert _counts(first, second) == before


def test_an_exception_is_raised_and_arrays_are_let_go():
    first, second = np.ones(3), -np.ones(3)
    before = _counts(first, second)
    with pytest.raises(ValueError, match="negative"):
        _refuse_negative(first, second)
    assert _counts(first, second) == before
    assert _refuse_negative(first, first) == 1


@pytest.mark.parametrize("wrong", [np.ones(3, dtype=np.float32), "no array", None])
@pytest.mark.parametrize("place", [0, 1])
def test_what_is_no_such_array_is_refused_and_the_others_are_let_go(wrong, place):
    right = np.ones(3)
    _refuse_negative(right, right)
    (compiled,) = _refuse_negative.overloads.values()
    before = _counts(right, wrong)
    given = [right, right]
    given[place] = wrong
    with pytest.raises(TypeError, match="can't unbox array"):
        compiled.entry_point(*given)
    del given
    assert _counts(right, wrong) == before


def test_a_number_that_is_none_is_refused():
    arrays = np.ones((2, 2)), np.ones(2, dtype=np.int32), np.ones(2)
    _all_kinds((None,), arrays[0], arrays[1], 1.0, True, (1, 2), arrays[2])
    (compiled, *_) = [found for kinds, found in _all_kinds.overloads.items() if kinds[0].count == 1]
    before = _counts(*arrays)
    with pytest.raises(TypeError):
        compiled.entry_point((None,), arrays[0], arrays[1], "no number", True, (1, 2), arrays[2])
    assert _counts(*arrays) == before


def test_other_arguments_go_the_way_of_numba():
    assert _length("name", np.ones(3)) == 7
    assert _length("name", (1.0, 2.0)) == 6
