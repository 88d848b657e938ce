# SPDX-License-Identifier: BSD-3-Clause
"""What the digest of a compiled function is made of: values, closures, overloads, versions, parts of the compiler."""

import importlib
import pkgutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from numba.extending import overload

import groma
from groma._kernels import digest as kernel_digest
from groma._kernels import inner as kernel_inner

pytestmark = [pytest.mark.kernels, pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")]


def _content(function, kinds=()):
    return kernel_digest.dependence(function, kinds).content


def _made(source, **names):
    """Functions written in a text."""
    space = {"__name__": "made", **names}
    exec(source, space)
    return SimpleNamespace(**space)


def test_functions_that_call_each_other():
    source = "def even(n): return n == 0 or odd(n - 1)\ndef odd(n): return n != 0 and even(n - {})"
    first, second, third = (_made(source.format(step)) for step in (1, 1, 3))
    assert _content(first.even) == _content(second.even)
    assert _content(first.even) != _content(third.even)
    assert _content(first.odd) != _content(first.even)
    # through a table
    source = "def use(): return table, {}\ntable['use'] = use"
    first, second, third = (_made(source.format(number), table={}) for number in (1, 1, 2))
    assert _content(first.use) == _content(second.use) != _content(third.use)


def test_which_of_two_names_stands_for_which_counts():
    source = "def a(x): return x\ndef b(x): return 2 * x\nc, d = {}\ndef top(x): return a(x) + b(x) + c(x) - d(x)"
    assert _content(_made(source.format("a, b")).top) != _content(_made(source.format("b, a")).top)


@pytest.mark.parametrize(
    ("one", "other"),
    [(1, 1.0), (0.0, -0.0), (1, True), ((1, 2), (1, 2.0)), (np.float32(1), np.float64(1)), ("a", b"a"),
     (np.zeros(2), np.zeros((1, 2))), (np.zeros(2), np.zeros(2, int)), ({"a": 1}, {"a": 2}), ([1], [2])],
)  # fmt: skip
def test_values_that_compile_to_other_code_are_told_apart(one, other):
    source = "def use(): return value"
    assert _content(_made(source, value=one).use) != _content(_made(source, value=other).use)
    assert _content(_made(source, value=one).use) == _content(_made(source, value=one).use)


def test_a_constant_that_is_also_the_docstring_counts():
    source = "def use():\n    '{0}'\n    return '{0}'"
    assert _content(_made(source.format("a")).use) != _content(_made(source.format("b")).use)


def test_closures_count():
    make = _made("def make(k): return lambda x: x + k").make
    assert _content(make(1)) == _content(make(1)) != _content(make(2))


def test_what_changes_while_the_process_runs_is_not_found_by_another():
    array = np.zeros(2)
    made = _made("def inner(): return array[0] + value\ndef use(): return inner()", array=array, value=1)
    before = _content(made.use)
    assert _content(made.use) == before
    made.inner.__globals__["value"] = 2
    changed = _content(made.use)
    made.inner.__globals__["value"] = 1
    assert len({before, changed, _content(made.use)}) == 3
    made = _made("def use(): return array[0]", array=array)
    before = _content(made.use)
    array[:] = 1.0
    assert _content(made.use) not in (before, _content(_made("def use(): return array[0]", array=np.ones(2)).use))


def test_an_overload_that_comes_late_counts():
    made = _made("def twice(x): return x + x\ndef use(x): return twice(x)\ndef other(x): return x")
    before = _content(made.use), _content(made.other)
    overload(made.twice)(_made("def _twice(x): return lambda x: x * 2")._twice)
    after = _content(made.use), _content(made.other)
    assert after[0] != before[0]
    assert after[1] == before[1]


def test_versions_and_settings_count(monkeypatch):
    before = kernel_digest.environment()
    monkeypatch.setattr(numba.config, "BOUNDSCHECK", 1)
    assert kernel_digest.environment() != before


def test_our_part_of_the_compiler_counts(monkeypatch, tmp_path):
    before = kernel_digest.environment()
    for name in kernel_digest.COMPILER:
        (tmp_path / name).write_bytes(Path(kernel_digest.__file__).with_name(name).read_bytes())
    monkeypatch.setattr(kernel_digest, "__file__", str(tmp_path / "digest.py"))
    same = [_environment_anew()]
    for name in kernel_digest.COMPILER:
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes() + b"# edited")
        same.append(_environment_anew())
    kernel_digest._compiler.cache_clear()
    assert same[0] == before
    assert len({*same}) == 1 + len(kernel_digest.COMPILER)


def test_all_that_replaces_parts_of_the_compiler_is_in_it():
    parts = [kernel_inner.Pipeline, kernel_inner._Library, kernel_inner.on_demand, *kernel_inner.OURS.values()]
    parts += [step.lowering_class.fget(None) for step in parts if hasattr(step, "lowering_class")]
    made_of = {base.__module__ for part in parts for base in getattr(part, "__mro__", (part,))}
    files = {Path(sys.modules[name].__file__).name for name in made_of if name.startswith("groma.")}
    assert files == {*kernel_digest.COMPILER}


def _environment_anew():
    kernel_digest._compiler.cache_clear()
    return kernel_digest.environment()


def test_all_of_groma_can_be_followed():
    """Where something cannot be, an edit of any file compiles it again."""
    for module in pkgutil.walk_packages(groma.__path__, "groma."):
        try:
            importlib.import_module(module.name)
        except ImportError:  # a library that is optional
            continue
    modules = [vars(module) for name, module in list(sys.modules.items()) if name.partition(".")[0] == "groma"]
    functions = [value for names in modules for value in names.values() if isinstance(value, Dispatcher)]
    assert functions
    assert not [f.__name__ for f in functions if kernel_digest._known_reach(f).is_opaque]
