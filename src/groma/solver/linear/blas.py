# SPDX-License-Identifier: BSD-3-Clause
"""Keep the linear algebra libraries to one thread during a solve.

Their threads spin while they wait. On the small matrices of a reduced system that costs more than it gains, and several
times the processor time when the machine has other work.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import lru_cache

from threadpoolctl import ThreadpoolController

from groma.solver.linear import lapack  # noqa: F401  (loads the library that is to be limited)


@lru_cache(maxsize=1)
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


def one_blas_thread() -> AbstractContextManager:
    """Return a context in which BLAS calls run on the calling thread."""
    return _controller().limit(limits=1, user_api="blas")
