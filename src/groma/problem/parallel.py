# SPDX-License-Identifier: BSD-3-Clause
"""Threads that share the work of one solve. The compiled loops release the GIL; the threads sleep while they wait.

The work is divided into *shares*, which depend on the problem alone: each is summed by itself, and these sums are added
in the order of the shares. The result is therefore the same to the last digit for any number of threads.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

import numpy as np

from groma._rows import pointers_of
from groma._typing import FloatArray
from groma.execution import take_in_turn
from groma.problem.layout import Chunk, Layout

T = TypeVar("T")
K = TypeVar("K", bound=Hashable)

#: Parts of an array: (begin, end) of each.
Spans = Sequence[tuple[int, int]]


class Workers:
    """A fixed number of threads, made when first needed. One worker means no thread at all."""

    def __init__(self, count: int) -> None:
        self.count = max(1, count)
        self._pool: ThreadPoolExecutor | None = None

    def map(self, function: Callable[[int], T], tasks: int, alone: bool = False) -> list[T]:
        """Return ``[function(0), ..., function(tasks - 1)]``; an exception in a task is raised here.

        ``alone``: they are too little work for other threads.
        """
        if alone or self.count == 1 or tasks == 1:
            return [function(task) for task in range(tasks)]
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.count - 1, thread_name_prefix="groma")
        return take_in_turn(self._pool, self.count - 1, function, range(tasks))

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown(wait=True)
            self._pool = None


#: Problems with fewer factors are one share: they are not worth a thread; nor is a share of less than half of it. Where
#: nothing is summed but costs, because nothing stays in a reduced system, fewer are; shares have twice as many, as they
#: are quick, and threads wait for the interpreter after each of their twenty loops (cost: time only).
FACTORS_FOR_THREADS, FACTORS_ALONE = 50_000, 10_000
#: Fewer factors are not worth waking another thread for: some 2 milliseconds of one thread, of which the other saves
#: half, where waking it takes a tenth and it may have to wait for a core. A cost takes a third of a linearisation
#: (cost: time only).
LINEARISED_IN_THREADS, COSTS_IN_THREADS = 20_000, 60_000
#: Most shares, and most bytes for every factor (about twice what its measurement takes) that copies of the reduced
#: system would take if every share had one, as with many threads; two shares there are always (cost: memory).
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
    count = min(count, size // max(least // 2 if layout.kept else 2 * least, 1))
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
        done = pointers_of([max(chunk.size, 1) for chunk in chunks])
        cuts = np.searchsorted(done, done[-1] * np.arange(count + 1) / count)
        cuts[0], cuts[-1] = 0, len(chunks)
        for k, share in enumerate(shares):
            share += chunks[cuts[k] : cuts[k + 1]]
    return shares


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


class OrderedSums(Generic[K]):
    """Arrays by name that shares add to, summed in the order of the shares, whichever thread has which.

    The first share adds to the total itself. Any other adds to a copy. That is added to the total as soon as all shares
    before have ended, and is then free for another share. So one thread has one copy, and several hardly more than one
    each: a copy waits only while an earlier share takes longer than a later one.

    Parameters
    ----------
    sizes
        Length of each array.
    spans
        Of each share, where in each array it may add: (begin, end). A share without any adds nothing.
    """

    def __init__(self, sizes: Mapping[K, int], spans: Sequence[Mapping[K, Spans]]) -> None:
        self._total = {name: np.zeros(size) for name, size in sizes.items()}
        self._spans = spans
        self._free: list[dict[K, FloatArray]] = []
        self._lock = threading.Lock()
        self._is_zero = True
        self._begin()

    def _begin(self) -> None:
        self._taken = {0: self._total}
        self._ended = {share for share, spans in enumerate(self._spans) if not spans}
        self._next = 0

    def clear(self) -> None:
        """Set the sums to zero; what shares have added and not ended is forgotten."""
        if not self._is_zero:
            for total in self._total.values():
                total[:] = 0.0
        self._is_zero = True
        self._begin()

    def of(self, share: int) -> dict[K, FloatArray]:
        """Return the arrays that a share adds to until it ends."""
        if share not in self._taken:
            with self._lock:
                self._taken[share] = self._free.pop() if self._free else self._copy()
        self._is_zero = False
        return self._taken[share]

    def total(self) -> dict[K, FloatArray]:
        """Return the sums of the shares that have ended; the caller may add to them, until they are cleared."""
        self._is_zero = False
        return self._total

    def end(self, share: int) -> None:
        """Note that a share has added all it has."""
        with self._lock:
            self._ended.add(share)
            while self._next in self._ended:
                if self._next and self._spans[self._next]:
                    self._add(self._spans[self._next], self._taken.pop(self._next))
                self._next += 1

    def _copy(self) -> dict[K, FloatArray]:
        return {name: np.zeros(total.size) for name, total in self._total.items()}

    def _add(self, spans: Mapping[K, Spans], copy: dict[K, FloatArray]) -> None:
        for name, filled in spans.items():
            for begin, end in filled:
                self._total[name][begin:end] += copy[name][begin:end]
                copy[name][begin:end] = 0.0
        self._free.append(copy)
