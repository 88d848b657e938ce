# SPDX-License-Identifier: BSD-3-Clause
"""Work in another thread, in parallel with the caller."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from typing import TypeVar

_Result = TypeVar("_Result")


def beside(pool: Executor | None, work: Callable[[], _Result]) -> Callable[[], _Result]:
    """Begin with some work in another thread; return what gives its result. What none has begun yet is done there."""
    begun = None if pool is None else pool.submit(work)
    return lambda: work() if begun is None or begun.cancel() else begun.result()
