# SPDX-License-Identifier: BSD-3-Clause
"""Numbers of arrays in compiled loops: the right ones, whatever the layout, the sign and the kind of the indices."""

import os
import subprocess
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
