# SPDX-License-Identifier: BSD-3-Clause
"""Slices of arrays, parts that are filled with a number, largest and least numbers in compiled loops; short code."""

import itertools
import sys

import numba
import numpy as np
import pytest
from numba.core.codegen import CPUCodeLibrary

from groma._kernels.inner import Pipeline
from groma._numba import loop

pytestmark = [pytest.mark.kernels, pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")]


def _layouts():
    plain = np.arange(12.0).reshape(3, 4)
    other = np.arange(48.0).reshape(6, 8)[::2, ::2]
    return {"C": plain, "F": np.asfortranarray(plain), "A": other, "backwards": plain[::-1, ::-1]}


@loop
def _slices(row, table, begin, end):
    return row[begin:end], row[:end], row[begin:], table[begin, :end], table[1, begin:end]


@pytest.mark.parametrize("layout", ["C", "F", "A", "backwards"])
def test_slices_are_those_of_numpy(layout):
    table, made = _layouts()[layout], []
    for begin in (-3, -2, 0, 1, 2):
        for end in (-9, -4, -1, 0, 2, 3, 4, 9):
            row = table[0]
            for found, expected in zip(
                _slices(row, table, begin, end), _slices.py_func(row, table, begin, end), strict=True
            ):
                np.testing.assert_array_equal(found, expected)
                assert found.shape == expected.shape
                assert found.strides == expected.strides
            made.append(len(_slices(row, table, begin, end)[0]))
    assert min(made) == 0 < max(made)
    before = sys.getrefcount(table)
    _slices(table[0], table, 0, 2)
    assert sys.getrefcount(table) == before


@loop
def _fill(row, table, cube, value):
    row[:] = value
    table[:, :] = value
    cube[1] = value
    cube[0, -1] = value


@pytest.mark.parametrize("step", [1, 2])
@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int32, bool])
def test_parts_are_filled_and_nothing_else(kind, step):
    room = [np.ones(shape, kind) for shape in ((8,), (4, 6), (4, 6, 4))]
    expected = [one.copy() for one in room]
    for arrays, fill in ((room, _fill), (expected, _fill.py_func)):
        fill(arrays[0][::step], arrays[1][:2, ::step], arrays[2][:2, ::step], 0.0)
    for found, other in zip(room, expected, strict=True):
        np.testing.assert_array_equal(found, other)
    _fill(np.empty(0, kind), np.empty((0, 3), kind), np.empty((2, 1, 0), kind), 0.0)


@loop
def _extremes(a, b, c):
    return max(a, b), min(a, b), max(a, b, c), min(a, b, c), max(a, 1), min(2.5, b), max((a, b)), min(*(a, b))


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64, np.int32])
def test_extremes_are_those_of_python(kind):
    numbers = [-3, 0, 2] + ([-0.0, np.inf, np.nan] if issubclass(kind, np.floating) else [])
    wide = {np.float64: float, np.float32: np.float32}.get(kind, int)
    for a, b, c in itertools.product(map(kind, numbers), repeat=3):
        expected = _extremes.py_func(*map(wide, (a, b, c)))
        for found, one in zip(_extremes(a, b, c), expected, strict=True):
            np.testing.assert_array_equal(np.float64(found), np.float64(one))
            assert np.signbit(np.float64(found)) == np.signbit(np.float64(one)) or found != found


@loop
def _larger(a, b):
    return max(a, b)


def test_their_code_is_short(monkeypatch):
    """Numba's has 1,400 lines for the fills, 1,300 for the slices, and calls a function for the larger number."""
    made, add = [], CPUCodeLibrary.add_ir_module
    monkeypatch.setattr(CPUCodeLibrary, "add_ir_module", lambda self, one: made.append(str(one)) or add(self, one))
    row, table = np.zeros(4), np.zeros((3, 4))
    for run, arguments in ((_fill, (row, table, np.zeros((2, 3, 4)), 0.0)), (_slices, (row, table, 0, 2))):
        numba.njit(pipeline_class=Pipeline)(run.py_func)(*arguments)  # not kept on disk
    assert max(len(one.splitlines()) for one in made) < 1000
    made.clear()
    assert numba.njit(pipeline_class=Pipeline)(_larger.py_func)(1.0, 2.0) == 2.0
    assert not any("ol_max" in one for one in made)
