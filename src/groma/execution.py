# SPDX-License-Identifier: BSD-3-Clause
"""One executor for all work that falls into independent pieces: images, pairs of images, chunks of lines or points.

What goes through images one by one calls :func:`map_work`; what goes through many small problems in a compiled loop
calls :func:`map_ranges`. Neither knows who does the work. That is the caller's choice, made once around it::

    with work_with(8):                                  # threads; None: one for each core
        groma.map_images(...)

    with MPIPoolExecutor() as processes, work_with(processes):
        groma.map_images(...)

Threads suffice on one machine, because compiled loops and OpenCV release the interpreter. Any other
``concurrent.futures.Executor`` is taken too. The result does not depend on the number of workers: pieces are the same
for any number of them, and are put together in their order.
"""

from __future__ import annotations

import ctypes
import operator
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

#: Calls that wait for each worker of another process; more would only take memory.
_WAITING = 2
#: What glibc's ``mallopt`` calls the number of places that memory is taken from, the bytes from which on something has
#: pages of its own, and the free bytes at the end that are kept (the format of the call).
_M_ARENA_MAX, _M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD = -8, -3, -1
#: glibc's largest own value of the former, and more than the work on some photographs frees (cost: memory, which later
#: work takes again).
_PAGES_OF_ITS_OWN, _KEPT = 32 * 2**20, 256 * 2**20
#: Calls to an executor of processes that each of its workers gets, so that all end at about the same time (cost: of
#: waiting for the last).
_CALLS = 4


@dataclass(frozen=True)
class _Crew:
    """Who does the work."""

    #: None for the calling thread alone.
    executor: Executor | None
    workers: int
    #: Threads of this process, where the executor has others.
    beside: _Crew | None = None

    @property
    def shares_memory(self) -> bool:
        """Whether a piece of work costs nothing to hand over."""
        return isinstance(self.executor, ThreadPoolExecutor)

    @property
    def here(self) -> _Crew:
        """Those of this process."""
        return self if self.shares_memory else self.beside or _Crew(None, 1)


_CREW: ContextVar[_Crew | None] = ContextVar("groma_crew", default=None)


def available_cores() -> int:
    """Return the number of cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1


def share_memory() -> None:
    """Let all threads of this process take memory from one place, and keep it, where the system's library is glibc.

    Otherwise what a thread gives back is kept for that thread, and two of them hold a quarter more than one; and the
    room for a photograph is given back to the system after each, which then hands out, and clears, new pages for the
    next. Other threads wait for that. What the environment says about it (``MALLOC_...``) is left as it is.
    """
    if sys.platform != "linux":
        return
    wanted = (
        ("MALLOC_ARENA_MAX", _M_ARENA_MAX, 1),
        ("MALLOC_MMAP_THRESHOLD_", _M_MMAP_THRESHOLD, _PAGES_OF_ITS_OWN),
        ("MALLOC_TRIM_THRESHOLD_", _M_TRIM_THRESHOLD, _KEPT),
    )
    with suppress(OSError, AttributeError):
        for name, parameter, value in wanted:
            if name not in os.environ:
                ctypes.CDLL(None).mallopt(parameter, value)


@contextmanager
def work_with(workers: int | Executor | None = None) -> Iterator[None]:
    """Do the independent pieces of work inside with some workers; an executor given around this one goes first.

    Parameters
    ----------
    workers : int, Executor or None
        A number of threads, one for the calling thread alone, None for one per core; or any executor of
        ``concurrent.futures``, such as those of ``mpi4py.futures`` and ``dask.distributed``, which stays open. Pieces
        that are not worth sending to other processes then go to threads of this one, one per core.

    Examples
    --------
    >>> from groma.execution import map_work, work_with
    >>> with work_with(2):
    ...     map_work(abs, [-1, -2, -3])
    [1, 2, 3]
    """
    if _CREW.get() is not None:
        yield
        return
    if workers is None:
        workers = available_cores()
    if isinstance(workers, ThreadPoolExecutor):
        with _set(_Crew(workers, _num_workers(workers))):
            yield
    elif isinstance(workers, Executor):
        with _threads(available_cores()) as beside, _set(_Crew(workers, _num_workers(workers), beside)):
            yield
    else:
        with _threads(workers) as crew, _set(crew):
            yield


def num_workers() -> int:
    """Return how many workers :func:`work_with` has given, one without it."""
    crew = _CREW.get()
    return 1 if crew is None else crew.workers


def num_threads() -> int:
    """Return how many threads of this process do the work that is not sent to others, one without :func:`work_with`."""
    crew = _CREW.get()
    return 1 if crew is None else crew.here.workers


def num_calls() -> int:
    """Return into how many calls work for other processes is divided; zero where all workers share memory."""
    crew = _CREW.get()
    return 0 if crew is None or crew.executor is None or crew.shares_memory else _CALLS * crew.workers


def map_work(
    function: Callable[[_Item], _Result], items: Sequence[_Item], progress: Callable[[int, int], None] | None = None
) -> list[_Result]:
    """Apply a function to every item, and return the results in the order of the items.

    Parameters
    ----------
    function : callable
        Must not depend on the order in which items are done, nor change anything: it may run in another thread or, as
        a function of a module with its arguments bound by ``functools.partial``, in another process.
    items : sequence
        Images or chunks, by number.
    progress : callable, optional
        Called in this thread with the number of items done and their total, before the first and after each. It may
        raise to end the work.
    """
    total, crew = len(items), _CREW.get()
    say = progress or (lambda done, total: None)
    results: list[_Result] = []
    say(0, total)
    if crew is None or crew.executor is None or total < 2:
        for item in items:
            results.append(function(item))
            say(len(results), total)
        return results
    if crew.shares_memory:
        return take_in_turn(crew.executor, crew.workers - 1, function, items, say)
    size = -(-total // (_CALLS * crew.workers))
    calls = (items[first : first + size] for first in range(0, total, size))
    pending: deque[Future[list[_Result]]] = deque()
    try:
        for call in calls:
            pending.append(crew.executor.submit(_each, function, call))
            if len(pending) > _WAITING * crew.workers:
                results += pending.popleft().result()
                say(len(results), total)
        while pending:
            results += pending.popleft().result()
            say(len(results), total)
    finally:
        for future in pending:
            future.cancel()
        wait(pending)
    return results


def take_in_turn(
    executor: Executor,
    helpers: int,
    function: Callable[[_Item], _Result],
    items: Sequence[_Item],
    progress: Callable[[int, int], None] | None = None,
) -> list[_Result]:
    """Apply a function to every item; this thread and some helpers of an executor each take the next item in turn.

    No thread is woken for a single item. Helpers that are busy with other work are not waited for, and what any call
    raises ends the work and is raised here. ``progress`` is that of :func:`map_work`, after the first call.
    """
    total, said = len(items), 0
    found: dict[int, _Result] = {}
    left = deque(range(total))

    def work(told: Callable[[], None]) -> None:
        try:
            while True:
                try:
                    place = left.popleft()
                except IndexError:
                    return
                found[place] = function(items[place])
                told()
        except BaseException:
            left.clear()
            raise

    def tell() -> None:
        nonlocal said
        while progress is not None and said < len(found):
            said += 1
            progress(said, total)

    futures = [executor.submit(work, lambda: None) for _ in range(min(helpers, total - 1))]
    try:
        with _set(None):  # within a piece all threads are alike
            work(tell)
    finally:
        begun = [future for future in futures if not future.cancel()]
        wait(begun)
    for future in begun:
        future.result()
    tell()
    return [found[place] for place in range(total)]


def map_largest_first(
    function: Callable[[_Item], _Result],
    items: Sequence[_Item],
    sizes: Sequence[float],
    progress: Callable[[int, int], None] | None = None,
) -> list[_Result]:
    """Do what :func:`map_work` does, the largest items first, so that at the end workers wait for a small one only.

    ``sizes`` are about in proportion to the time that the items take.
    """
    order = sorted(range(len(items)), key=lambda place: -sizes[place])
    found = map_work(function, [items[place] for place in order], progress)
    return [result for _, result in sorted(zip(order, found, strict=True), key=lambda pair: pair[0])]


def map_in_threads(function: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
    """Do what :func:`map_work` does in threads of this process.

    For items whose data cost more to send to another process than the work on them.
    """
    crew = _CREW.get()
    if crew is None or crew.here.workers < 2:
        return [function(item) for item in items]
    with _set(crew.here):
        return map_work(function, items)


def together(*functions: Callable[[], Any]) -> tuple[Any, ...]:
    """Call functions in threads of this process, and return their results in order."""
    return tuple(map_in_threads(operator.call, functions))


def begin(function: Callable[[], _Result]) -> Callable[[], _Result]:
    """Start a function in a thread of this process; return a callable that gives its result.

    If no thread has started it when the result is asked for, or without workers, the caller runs it. Threads that are
    free share what the function divides. It must have no side effects: if the work in between fails, nobody waits for
    it.

    Examples
    --------
    >>> from groma.execution import begin, work_with
    >>> with work_with(2):
    ...     total = begin(lambda: sum(range(10)))
    ...     total()
    45
    """
    crew = _CREW.get()
    here = None if crew is None else crew.here
    if here is None or here.executor is None:
        return cache(function)

    def work() -> _Result:
        with _set(here):
            return function()

    future = here.executor.submit(work)
    return cache(lambda: function() if future.cancel() else future.result())


@contextmanager
def beside(function: Callable[[], object]) -> Iterator[None]:
    """Run a function in a thread of this process during the block; without workers, after it.

    Unlike that of :func:`begin`, the function may write: the block ends after it. What it raises is raised at the end
    of the block, unless the block itself has raised.
    """
    crew = _CREW.get()
    executor = None if crew is None else crew.here.executor
    if executor is None:
        yield
        function()
        return
    future = executor.submit(function)
    try:
        yield
    finally:
        wait([future])
    future.result()


def map_ranges(function: Callable[[slice], Any], count: int, size: int) -> None:
    """Call a function that writes into arrays in threads, with slices of ``size`` rows that cover ``count`` rows.

    The rows of a slice must depend on no other row.
    """
    map_in_threads(function, [slice(first, min(first + size, count)) for first in range(0, count, size)])


def _each(function: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
    """Do some of the work, where a worker is."""
    return [function(item) for item in items]


@contextmanager
def _threads(count: int) -> Iterator[_Crew]:
    """Yield so many threads, for one the calling thread."""
    if count <= 1:
        yield _Crew(None, 1)
        return
    with ThreadPoolExecutor(count, thread_name_prefix="groma") as pool:
        yield _Crew(pool, count)


@contextmanager
def _set(crew: _Crew | None) -> Iterator[None]:
    token = _CREW.set(crew)
    try:
        yield
    finally:
        _CREW.reset(token)


def _num_workers(executor: Any) -> int:
    """How many workers an executor has, as far as it tells."""
    for name in ("_max_workers", "num_workers"):
        number = getattr(executor, name, None)
        if isinstance(number, int) and number > 0:
            return number
    client = getattr(executor, "_client", None)  # of dask.distributed
    return max(1, sum(client.nthreads().values())) if client is not None else available_cores()
