# SPDX-License-Identifier: BSD-3-Clause
"""Functions that several processes need at once are compiled by one of them; a process that fails or dies keeps nobody
waiting."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numba
import pytest
from numba.core.registry import cpu_target

from groma._kernels import inner as kernel_inner
from groma._kernels import turns as kernel_turns

pytestmark = [pytest.mark.kernels, pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")]

NAME, OTHER = "0123456789abcdef", "1123456789abcdef"

HOLDER = """
import sys
from pathlib import Path
from groma._kernels import turns as kernel_turns
print(kernel_turns.take(Path(sys.argv[1]), sys.argv[2]), flush=True)
sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that has the turn for NAME, as long as its input is open."""
    call = [sys.executable, "-c", HOLDER, str(tmp_path), NAME]
    with subprocess.Popen(call, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None and process.stdout is not None
        assert process.stdout.readline() == "True\n"
        yield process
        process.stdin.close()


def test_one_process_has_the_turn_until_it_ends(tmp_path, holder):
    assert not kernel_turns.take(tmp_path, NAME)
    assert kernel_turns.take(tmp_path, OTHER)  # another function
    holder.kill()
    holder.wait()
    assert kernel_turns.take(tmp_path, NAME)
    kernel_turns.give_back(tmp_path, NAME)


def test_waiting_ends_when_the_function_is_there(tmp_path, holder):
    answers = iter([False, False, True])
    kernel_turns.wait(tmp_path, NAME, lambda: next(answers))
    assert next(answers, None) is None
    assert not kernel_turns.take(tmp_path, NAME)


def test_waiting_has_an_end(tmp_path, holder, monkeypatch):
    monkeypatch.setattr(kernel_turns, "_PATIENCE", 0.05)
    began = time.monotonic()
    kernel_turns.wait(tmp_path, NAME, lambda: False)
    assert time.monotonic() - began >= 0.05


def test_where_files_cannot_be_locked_nobody_waits(tmp_path):
    assert kernel_turns.take(tmp_path / "nowhere", NAME)
    kernel_turns.give_back(tmp_path / "nowhere", NAME)


PROGRAM = """
import sys, time
import numpy as np
from groma.compiled import loop
from groma._kernels.cache import counts

@loop
def total(values):
    result = 0.0
    for value in values:
        result += value
    return result

total(np.ones(3))
print(counts.compiled, counts.loaded, counts.missed)
"""


def test_two_processes_compile_a_function_once(tmp_path):
    path = tmp_path / "program.py"
    path.write_text(PROGRAM)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    running = [
        subprocess.Popen([sys.executable, path], stdout=subprocess.PIPE, text=True, env=environment) for _ in range(3)
    ]
    counts = [tuple(map(int, process.communicate()[0].split())) for process in running]
    assert sum(compiled for compiled, _, _ in counts) == 1
    assert all(compiled + loaded == 1 for compiled, loaded, _ in counts)


def test_what_does_not_compile_keeps_no_turn(tmp_path, monkeypatch):
    from groma.compiled import loop

    def wrong(x):
        return x.nothing_of_this_name

    given = []
    monkeypatch.setattr(kernel_turns, "give_back", lambda _, name: given.append(name))
    compiled = loop(wrong)
    with pytest.raises(numba.TypingError):
        compiled(1.0)
    assert len(given) == 1
    assert not kernel_inner.is_inside()
    monkeypatch.undo()
    kernel_turns.give_back(Path(compiled._cache.cache_path), given[0])


def test_functions_of_one_file_with_the_same_arguments_have_turns_of_their_own():
    from groma.compiled import loop

    @loop
    def once(x):
        return x

    @loop
    def twice(x):
        return 2.0 * x

    target = cpu_target.target_context
    keys = [function._cache._index_key((numba.float64,), target.codegen()) for function in (once, twice)]
    assert keys[0].name == keys[1].name
    assert once._cache._turn(keys[0]) != twice._cache._turn(keys[1])
