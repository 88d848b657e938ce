# SPDX-License-Identifier: BSD-3-Clause
"""Symmetric block matrices and vectors of the kept blocks of a layout."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from groma._numba import loop
from groma._simd import add_matvec, add_product, width
from groma._typing import FloatArray
from groma.problem.layout import Layout

#: Blocks (n, a, b) on and above the diagonal by pair of classes, in the order of ``Layout.blocks``.
Blocks = dict[tuple[int, int], FloatArray]

# ---------------------------------------------------------------------------------------------------------- Kernels


@loop
def add_block_products(blocks, rows, columns, same_class, x_row, x_column, y_row, y_column, a_width, b_width, one):
    """Add S x to y for the blocks of one class pair, and their mirror images below the diagonal."""
    a, b = len(a_width), len(b_width)
    for i in range(rows.shape[0]):
        r, c = np.int64(rows[i]), np.int64(columns[i])
        add_matvec(y_row, r * a, blocks, i * a * b, x_column, c * b, a_width, b_width)
        if not same_class or r != c:
            add_product(y_column, c * b, x_row, r * a, 1, blocks, i * a * b, b, a_width, one, b_width)


# ----------------------------------------------------------------------------------------------------------- Public


def multiply(layout: Layout, blocks: Blocks, x: list[FloatArray]) -> list[FloatArray]:
    """Return the product of a symmetric block matrix, given by its upper blocks, with x; both by class and flat.

    A class pair may hold fewer blocks than the layout lists; they are then the first ones.
    """
    y = [np.zeros_like(part) for part in x]
    for product in products(layout, blocks, x, y):
        add_block_products(*product)
    return y


def products(layout: Layout, blocks: Blocks, x: list[FloatArray], y: list[FloatArray]) -> list[tuple]:
    """Return the arguments of :func:`add_block_products` that add the product of the blocks with x to y."""
    products = []
    for (a, b), S in blocks.items():
        rows, columns = (index[: len(S)] for index in layout.blocks[a, b])
        widths = width(layout.kept[a].width), width(layout.kept[b].width), width(1)
        products.append((S, rows, columns, a == b, x[a], x[b], y[a], y[b], *widths))
    return products


def split(layout: Layout, x: FloatArray) -> list[FloatArray]:
    """Return the parts of a flat vector by class, without a copy."""
    return [x[c.unknowns] for c in layout.kept]


def joined(parts: Iterable[FloatArray]) -> FloatArray:
    """Return parts by class, of any shape, as one flat vector."""
    return np.concatenate([np.zeros(0), *(part.reshape(-1) for part in parts)])


def product(layout: Layout, blocks: Blocks, x: FloatArray) -> FloatArray:
    """Return the product of a symmetric block matrix, given by its upper blocks, with a flat vector."""
    return joined(multiply(layout, blocks, split(layout, np.ascontiguousarray(x))))
