# SPDX-License-Identifier: BSD-3-Clause
"""What compiled functions depend on: an edit compiles what uses the edited thing again, and nothing else.

A small package is written to disk, loaded as a new process would load it, edited and loaded again. Its ``dispatch`` is
the one of the camera models.
"""

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest
from numba.core import types

from groma._kernels import cache as kernel_cache
from groma._kernels import digest as kernel_digest
from groma.cameras import dispatch as _dispatch

pytestmark = [pytest.mark.kernels, pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")]

KERNELS = '''
"""Kernels."""
import numpy as np
from groma._numba import inline_kernel, kernel, loop

LIMIT = 3.0
TABLE = np.array([1.0, 2.0])
PAIR = (1.0, (2.0, 3.0))

@kernel
def double(x):
    """Twice."""
    return x + x

@kernel
def triple(x):
    return 3.0 * x

@inline_kernel
def square(x):
    return x * x

@kernel
def clip(x):  # at most
    return min(x, LIMIT)

@kernel
def look(x, scale=1.0):
    return TABLE[1] * x * scale + PAIR[1][0]

@loop
def clip_all(values):
    total = 0.0
    for i in range(values.shape[0]):
        total += clip(values[i])
    return total
'''


LOOPS = """
from sample import kernels
from sample.kernels import double, look, square
from sample.special import add_one, half
from groma._numba import kernel, loop

@kernel
def quadruple(x):
    return double(double(x))

@loop
def through_two(values):
    return quadruple(values[0])

@loop
def through_module(values):
    return kernels.triple(values[0])

@loop
def through_inline(values):
    return square(values[0])

@loop
def through_table(values):
    return look(values[0])

@loop
def through_intrinsic(values):
    return add_one(values[0])

@loop
def through_overload(values):
    return half(values[0])

@loop
def alone(values):
    return values[0]
"""


SPECIAL = """
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, overload

class Adder:
    def add(self, builder, value):
        return builder.fadd(value, ir.Constant(ir.DoubleType(), 1.0))

@intrinsic
def add_one(typing, x):
    def codegen(context, builder, signature, args):
        return Adder().add(builder, args[0])
    return types.float64(x), codegen

def half(x):
    return x / 2

@overload(half)
def _half(x):
    return lambda x: x / 2.0
"""


MODELS = """
from groma._numba import kernel, loop
from sample.dispatch import project, set_kernels

@kernel
def wide(params, X, uv):
    uv[0] = 10.0 * X[0]
    return True

@kernel
def narrow(params, X, uv):
    uv[0] = 20.0 * X[0]
    return True

set_kernels(3, wide, wide, wide)
set_kernels(4, narrow, narrow, narrow)

@loop
def project_all(model_tag, X, uv):
    project(model_tag, X, X, uv)
    return uv[0]
"""


#: What the functions give for an array of ones; those that are called by others are compiled with them.
RESULTS = {"kernels.clip_all": 2.0, "loops.through_two": 4.0, "loops.through_module": 3.0,
           "loops.through_inline": 1.0, "loops.through_table": 4.0,
           "loops.through_intrinsic": 2.0, "loops.through_overload": 0.5, "loops.alone": 1.0}  # fmt: skip


def _content(function, kinds=()):
    return kernel_digest.dependence(function, kinds).content


@pytest.fixture
def sample(tmp_path, monkeypatch):
    """The package: ``edit`` it, ``load`` it as a new process would, and read what was ``compiled`` since."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")  # Numba reads it again when anything in the environment changes
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(str(tmp_path))
    folder = tmp_path / "sample"
    folder.mkdir()
    dispatch = Path(_dispatch.__file__).read_text()
    texts = {"__init__": "", "kernels": KERNELS, "loops": LOOPS, "special": SPECIAL, "models": MODELS}
    for name, text in (*texts.items(), ("dispatch", dispatch)):
        (folder / f"{name}.py").write_text(text)
    compiled = []
    save = kernel_cache._Files.save

    def record(files, key, data):
        compiled.append(files._stem.partition("-")[0])
        save(files, key, data)

    monkeypatch.setattr(kernel_cache._Files, "save", record)

    def edit(name, old, new):
        path = folder / f"{name}.py"
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))

    def load(name):
        _forget()
        importlib.invalidate_caches()
        compiled.clear()
        return importlib.import_module(f"sample.{name}")

    def run():
        """Call everything; return the results, and which of the functions that are called were compiled."""
        loops = load("loops")
        modules = {"loops": loops, "kernels": loops.kernels}
        calls = {name: name.split(".") for name in RESULTS}
        found = {name: getattr(modules[module], call)(np.ones(2)) for name, (module, call) in calls.items()}
        return found, set(compiled) & set(RESULTS)

    yield SimpleNamespace(edit=edit, load=load, run=run, compiled=compiled, folder=folder)
    _forget()


def _forget():
    for loaded in [loaded for loaded in sys.modules if loaded.partition(".")[0] == "sample"]:
        del sys.modules[loaded]


#: File, text, its replacement, what is compiled again, and the results that change.
EDITS = [
    ("kernels", "return x + x", "return x * 3.0", {"loops.through_two": 9.0}),
    ("kernels", "return 3.0 * x", "return 4.0 * x", {"loops.through_module": 4.0}),
    ("kernels", "return x * x", "return x * x + 1.0", {"loops.through_inline": 2.0}),
    ("loops", "double(double(x))", "double(x)", {"loops.through_two": 2.0}),
    ("loops", "return values[0]\n", "return values[0] + 5.0\n", {"loops.alone": 6.0}),
    ("kernels", "LIMIT = 3.0", "LIMIT = 0.25", {"kernels.clip_all": 0.5}),
    ("kernels", "[1.0, 2.0]", "[1.0, 4.0]", {"loops.through_table": 6.0}),
    ("kernels", "(2.0, 3.0)", "(4.0, 3.0)", {"loops.through_table": 6.0}),
    ("kernels", "scale=1.0", "scale=2.0", {"loops.through_table": 6.0}),
    ("kernels", "@kernel\ndef double", "@loop\ndef double", {"loops.through_two": 4.0}),
    ("special", "lambda x: x / 2.0", "lambda x: x / 4.0", {"loops.through_overload": 0.25}),
    ("special", "DoubleType(), 1.0", "DoubleType(), 2.0", {"loops.through_intrinsic": 3.0}),
    ("special", "fadd(value, ", "fadd(builder.fadd(value, value), ", {"loops.through_intrinsic": 3.0}),
    ("kernels", '"""Twice."""', '"""Two\n    times."""', {}),
    ("kernels", "# at most", "# no more than\n", {}),
    ("kernels", '"""Kernels."""', '"""Other."""\nimport math\nUNUSED = 1\n\n', {}),
    ("special", "class Adder:\n", 'class Adder:\n    """Adds."""\n', {}),
]  # fmt: skip


def test_an_edit_compiles_what_uses_it_and_nothing_else(sample):
    assert sample.run() == (RESULTS, set(RESULTS))
    assert sample.run() == (RESULTS, set())
    for name, old, new, changed in EDITS:
        before = (sample.folder / f"{name}.py").read_text()
        sample.edit(name, old, new)
        assert sample.run() == ({**RESULTS, **changed}, set(changed)), new
        (sample.folder / f"{name}.py").write_text(before)
        assert sample.run() == (RESULTS, set(changed)), old


def _project(sample, length):
    """Project with the model of a tag; return the pixel and whether the loop was compiled."""
    models = sample.load("models")
    pixel = models.project_all((0,) * length, np.ones(3), np.zeros(2))
    return pixel, "models.project_all" in sample.compiled


def test_an_edited_model_compiles_the_loops_of_this_model_only(sample):
    for length in (3, 4):
        assert _project(sample, length)[1]
        assert not _project(sample, length)[1]
    sample.edit("models", "20.0 * X", "30.0 * X")
    assert _project(sample, 3) == (10.0, False)
    assert _project(sample, 4) == (30.0, True)
    assert _project(sample, 4) == (30.0, False)


def test_two_models_that_swap_numbers_are_told_apart_and_keep_their_files(sample):
    assert [_project(sample, length)[0] for length in (3, 4)] == [10.0, 20.0]
    sample.edit("models", "set_kernels(3", "set_kernels(8 - 4")
    sample.edit("models", "set_kernels(4", "set_kernels(3")
    assert [_project(sample, length) for length in (3, 4)] == [(20.0, True), (10.0, True)]
    sample.edit("models", "set_kernels(3", "set_kernels(4")
    sample.edit("models", "set_kernels(8 - 4", "set_kernels(3")
    assert [_project(sample, length) for length in (3, 4)] == [(10.0, False), (20.0, False)]


def test_a_model_written_into_the_code_counts_beside_that_of_the_arguments(sample):
    """The tag that the types name is not the one that is used."""
    sample.edit("models", "project(model_tag, X", "project((0, 0, 0, 0), X")
    assert _project(sample, 3)[0] == 20.0
    sample.edit("models", "20.0 * X", "30.0 * X")
    assert _project(sample, 3) == (30.0, True)


def test_where_no_argument_names_a_model_all_models_count(sample):
    models, signatures = sample.load("models"), ((), (types.UniTuple(types.int64, 4),))
    before = [_content(models.project_all, kinds) for kinds in signatures]
    sample.edit("models", "10.0 * X", "30.0 * X")
    models = sample.load("models")
    after = [_content(models.project_all, kinds) for kinds in signatures]
    assert after[0] != before[0]
    assert after[1] == before[1]


def test_what_cannot_be_followed_stands_for_its_package(sample):
    (sample.folder / "odd.py").write_text("class Odd: pass\nodd = Odd()\ndef use(): return odd")

    def content():
        kernel_digest._stamp.cache_clear()
        return _content(sample.load("odd").use)

    before = content()
    assert before == content()
    sample.edit("loops", "alone", "lonely")
    assert content() != before
