# SPDX-License-Identifier: BSD-3-Clause
"""Threads that share the work of one solve. The compiled loops release the GIL; the threads sleep while they wait."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


class Workers:
    """A fixed number of threads, made when first needed. One worker means no thread at all."""

    def __init__(self, count: int) -> None:
        self.count = max(1, count)
        self._pool: ThreadPoolExecutor | None = None

    def map(self, function: Callable[[int], T], tasks: int) -> list[T]:
        """Return ``[function(0), ..., function(tasks - 1)]``; an exception in a task is raised here."""
        if self.count == 1 or tasks == 1:
            return [function(task) for task in range(tasks)]
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.count - 1, thread_name_prefix="groma")
        futures = [self._pool.submit(function, task) for task in range(1, tasks)]
        try:
            first = function(0)
        finally:
            rest = [future.result() for future in futures]
        return [first, *rest]

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown(wait=True)
            self._pool = None


def available_cores() -> int:
    """Return the number of cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1
