# SPDX-License-Identifier: BSD-3-Clause
"""Blocks of a reduced system that other processes hold, and multiply with vectors."""

from __future__ import annotations

from typing import Protocol

from groma._typing import FloatArray, IntArray


class RemoteBlocks(Protocol):
    """Blocks off the diagonal that conjugate gradients need products of; all processes call the same methods."""

    def pairs(self, c: int) -> tuple[IntArray, IntArray]:
        """Return rows and columns of the blocks within a class of kept blocks."""
        ...

    def add_products(self, x: list[FloatArray], y: list[FloatArray]) -> None:
        """Add the products of all blocks, and of their mirror images, with x to y, by class and flat."""
        ...

    def coarse(self, c: int, cluster: IntArray, P: FloatArray) -> FloatArray:
        """Return what the blocks within a class add to :func:`groma.solver.linear.coarse.coarse_products`."""
        ...
