# SPDX-License-Identifier: BSD-3-Clause
"""Deferred work: in other threads, or without them when its result is requested.

Work on the map that a frame causes continues after its pose is returned; the next access to the map waits for it.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any


class OnDemand:
    """A future without a thread: the work is done when its result is requested."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self.result = work


class DeferredTask:
    """Runs one task at a time, optionally in its own thread."""

    def __init__(self, threaded: bool) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="groma-behind") if threaded else None
        self._begun: Future | OnDemand | None = None

    def begin(self, work: Callable[[], Any]) -> None:
        """Begin with some work, after the result of what was begun before was taken."""
        self._begun = OnDemand(work) if self._pool is None else self._pool.submit(work)

    def stand_still(self) -> None:
        """Wait until no thread is at work; after an interrupt the task is still pending."""
        if isinstance(self._begun, Future):
            wait([self._begun])

    def result(self) -> Any:
        """Return the result of the task, or raise its exception; None without a task."""
        self.stand_still()
        begun, self._begun = self._begun, None
        return None if begun is None else begun.result()

    def close(self) -> None:
        """End the thread."""
        if self._pool is not None:
            self._pool.shutdown(wait=True)
