# SPDX-License-Identifier: BSD-3-Clause
"""Numbers and parts of arrays in compiled loops, whatever the layout, the sign and the kind of the indices; ranges."""

import os
import subprocess
import sys

import numba
import numpy as np
import pytest
from numba.core import compiler
from numba.core.codegen import CPUCodeLibrary

from groma._kernels.elements import _assigned_before_use
from groma._kernels.inner import Pipeline
from groma._numba import loop

pytestmark = [pytest.mark.kernels, pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")]


@loop
def _read(array, first, second):
    return array[first, second]


@loop
def _read_fixed(array):
    return array[1, 2], array[-1, 0], array[0, -2]


@loop
def _write(array, first, second, value):
    array[first, second] = value


@loop
def _read_by_tuple(array, index):
    return array[index]


@loop
def _add_up(values):
    total = values[0]
    for k in range(1, len(values)):
        total += values[k]
    return total


@loop
def _part(array, index):
    return array[index]


@loop
def _part_of_three(array, first, second):
    return array[first, second], array[first][second]


@loop
def _part_of_what_is_gone(size):
    array = np.empty((size, 3))
    for i in range(size):
        array[i] = i
    return array[size - 1]


@loop
def _sum_of_row(row):
    total = 0.0
    for value in row:
        total += value
    return total


@loop
def _sums_of_rows(array, out):
    for i in range(array.shape[0]):
        out[i] = _sum_of_row(array[i])


@loop
def _counted(start, end, step):
    visited, last = 0, -1
    for i in range(start, end, step):
        visited, last = visited + 1, i
    return visited, last


@loop
def _counted_by_one(start, end):
    visited, last = 0, -1
    for i in range(start, end):
        visited, last = visited + 1, i
        i += 5
    return visited, last


@loop
def _nested(count):
    total = 0
    for _ in range(2):
        numbers = range(count)
        for i in numbers:
            if i == 3:
                continue
            for j in range(i):
                if j == 2:
                    break
                total += 10 * i + j
    return total + len(range(count))


def _layouts():
    plain = np.arange(12.0).reshape(3, 4)
    return {
        "C": plain,
        "F": np.asfortranarray(plain),
        "A": np.arange(48.0).reshape(6, 8)[::2, ::2],
        "backwards": plain[::-1, ::-1],
        "integers": np.arange(12, dtype=np.int32).reshape(3, 4),
        "booleans": np.arange(12).reshape(3, 4) % 3 == 0,
    }


@pytest.mark.parametrize("layout", _layouts())
def test_every_element_is_read(layout):
    array = _layouts()[layout]
    for i in range(-3, 3):
        for j in range(-4, 4):
            assert _read(array, i, j) == array[i, j]
            assert _read_by_tuple(array, (i, j)) == array[i, j]
    assert _read(array, np.uint32(2), np.int8(-1)) == array[2, -1]
    assert _read_fixed(array) == (array[1, 2], array[-1, 0], array[0, -2])


@pytest.mark.parametrize("layout", _layouts())
def test_one_element_is_written_and_no_other(layout):
    for i in range(-3, 3):
        for j in (-4, -1, 0, 3):
            array, expected = _layouts()[layout].copy(order="K"), _layouts()[layout].copy(order="K")
            _write(array, i, j, 7.9)
            expected[i, j] = 7.9
            np.testing.assert_array_equal(array, expected)


def test_of_one_axis():
    values = np.arange(20.0) ** 2
    assert _add_up(values) == values.sum()
    assert _add_up(values[::3]) == values[::3].sum()
    assert _add_up(values[::-1]) == values.sum()


def test_numba_checks_bounds_where_it_is_asked_to():
    program = (
        "import numpy as np\nfrom tests_elements import read\n"
        "try:\n    read(np.zeros(3), 5)\nexcept IndexError:\n    print('refused')"
    )
    module = "from groma._numba import loop\n@loop\ndef read(a, k):\n    return a[k]\n"
    code = f"import sys, types\nm = types.ModuleType('tests_elements')\nexec({module!r}, m.__dict__)\n"
    code += "sys.modules['tests_elements'] = m\n" + program
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, "NUMBA_BOUNDSCHECK": "1"},
    )
    assert done.stdout.strip() == "refused", done.stderr


@pytest.mark.parametrize("layout", _layouts())
def test_parts_are_views(layout):
    for i in range(-3, 3):
        array = _layouts()[layout]
        found = _part(array, i)
        np.testing.assert_array_equal(found, array[i])
        assert found.shape == array[i].shape
        assert found.strides == array[i].strides
        found[1] = 1
        np.testing.assert_array_equal(found, array[i])
    three = np.asfortranarray(np.arange(24.0).reshape(2, 3, 4))
    for array in (three, np.ascontiguousarray(three), three[::-1, :, ::2], three.transpose(1, 0, 2)):
        for found in _part_of_three(array, 1, np.int32(-1)):
            np.testing.assert_array_equal(found, array[1, -1])
        np.testing.assert_array_equal(_part(array, np.uint8(1)), array[1])


def test_parts_of_what_must_not_be_written():
    array = np.arange(6.0).reshape(2, 3)
    array.flags.writeable = False
    found = _part(array, 1)
    np.testing.assert_array_equal(found, array[1])
    assert not found.flags.writeable


def test_a_part_keeps_what_it_is_part_of():
    """And nothing else does: counts of references are as they were."""
    parts = [_part_of_what_is_gone(50) for _ in range(20)]
    for found in parts:
        np.testing.assert_array_equal(found, np.full(3, 49.0))
    array, out = np.arange(12.0).reshape(4, 3), np.empty(4)
    before = sys.getrefcount(array)
    for _ in range(10):
        _sums_of_rows(array, out)
    assert sys.getrefcount(array) == before
    np.testing.assert_array_equal(out, array.sum(axis=1))


@pytest.mark.parametrize("kind", [int, np.int32, np.uint64])
def test_ranges_are_those_of_python(kind):
    ends = range(5) if kind is np.uint64 else range(-3, 5)
    for start in ends:
        for end in ends:
            expected = list(range(start, end))
            assert _counted_by_one(kind(start), kind(end)) == (len(expected), expected[-1] if expected else -1)
            for step in (1, 2, 7) if kind is np.uint64 else (-3, -1, 1, 2, 7):
                expected = list(range(start, end, step))
                found = _counted(kind(start), kind(end), kind(step))
                assert found == (len(expected), expected[-1] if expected else -1)
    with pytest.raises(ValueError, match="must not be zero"):
        _counted(kind(0), kind(3), kind(0))


def test_ranges_in_ranges():
    for count in range(7):
        assert _nested(count) == _nested.py_func(count)


@loop
def _quotients(a, b, out):
    for i in range(len(a)):
        out[i] = a[i] / b[i]
        out[i] += 1.0 / b[i]


def test_complex_numbers_are_divided_as_numpy_does():
    numbers = np.array([1.0, -2.0j, 3.0 + 4.0j, 1e200 - 1e-200j, 0.0])
    a, b = (numbers[index] for index in np.indices((5, 5)).reshape(2, -1))
    out = np.empty_like(a)
    _quotients(a, b, out)
    with np.errstate(all="ignore"):
        expected = a / b + 1.0 / b
    np.testing.assert_allclose(out[b != 0.0], expected[b != 0.0], rtol=1e-14)
    assert not np.isfinite(out[b == 0.0]).any()


@loop
def _squares(x, n):
    return x**2, n**2, (x + n) ** 2, np.float32(x) ** 2, x**3, np.float64(SQUARED**2), x**SQUARED


SQUARED = 2


@pytest.mark.parametrize("x", [-1.5, 0.1, 1e200, np.nan])
def test_squares_are_products(x):
    with np.errstate(over="ignore", invalid="ignore"):
        n, single = np.int64(-7), np.float32(x)
        expected = (x * x, 49, (x + n) * (x + n), single * single, x * x * x, 4.0, x * x)
    np.testing.assert_array_equal(_squares(x, n), expected)


def _with_branches(values, count):
    first = values[0]
    total = 0.0
    for i in range(count):
        twice = 2.0 * first
        if i > 1:
            late = twice + i
            total = total + late
    if count > 2:
        total = total + late
    return total


def test_variables_that_stay_in_registers_are_assigned_before_each_use():
    found = _assigned_before_use(compiler.run_frontend(_with_branches).blocks)
    assert {"values", "count", "first", "twice"} <= found
    assert found.isdisjoint(("total", "late"))  # assigned twice, and in a branch that need not be taken


def test_variables_of_branches_and_loops_have_the_values_of_python(monkeypatch):
    made, add = [], CPUCodeLibrary.add_ir_module
    monkeypatch.setattr(CPUCodeLibrary, "add_ir_module", lambda self, one: made.append(str(one)) or add(self, one))
    compiled = numba.njit(pipeline_class=Pipeline)(_with_branches)  # not kept on disk
    for count in range(6):
        assert compiled(np.array([1.5, 7.0]), count) == _with_branches(np.array([1.5, 7.0]), count)
    rooms = {line.split("=")[0].strip(' %"') for line in made[0].splitlines() if "= alloca" in line}
    assert any(room.startswith("total") for room in rooms)
    assert rooms.isdisjoint(("count", "first", "twice"))


@loop
def _rows_one_after_another(array, count):
    chosen = array[0]
    total = 0.0
    for i in range(count):
        row = array[i]
        for j in range(len(row)):
            total += chosen[j] * row[j]
        if total > 20.0:
            chosen = row
    return total, chosen


def test_parts_that_are_replaced_in_a_loop_are_counted():
    array = np.arange(12.0).reshape(4, 3)
    before = sys.getrefcount(array)
    for count in range(5):
        (total, chosen), (expected, part) = (
            run(array, count) for run in (_rows_one_after_another, _rows_one_after_another.py_func)
        )
        assert total == expected
        np.testing.assert_array_equal(chosen, part)
        del chosen, part
    assert sys.getrefcount(array) == before


@loop
def _computed(a, b):
    return a + b, a - b, a * b, a / b, a < b, a <= b, a > b, a >= b, a == b, a != b


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64, np.int32, bool])
def test_numbers_are_computed_and_compared_as_numpy_does(kind):
    numbers = [0, 1] if kind is bool else [-3, 0, 1]
    numbers += [-0.0, np.inf, -np.inf, np.nan] if issubclass(kind, np.floating) else []
    wide = {np.float64: float, np.float32: np.float32}.get(kind, int)
    for first in numbers:
        for second in numbers:
            a, b = kind(first), kind(second)
            x, y = wide(a), wide(b)
            with np.errstate(all="ignore"):
                expected = (x + y, x - y, x * y, np.divide(x, y), x < y, x <= y, x > y, x >= y, x == y, x != y)
            np.testing.assert_array_equal(_computed(a, b), expected)
