# SPDX-License-Identifier: BSD-3-Clause
"""Load compiled functions in a thread, before the work that goes on beside it gets to them.

Loading one takes some milliseconds of one thread: it is found by what it depends on, and linked. A command that begins
with kernels over all photographs has its later stages' functions loaded meanwhile. What has to be compiled is left to
whoever needs it.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from groma.compilation.needed import function, needed
from groma.execution import available_cores


@contextmanager
def loading(work: str, threads: int | None = None) -> Iterator[None]:
    """Load what some work calls while the block goes on; nothing where that has one thread.

    Parameters
    ----------
    work : str
        A name of :func:`groma.compilation.needed.works`.
    threads : int, optional
        Threads that work; by default one for each core.
    """
    if (available_cores() if threads is None else threads) < 2:
        yield
        return
    is_over = threading.Event()
    thread = threading.Thread(target=load, args=(work, is_over), name="groma-load")
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


def load(work: str, is_over: threading.Event) -> None:
    """Load one function after the other, as they are listed, until it is over."""
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.registry import cpu_target

    for module, name, kinds in needed(work):
        if is_over.is_set():
            return
        wanted = function(module, name)
        here = getattr(wanted, "overloads", None)
        if here is None or kinds in here:  # it is not there, or plain Python (NUMBA_DISABLE_JIT=1), or loaded
            continue
        with suppress(Exception), global_compiler_lock:  # whoever calls it meets what is wrong, and can say so
            if wanted._cache.is_kept(kinds, cpu_target.target_context):
                wanted.compile(kinds)
