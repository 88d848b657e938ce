# SPDX-License-Identifier: BSD-3-Clause
"""How processes that solve one problem together combine what they found; ``single.py`` and ``mpi.py`` fulfil it."""

from __future__ import annotations

from typing import Protocol

from groma._typing import ComplexArray, IntArray


class Reducer(Protocol):
    """Combines the sums of processes that solve one problem together, each with some of the shards.

    All processes call the same methods in the same order, and all get the same results. Arrays hold *exact sums*
    (:mod:`groma.solver.reduce.exact_sums`), so that the result does not depend on who has which shard.
    """

    #: Number of this process, from 0, and how many there are.
    rank: int
    size: int
    #: How many of them are on this machine, and how many of its cores this one may use.
    num_neighbours: int
    num_cores: int

    def sum(self, values: ComplexArray) -> ComplexArray:
        """Return the sums over processes of exact sums of one shape; ``values`` may be overwritten."""
        ...

    def union(self, numbers: IntArray) -> IntArray:
        """Return the numbers that any process has, sorted; those of one process are sorted and differ."""
        ...

    def gather(self, text: str) -> list[str]:
        """Return a text of every process, by rank."""
        ...
