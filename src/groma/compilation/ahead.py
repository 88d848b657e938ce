# SPDX-License-Identifier: BSD-3-Clause
"""Compile what a command needs in processes beside it, while it goes on.

A command says what kind of work it does. When it has to compile, or at once if nothing was ever compiled, a process is
started, which makes the compiler ready and, where the system can, forks until there are as many as cores. They go
through the list of what such work calls (:mod:`groma.compilation.needed`), in the order in which it is called, and
leave out what is there or is being compiled (:mod:`groma._kernels.turns`). The command finds the functions on disk when
it gets to them, or waits for the process that is at it. The processes end with the command.

The compiler is imported where it is needed: a process that gets ready while the command imports it costs no time.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from groma._kernels.cache import Counts

#: How many processes, if the user says so; 0 for none.
VARIABLE = "GROMA_COMPILE_PROCESSES"
#: Most processes otherwise (cost: memory).
_MOST = 8
#: Whether a process that has imported everything can become several: half a second of work each. Elsewhere than on
#: Linux, libraries of the system may not survive it.
CAN_FORK = sys.platform == "linux"
#: Linear algebra starts no threads, which a fork would lose.
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


class Ahead:
    """The processes beside a command; they start when it has missed more functions than it has found, or are begun."""

    def __init__(self, work: str, announce: Callable[[], None], threads: int | None = None) -> None:
        self._work, self._announce, self._threads = work, announce, threads
        self._running: list[subprocess.Popen[bytes]] = []
        self._is_started = False

    def __call__(self, counts: Counts) -> None:
        """Hear that a function is missing."""
        if not self._is_started and counts.missed > counts.loaded:
            self._announce()
            self.begin()

    def begin(self) -> None:
        """Start the processes."""
        self._is_started = True
        count = _count(self._threads)
        for _ in range(min(count, 1) if CAN_FORK else count):
            self._start(count if CAN_FORK else 1)

    def _start(self, count: int) -> None:
        """Start a process that becomes several."""
        call = [sys.executable, "-W", "ignore", "-m", "groma.compilation.ahead", self._work, str(count)]
        quiet, alone = subprocess.DEVNULL, {**os.environ, **ONE_THREAD}
        try:
            self._running.append(subprocess.Popen(call, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, env=alone))
        except OSError:
            pass  # the command compiles alone

    def stop(self) -> None:
        """End the processes: what they wait for is the end of their input."""
        for process in self._running:
            if process.stdin is not None:
                process.stdin.close()
        for process in self._running:
            process.wait()
        self._running.clear()


#: What is expected.
_expected: list[Ahead] = []


def mapping(refines_poses: bool) -> str:
    """Return the name of the work of mapping photographs; where poses are held, segments are placed anew."""
    return "map" if refines_poses else "map, poses held"


def begin(work: str, announce: Callable[[], None], threads: int | None = None) -> None:
    """Expect some work, and let processes begin with what it needs if nothing was ever compiled."""
    end()
    _expected.append(Ahead(work, announce, threads))
    if CAN_FORK and _is_empty():
        announce()
        _expected[0].begin()


def expect(work: str, announce: Callable[[], None], threads: int | None = None) -> None:
    """Let processes help with what some work needs, if it comes to that; ``announce`` is called then."""
    from groma._kernels import cache as kernel_cache

    if [one._work for one in _expected] != [work]:
        end()
        _expected.append(Ahead(work, announce, threads))
    kernel_cache.on_miss[:] = _expected


def end() -> None:
    """End the processes; nothing more is expected."""
    for ahead in _expected:
        ahead.stop()
    _expected.clear()
    if (kernel_cache := sys.modules.get("groma._kernels.cache")) is not None:
        kernel_cache.on_miss.clear()


def _is_empty() -> bool:
    """Whether no compiled function lies in the first of the places where they are kept, which can be written."""
    given, is_off = os.environ.get("NUMBA_CACHE_DIR"), os.environ.get("NUMBA_DISABLE_JIT", "0") != "0"
    place = Path(given) if given else Path(__file__).parents[1]
    return not is_off and os.access(place, os.W_OK) and next(place.rglob("*.nbc"), None) is None


def _count(threads: int | None) -> int:
    """Return how many processes are worth starting."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = min(usable, threads or usable, _MOST)
    said = os.environ.get(VARIABLE, "")
    if said.isdigit():
        return int(said)
    return wanted if wanted > 1 else 0


def _end_with_the_command(forked: list[int]) -> None:
    """End at once when the input does, but not in the middle of a file, and after the processes that were forked."""
    from groma._kernels import cache as kernel_cache

    sys.stdin.buffer.read()
    with kernel_cache.writing:
        _wait_for(forked)
        os._exit(0)


def _wait_for(forked: list[int]) -> None:
    for process in forked:
        with suppress(ChildProcessError):  # waited for by the other thread
            os.waitpid(process, 0)


def make_ready(work: str) -> None:
    """Import what some work imports, and what the compiler does at its first use."""
    from numba.core.registry import cpu_target as target

    from groma.compilation.needed import function, imported, needed

    cpu_target: Any = target
    if (module_of_work := imported(work)) is not None:
        import_module(module_of_work)
    for module, name, _ in needed(work):
        function(module, name)
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()


def compile_ahead(work: str) -> None:
    """Compile what some work calls, other than what is there or is being compiled."""
    from numba.core.registry import cpu_target

    from groma.compilation.needed import function, imported, needed

    if (module_of_work := imported(work)) is not None:
        import_module(module_of_work)
    for module, name, kinds in needed(work):
        compiled = function(module, name)
        if compiled is not None and compiled._cache.take_turn(kinds, cpu_target.target_context):
            with suppress(Exception):  # what the list is wrong about is compiled when it is called, or not
                compiled.compile(kinds)


def main(work: str, count: int) -> None:
    """Compile in this process and others like it, until all is there or the input ends."""
    forked: list[int] = []
    gc.disable()  # a twentieth of the time, for 5 MB that each second of compiling leaves behind
    if count > 1:
        make_ready(work)
        gc.freeze()  # what is there stays: it is not copied after a fork
    while len(forked) + 1 < count:
        process = os.fork()
        if process == 0:
            forked = []
            break
        forked.append(process)
    threading.Thread(target=_end_with_the_command, args=(forked,), daemon=True).start()
    compile_ahead(work)
    _wait_for(forked)
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
