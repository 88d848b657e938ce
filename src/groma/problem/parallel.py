# SPDX-License-Identifier: BSD-3-Clause
"""Threads that share the work of one solve. The compiled loops release the GIL; the threads sleep while they wait."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

from groma._typing import FloatArray
from groma.problem.layout import Chunk

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


def shares_of(chunks: tuple[Chunk, ...], count: int) -> list[list[Chunk]]:
    """Divide consecutive chunks among ``count`` threads, about equal in the number of factors."""
    if count == 1 or len(chunks) < 2 * count:
        return [list(chunks)]
    done = np.concatenate([[0], np.cumsum([max(chunk.size, 1) for chunk in chunks])])
    cuts = np.searchsorted(done, done[-1] * np.arange(count + 1) / count)
    cuts[0], cuts[-1] = 0, len(chunks)
    return [list(chunks[cuts[i] : cuts[i + 1]]) for i in range(count)]


#: Sums of arrays shorter than this are not worth a thread.
_SUM_IN_THREADS = 200_000


def sum_of(parts: list[FloatArray], workers: Workers) -> FloatArray:
    """Add the other arrays to the first one, and return that."""
    total = parts[0]
    tasks = workers.count if total.size > _SUM_IN_THREADS else 1
    cuts = [total.size * i // tasks for i in range(tasks + 1)]

    def add(task: int) -> None:
        for part in parts[1:]:
            total[cuts[task] : cuts[task + 1]] += part[cuts[task] : cuts[task + 1]]

    if len(parts) > 1:
        workers.map(add, tasks)
    return total
