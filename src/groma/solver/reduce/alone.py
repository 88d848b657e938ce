# SPDX-License-Identifier: BSD-3-Clause
"""The reducer of a process that has all shards."""

from __future__ import annotations

from groma._typing import ComplexArray, IntArray


class Alone:
    """A :class:`groma.solver.reduce.contract.Reducer` that has nobody to ask."""

    rank, size = 0, 1

    def sum(self, values: ComplexArray) -> ComplexArray:  # noqa: D102
        return values

    def union(self, numbers: IntArray) -> IntArray:  # noqa: D102
        return numbers

    def gather(self, text: str) -> list[str]:  # noqa: D102
        return [text]


__all__ = ["Alone"]
