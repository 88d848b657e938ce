# SPDX-License-Identifier: BSD-3-Clause
"""Processes that mpiexec started together, as workers of one command that the first of them, rank 0, goes through."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, ParamSpec

P = ParamSpec("P")


def led_by_first_rank(command: Callable[P, None]) -> Callable[P, None]:
    """Wrap a command: of ranks only the first goes through it, and the others do what it gives them."""

    @functools.wraps(command)
    def led(*args: P.args, **kwargs: P.kwargs) -> None:
        with ranks_as_workers() as leads:
            if leads:
                command(*args, **kwargs)

    return led


@contextmanager
def ranks_as_workers() -> Iterator[bool]:
    """Yield whether this process leads: one that was started alone does, and of ranks the first.

    Independent pieces of its work (:mod:`groma.execution`) then go to all ranks. The others serve it, and are told that
    they do not lead when it is done.

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
    """An executor that gives a piece of work to who has the least to do: the other ranks, or a thread of this one."""

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
