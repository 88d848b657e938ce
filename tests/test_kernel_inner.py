# SPDX-License-Identifier: BSD-3-Clause
"""Functions compiled for linking only: callable from Python all the same, in any order, thread and process, and with
the numbers of Numba's own way."""

import math
import os
import subprocess
import sys
import threading
from itertools import pairwise
from pathlib import Path

import llvmlite.binding as llvm
import numba
import numpy as np
import pytest

from groma import _numba
from groma._kernels import inner
from groma._kernels.cache import _Cache
from groma._kernels.inner import Pipeline, _keeping_overloads, _NoMachineCode
from groma.compiled import kernel, loop

pytestmark = [pytest.mark.kernels, pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")]


def _made(decorate_inner, decorate_outer):
    """A kernel and a loop that calls it; new ones each time, not on disk before."""

    @decorate_inner
    def weighted(x, y):
        if y == 0.0:
            raise ValueError("nothing to divide by")
        return (x + 0.1) * (x + 0.2) / y + (x - 0.3) / (y + 0.7)

    @decorate_outer
    def total(values):
        found = 0.0
        for k in range(values.shape[0] - 1):
            found += weighted(values[k], values[k + 1])
        return found

    return weighted, total


@pytest.fixture
def pair(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    return _made(kernel, loop)


def _has_machine_code(function):
    return [not isinstance(result.entry_point, _NoMachineCode) for result in function.overloads.values()]


VALUES = np.linspace(0.5, 2.0, 37)


def test_python_calls_what_a_loop_has_inlined(pair):
    weighted, total = pair
    total(VALUES)
    assert _has_machine_code(weighted) == [False]
    assert weighted(1.0, 2.0) == pytest.approx(1.1 * 1.2 / 2 + 0.7 / 2.7, rel=1e-15)
    assert _has_machine_code(weighted) == [True]
    with pytest.raises(ValueError, match="nothing to divide by"):
        weighted(1.0, 0.0)


def test_a_loop_inlines_what_python_has_called(pair):
    weighted, total = pair
    weighted(1.0, 2.0)
    expected = sum(weighted(x, y) for x, y in pairwise(VALUES))
    assert total(VALUES) == pytest.approx(expected, rel=1e-14)
    assert _has_machine_code(weighted) == [True]


def test_an_error_inside_is_raised(pair):
    with pytest.raises(ValueError, match="nothing to divide by"):
        pair[1](np.array([1.0, 0.0]))


@loop
def _long(x):
    """Too long to be inlined."""
    for _ in range(3):
        x = math.sin(x) + math.cos(2.0 * x) + math.tan(3.0 * x) + math.exp(-x * x) + math.log(1.0 + x * x)
        x = math.sinh(x) + math.cosh(x) + math.tanh(x) + math.asinh(x) + math.atan(x) + math.erf(x)
        x = math.sin(4.0 * x) + math.cos(5.0 * x) + math.tan(6.0 * x) + math.exp(-x) + math.log(2.0 + x * x)
        x = math.sinh(x) - math.cosh(x) + math.tanh(x) + math.asinh(x) - math.atan(x) + math.erf(x)
    return x


@loop
def _twice(values):
    return _long(values[0]) + _long(values[1])


def test_what_is_linked_in_is_of_one_library_alone(tmp_path, monkeypatch):
    """Else the library that is loaded first gives its code to the others: digits would hang on the order."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    twice = loop(_twice.py_func)  # not on disk
    twice(VALUES)
    library = twice.overloads[numba.typeof(VALUES),].library
    defined = {f.name: f.linkage for f in library._final_module.functions if not f.is_declaration}
    assert any("_long" in name for name in defined)
    assert llvm.Linkage.linkonce_odr not in defined.values()


def _sum_of(values):
    total = 0.0
    for value in values:
        total += value
    return total


def test_loops_are_vectorised_only_where_it_is_said(tmp_path, monkeypatch):
    """Both lie on disk under the same name: one is not taken for the other."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    texts = []
    for decorate in (loop, _numba.unrolled_loop):
        total = decorate(_sum_of)
        assert total(np.arange(100.0)) == 4950.0
        texts.append(str(total.overloads[numba.typeof(VALUES),].library._final_module))
    assert ["x double>" in text for text in texts] == [False, True]


def test_a_kernel_called_with_two_constants_is_compiled_once(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))

    @kernel
    def power(x, exponent):
        return x if exponent == 1 else x * x

    @loop
    def both(x):
        return power(x, 1) + power(x, 2)

    assert both(3.0) == 12.0
    assert [*power.overloads] == [(numba.float64, numba.int64)]


def test_functions_of_numba_alone_between(pair):
    """They call kernels, and are called by loops."""
    weighted, _ = pair

    @numba.njit
    def twice(x, y):
        return 2.0 * weighted(x, y)

    @loop
    def both(values):
        return twice(values[0], values[1]) + weighted(values[0], values[1])

    values = np.array([1.0, 2.0])
    once = 1.1 * 1.2 / 2 + 0.7 / 2.7
    assert both(values) == pytest.approx(3 * once, rel=1e-15)
    assert twice(1.0, 2.0) == pytest.approx(2 * once, rel=1e-15)
    assert weighted(1.0, 2.0) == pytest.approx(once, rel=1e-15)


def test_the_numbers_are_those_of_numba_alone(pair):
    options = {name: option for name, option in _numba._OPTIONS.items() if option is not Pipeline}
    _, plain = _made(numba.njit(**options, forceinline=True), numba.njit(**options))
    for count in (2, 3, 8, 37):
        assert pair[1](VALUES[:count].copy()).hex() == plain(VALUES[:count].copy()).hex()


def test_an_unknown_version_of_numba_compiles_in_its_own_way(pair, monkeypatch, tmp_path):
    expected = pair[1](VALUES).hex()
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "own"))
    monkeypatch.setattr(inner, "is_known", False)
    monkeypatch.setattr(inner._Steps, "_runPass", None)
    weighted, total = _made(kernel, loop)
    assert total(VALUES).hex() == expected
    assert _has_machine_code(weighted) == [True]
    assert weighted(1.0, 2.0) == pytest.approx(1.1 * 1.2 / 2 + 0.7 / 2.7, rel=1e-15)


def test_a_thread_that_calls_while_another_one_compiles(pair):
    weighted, total = pair
    found = []
    threads = [threading.Thread(target=lambda: found.append(weighted(1.0, 2.0))) for _ in range(4)]
    threads.insert(2, threading.Thread(target=lambda: total(VALUES)))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [weighted(1.0, 2.0)] * 4


PROGRAM = """
import sys
import numpy as np
from groma.compiled import kernel, loop
from groma._kernels.cache import counts

@kernel
def square(x):
    return x * x

@loop
def total(values):
    found = 0.0
    for value in values:
        found += square(value)
    return found

@loop
def largest(values):
    found = 0.0
    for value in values:
        found = max(found, square(value))
    return found

for name in sys.argv[1:]:
    print({"total": lambda: total(np.ones(3)), "largest": lambda: largest(np.ones(3)), "square": lambda: square(2.0)}[name]())
print(counts.compiled, counts.loaded)
"""  # noqa: E501


def test_another_process_links_what_this_one_has_kept(tmp_path):
    path = tmp_path / "program.py"
    path.write_text(PROGRAM)

    def run(*names):
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        return subprocess.check_output([sys.executable, path, *names], text=True, env=environment).split()

    assert run("total") == ["3.0", "2", "0"]  # the loop, and the kernel for it
    assert run("largest") == ["1.0", "2", "1"]  # the loop, and Numba's ``max``
    assert run("square", "total") == ["4.0", "3.0", "1", "1"]
    assert run("largest", "square", "total") == ["1.0", "4.0", "3.0", "0", "3"]
    sizes = sorted(file.stat().st_size for file in Path(tmp_path).rglob("*.square-*.nbc"))
    assert len(sizes) == 2 and sizes[0] < 0.7 * sizes[1]
    (largest,) = Path(tmp_path).rglob("builtins.ol_max.*.nbc")
    assert largest.parent.name.startswith("groma_")  # where groma's functions lie, not beside those of Numba


def _doubled(value):
    return 2.0 * value


@numba.extending.overload(_doubled)
def _overload_of_doubled(value):
    return lambda value: 2.0 * value


@loop
def _all_doubled(values, out):
    for k in range(values.shape[0]):
        out[k] = _doubled(values[k])


def test_numba_uses_its_own_functions_after_they_were_compiled_for_linking(monkeypatch, tmp_path):
    """Numba makes ``np.empty`` and the like in this way, once in a process."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    made, out, again = [], np.zeros(len(VALUES)), np.zeros(len(VALUES))
    keep = _keeping_overloads
    monkeypatch.setattr(inner, "_keeping_overloads", lambda by: keep(lambda one: made.append(by(one)) or made[-1]))
    _all_doubled(VALUES, out)
    assert np.array_equal(out, 2.0 * VALUES)
    assert made and not any(any(_has_machine_code(function)) for function in made)
    numba.njit(_all_doubled.py_func)(VALUES, again)
    assert np.array_equal(again, out)
    for function in made:  # as for a call from Python
        for kinds in list(function.overloads):
            function.compile(kinds)
        assert all(_has_machine_code(function))


def test_functions_of_numba_are_kept_by_what_they_hold():
    """What cannot be followed might be anything, and two processes may mean different things by it."""

    def key(held):
        def implementation(x):
            return x + held

        implementation.__module__ = "numba.np.arrayobj"
        return _Cache(implementation)._key((numba.float64,), ())

    assert key(object()) is None
    assert key(1.0) == key(1.0) != key(2.0)


HISTORY = r"""
import re, sys
import numpy as np
from groma.compiled import kernel, loop

@kernel
def larger(x, y):
    return max(x, y)

@loop
def copied(values):
    out = np.empty(values.shape[0])
    for k in range(values.shape[0]):
        out[k] = larger(values[k], max(0.25, values[k] - 1.0))
    return out

@loop
def counted(values):
    return np.zeros(values.shape[0], np.int64)

@loop
def total(values):
    copy, found = copied(values), counted(values)
    for k in range(values.shape[0]):
        found[k] = int(max(copy[k], 0.5))
    return copy.sum() + found.sum()

for name in sys.argv[1:]:
    globals()[name](np.ones(3))
for result in total.overloads.values():
    print(*re.findall(r"^\t([a-z]\w+)", result.library.get_asm_str(), re.M))
"""


def test_machine_code_is_the_same_whatever_was_compiled_before(tmp_path):
    """By this process or others, with other orders of sets: names in kept code must not tell them apart."""
    (tmp_path / "program.py").write_text(HISTORY)

    def run(cache, seed, *names):
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / cache), "PYTHONHASHSEED": seed}
        return subprocess.check_output([sys.executable, "program.py", *names], text=True, env=environment, cwd=tmp_path)

    expected = run("fresh", "1", "total")
    assert len(expected.split()) > 100
    assert run("called before", "2", "copied", "counted", "total") == expected
    run("kept by others", "3", "counted", "copied")
    assert run("kept by others", "4", "total") == expected
