# SPDX-License-Identifier: BSD-3-Clause
"""Keep the linear algebra libraries to one thread during a solve.

Their threads spin while they wait. On the small matrices of a reduced system that costs more than it gains, and several
times the processor time when the machine has other work.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

from threadpoolctl import ThreadpoolController

from groma.solver.linear import lapack  # noqa: F401  (loads the library that is to be limited)


@lru_cache(maxsize=1)
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


#: The limit, once for each context that some thread is in.
_held: list[Any] = []
_lock = threading.Lock()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """BLAS calls inside run on the calling thread; the limit ends with the last context of any thread."""
    with _lock:
        _held.append(_held[0] if _held else _controller().limit(limits=1, user_api="blas"))
    try:
        yield
    finally:
        with _lock:
            limit = _held.pop()
            if not _held:
                limit.restore_original_limits()
