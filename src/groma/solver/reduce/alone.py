# SPDX-License-Identifier: BSD-3-Clause
"""What a machine adds to the shared system, summed over machines; here there is one machine."""

from __future__ import annotations

from typing import Protocol

from groma._typing import FloatArray, IntArray


class Reducer(Protocol):
    """Combines what machines found that solve one problem together, each with shards of its own.

    All machines call the same methods in the same order, and all get the same results.
    """

    def sum(self, values: FloatArray) -> FloatArray:
        """Return the sums over machines of arrays of one shape."""
        ...

    def union(self, numbers: IntArray) -> IntArray:
        """Return the numbers that any machine has, sorted; those of one machine are sorted and differ."""
        ...


class Alone:
    """The reducer of one machine."""

    def sum(self, values: FloatArray) -> FloatArray:  # noqa: D102
        return values

    def union(self, numbers: IntArray) -> IntArray:  # noqa: D102
        return numbers


__all__ = ["Alone", "Reducer"]
