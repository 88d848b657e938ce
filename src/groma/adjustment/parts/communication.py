# SPDX-License-Identifier: BSD-3-Clause
"""Communication between processes besides sums: facts, and errors."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from groma.errors import GromaError, InputError
from groma.solver.reduce.contract import Reducer


class AllRanksError(InputError):
    """An error that all processes have; one of them reports it."""


def exchange(reducer: Reducer, facts: Any) -> list[Any]:
    """Return the facts of every process, by rank: numbers, words, lists and dictionaries of them."""
    return [json.loads(text) for text in reducer.gather(json.dumps(facts))]


@contextmanager
def agreed(reducer: Reducer) -> Iterator[None]:
    """Fail on all processes, with the same error, if one of them fails inside; alone: as without."""
    message, own = "", None
    try:
        yield
    except (GromaError, OSError) as error:
        message, own = str(error), error
    if reducer.size == 1:
        if own is not None:
            raise own
        return
    told = reducer.gather(message)
    first = next((rank for rank, text in enumerate(told) if text), None)
    if first is None:
        return
    text = told[first] if all(told) else f"Rank {first} of {reducer.size}: {told[first]}"
    raise AllRanksError(text) from own
