# SPDX-License-Identifier: BSD-3-Clause
"""Threads that share the work of one solve. The compiled loops release the GIL; the threads sleep while they wait.

The work is divided into *shares*, which depend on the problem alone: each has sums of its own, and these are added in
the order of the shares. The result is therefore the same to the last digit for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import TypeVar

import numpy as np

from groma._typing import FloatArray
from groma.problem.layout import Chunk, Layout

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
        results: dict[int, T] = {}
        waiting: SimpleQueue[int] = SimpleQueue()
        for task in range(tasks):
            waiting.put(task)

        def work() -> None:
            with suppress(Empty):
                while True:
                    task = waiting.get_nowait()
                    results[task] = function(task)

        futures = [self._pool.submit(work) for _ in range(min(self.count, tasks) - 1)]
        try:
            work()
        finally:
            for future in futures:
                future.result()
        return [results[task] for task in range(tasks)]

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown(wait=True)
            self._pool = None


#: Problems with fewer factors are one share: they are not worth a thread; nor is a share of less than half of it. Where
#: nothing is summed but costs, because nothing stays in a reduced system, fewer are (cost: time only).
FACTORS_FOR_THREADS, FACTORS_ALONE = 50_000, 10_000
#: Most shares, and most bytes that their copies of the reduced system take for every factor, about twice what its
#: measurement does, unless two copies take more: even one thread has them all (cost: memory).
MAX_SHARES, MAX_BYTES = 16, 96
#: Landmarks add to each block of a copy so many times on average, or clearing and adding the copies takes too long
#: (cost: time alone).
USES_OF_A_BLOCK = 20


def num_shares(layout: Layout) -> int:
    """Return into how many shares the work on a problem is divided, whatever the number of threads."""
    size = sum(chunk.size for chunk in layout.chunks)
    least = FACTORS_FOR_THREADS if layout.kept else FACTORS_ALONE
    if size < least:
        return 1
    numbers = blocks = uses = 0
    for (a, b), (rows, _) in layout.blocks.items():
        numbers, blocks = numbers + len(rows) * layout.kept[a].width * layout.kept[b].width, blocks + len(rows)
    for group in layout.eliminated:
        uses += sum(len(seen.pair_slots) for seen in group.incidences.values())
        uses += sum(len(slots) for slots, _ in group.cross.values())
    count = min(MAX_SHARES, MAX_BYTES * size // max(8 * numbers, 1), len(layout.chunks) // 2)
    count = min(count, 2 * size // max(least, 1))
    if layout.eliminated:
        count = min(count, uses // max(USES_OF_A_BLOCK * blocks, 1)) if blocks else count
    return max(2, count)


def shares_of(layout: Layout) -> list[list[Chunk]]:
    """Divide chunks into shares: of each kind consecutive ones, about equal in the number of factors.

    A factor of one kind takes other work than one of another, and each share has some of all.
    """
    count = num_shares(layout)
    if count == 1:
        return [list(layout.chunks)]
    kinds: dict[tuple[int | None, ...], list[Chunk]] = {}
    for chunk in layout.chunks:
        alone = () if chunk.eliminated is not None else tuple(f for f, begin, end in chunk.factors if begin < end)
        kinds.setdefault((chunk.eliminated, *alone), []).append(chunk)
    shares: list[list[Chunk]] = [[] for _ in range(count)]
    for chunks in kinds.values():
        done = np.concatenate([[0], np.cumsum([max(chunk.size, 1) for chunk in chunks])])
        cuts = np.searchsorted(done, done[-1] * np.arange(count + 1) / count)
        cuts[0], cuts[-1] = 0, len(chunks)
        for k, share in enumerate(shares):
            share += chunks[cuts[k] : cuts[k + 1]]
    return shares


#: Sums of arrays shorter than this are not worth a thread.
_SUM_IN_THREADS = 200_000


def sum_of(
    parts: list[FloatArray], workers: Workers, spans: Sequence[Sequence[tuple[int, int]]] | None = None
) -> FloatArray:
    """Add the other arrays to the first one, and return that; ``spans`` say where each is not zero: (begin, end)."""
    total = parts[0]
    spans = [[(0, total.size)]] * len(parts) if spans is None else spans
    tasks = workers.count if total.size > _SUM_IN_THREADS else 1
    cuts = [total.size * i // tasks for i in range(tasks + 1)]

    def add(task: int) -> None:
        for part, filled in zip(parts[1:], spans[1:], strict=True):
            for begin, end in filled:
                own = slice(max(begin, cuts[task]), max(min(end, cuts[task + 1]), cuts[task]))
                total[own] += part[own]

    if len(parts) > 1:
        workers.map(add, tasks)
    return total
