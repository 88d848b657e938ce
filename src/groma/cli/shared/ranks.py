# SPDX-License-Identifier: BSD-3-Clause
"""Ranks of MPI as workers of a command that rank 0 runs."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, ParamSpec

P = ParamSpec("P")


def led_by_first_rank(command: Callable[P, None]) -> Callable[P, None]:
    """Wrap a command: rank 0 runs it, the others execute the tasks that it submits."""

    @functools.wraps(command)
    def led(*args: P.args, **kwargs: P.kwargs) -> None:
        with ranks_as_workers() as leads:
            if leads:
                command(*args, **kwargs)

    return led


@contextmanager
def ranks_as_workers() -> Iterator[bool]:
    """Yield whether this process runs the command: a single process, or rank 0.

    Its independent tasks (:mod:`groma.execution`) are distributed to all ranks. For the others the block is entered,
    with False, when rank 0 is done.

    Raises
    ------
    InputError
        As :class:`groma.solver.reduce.mpi.Ranks`.
    """
    from groma.execution import work_with
    from groma.solver.reduce.mpi import Ranks, started_as

    if started_as()[1] < 2:
        yield True
        return
    ranks = Ranks()
    with ranks.others_as_executor() as others:
        if others is None:
            yield False
            return
        with ThreadPoolExecutor(1) as own, work_with(_Everyone(others, own, ranks.size - 1)):
            yield True


class _Everyone(Executor):
    """An executor that submits a task to the other ranks, or to a thread of this one, whichever has fewer waiting."""

    def __init__(self, others: Executor, own: Executor, num_others: int) -> None:
        self._others, self._own, self._num_others = others, own, num_others
        self._max_workers = num_others + 1
        self._waiting = {id(others): 0, id(own): 0}
        self._lock = threading.Lock()

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """See :class:`concurrent.futures.Executor`."""
        with self._lock:
            busy, idle = self._waiting[id(self._others)], self._waiting[id(self._own)] == 0
            chosen = self._own if idle and busy >= self._num_others else self._others
            self._waiting[id(chosen)] += 1
        future = chosen.submit(function, *args, **kwargs)
        future.add_done_callback(lambda _: self._done(chosen))
        return future

    def _done(self, executor: Executor) -> None:
        with self._lock:
            self._waiting[id(executor)] -= 1
