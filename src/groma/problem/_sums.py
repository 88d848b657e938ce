# SPDX-License-Identifier: BSD-3-Clause
"""Records of a factor group summed into V, W, H and the gradients; see :mod:`groma.problem.linearization`."""

from __future__ import annotations

import numpy as np

from groma._numba import loop
from groma._simd import add_product, set_product

# ---------------------------------------------------------------------------------------------------------- Kernels


@loop
def add_primary(
    record, begin, first, landmark, l_column, incidence, block, c_column, V, g_l, W, H, g_c, alone,
    rows, l_width, c_width, one,
):  # fmt: skip
    """Sum the landmark, its incidence and its kept block, for factors with a landmark and a first kept block.

    W begins with the incidence ``first``. Where these factors ``alone`` make up W, the first of an incidence writes it
    and the others, which follow at once, add to it; otherwise all add.
    """
    n, m, columns = record.shape
    dl, dc = len(l_width), len(c_width)
    previous = np.int64(-1)
    for i in range(n):
        base = i * m * columns
        at_l, at_c, at_r = base + l_column, base + c_column, base + columns - 1
        p, q, c = np.int64(landmark[begin + i]), incidence[begin + i] - first, np.int64(block[begin + i])
        add_product(V, p * (dl * dl), record, at_l, columns, record, at_l, columns, rows, l_width, l_width)
        add_product(g_l, p * dl, record, at_r, columns, record, at_l, columns, rows, one, l_width)
        if alone and q != previous:
            set_product(W, q * (dl * dc), record, at_l, columns, record, at_c, columns, rows, l_width, c_width)
        else:
            add_product(W, q * (dl * dc), record, at_l, columns, record, at_c, columns, rows, l_width, c_width)
        previous = q
        add_product(H, c * (dc * dc), record, at_c, columns, record, at_c, columns, rows, c_width, c_width)
        add_product(g_c, c * dc, record, at_r, columns, record, at_c, columns, rows, one, c_width)


@loop
def add_incidence(record, begin, first, l_column, incidence, c_column, W, rows, l_width, c_width):
    """Sum the incidence of the landmark with a further kept block."""
    n, m, columns = record.shape
    size = len(l_width) * len(c_width)
    for i in range(n):
        base = i * m * columns
        at_l, at_c = base + l_column, base + c_column
        q = incidence[begin + i] - first
        add_product(W, q * size, record, at_l, columns, record, at_c, columns, rows, l_width, c_width)


@loop
def add_block(record, begin, block, column, H, g, rows, block_width, one):
    """Sum the square and the gradient of one block; serves landmarks alone and kept blocks alone."""
    n, m, columns = record.shape
    size = len(block_width)
    for i in range(n):
        base = i * m * columns
        at_c, at_r = base + column, base + columns - 1
        c = np.int64(block[begin + i])
        add_product(H, c * (size * size), record, at_c, columns, record, at_c, columns, rows, block_width, block_width)
        add_product(g, c * size, record, at_r, columns, record, at_c, columns, rows, one, block_width)


@loop
def add_cross(record, begin, block_a, column_a, block_b, column_b, slot, same_class, H, rows, a_width, b_width):
    """Sum the product of two kept blocks; within one class the smaller block is the row."""
    n, m, columns = record.shape
    size = len(a_width) * len(b_width)
    for i in range(n):
        base = i * m * columns
        at_a, at_b = base + column_a, base + column_b
        target = np.int64(slot[begin + i]) * size
        a, b = block_a[begin + i], block_b[begin + i]
        if not same_class or a <= b:
            add_product(H, target, record, at_a, columns, record, at_b, columns, rows, a_width, b_width)
        if same_class and a >= b:
            add_product(H, target, record, at_b, columns, record, at_a, columns, rows, b_width, a_width)
