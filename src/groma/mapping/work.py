# SPDX-License-Identifier: BSD-3-Clause
"""The one place where mapping goes through images (or chunks of points) one by one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def map_work(
    function: Callable[[_Item], _Result],
    items: Sequence[_Item],
    progress: Callable[[int, int], None] | None = None,
    threads: int = 1,
) -> list[_Result]:
    """Return the results of a function of every item, in the order of the items.

    Parameters
    ----------
    function : callable
        Must not depend on the order in which items are done; called from several threads if there are any.
    items : sequence
        Images or chunks, by number.
    progress : callable, optional
        Called in this thread with the number of items done and their total, before the first and after each. It may
        raise to end the work.
    threads : int
        One does everything in this thread.
    """
    results: list[_Result] = []
    pool = ThreadPoolExecutor(threads) if threads > 1 else None
    try:
        made = map(function, items) if pool is None else pool.map(function, items)
        for done in range(len(items) + 1):
            if progress is not None:
                progress(done, len(items))
            results.extend(islice(made, 1))
    finally:
        if pool is not None:
            pool.shutdown(cancel_futures=True)
    return results


__all__ = ["map_work"]
