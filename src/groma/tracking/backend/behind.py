# SPDX-License-Identifier: BSD-3-Clause
"""Work that is begun and asked for later: in other threads, or where there are none, when it is asked for.

What a frame causes in the map goes on behind its answer, and who looks at the map next waits for it.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any


class OnDemand:
    """Stands for a future where there are no threads: the work is done when its result is asked for."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self.result = work


class Behind:
    """One piece of work at a time, in a thread of its own if wanted."""

    def __init__(self, threaded: bool) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="groma-behind") if threaded else None
        self._begun: Future | OnDemand | None = None

    def begin(self, work: Callable[[], Any]) -> None:
        """Begin with some work, after the result of what was begun before was taken."""
        self._begun = OnDemand(work) if self._pool is None else self._pool.submit(work)

    def stand_still(self) -> None:
        """Wait until no thread is at work; what is interrupted here is still there."""
        if isinstance(self._begun, Future):
            wait([self._begun])

    def result(self) -> Any:
        """Return what the work gave, or raise what it raised; None if there was none."""
        self.stand_still()
        begun, self._begun = self._begun, None
        return None if begun is None else begun.result()

    def close(self) -> None:
        """End the thread."""
        if self._pool is not None:
            self._pool.shutdown(wait=True)
