# SPDX-License-Identifier: BSD-3-Clause
r"""Sums of floats that do not depend on the order of their terms.

A sum is kept as an unevaluated pair, :math:`h + l` with l below the last digit of h, in the real and the imaginary part
of a complex number. Adding x to h leaves the rounding error

.. math:: s = h + x, \quad t = s - h, \quad e = (h - (s - t)) + (x - t)

exactly, and e is added to l. Twice the digits are kept, and the sum rounded at the end is the same in whatever order
and groups terms came, but for one case in :math:`2^{50}`. Problems in shards therefore have the same solution, bit by
bit, on one process and on many.

D. E. Knuth, *The Art of Computer Programming*, vol. 2, section 4.2.2, theorem B.
"""

from __future__ import annotations

import numpy as np

from groma._numba import exact_kernel, loop
from groma._typing import ComplexArray, FloatArray, IntArray

# ---------------------------------------------------------------------------------------------------------- Kernels


@exact_kernel
def _add(sums, at, value):
    """Add a value to the pair at ``at``."""
    high = sums[at]
    total = high + value
    back = total - high
    sums[at + 1] += (high - (total - back)) + (value - back)
    sums[at] = total


@loop
def _add_all(sums, values):
    """Add values (n,) to n pairs, flat."""
    for i in range(values.shape[0]):
        _add(sums, 2 * i, values[i])


@loop
def _add_rows(sums, rows, values, size):
    """Add values, flat, to rows of ``size`` pairs each."""
    for i in range(rows.shape[0]):
        first = np.int64(rows[i]) * size
        for k in range(size):
            _add(sums, 2 * (first + k), values[i * size + k])


# ----------------------------------------------------------------------------------------------------------- Public


def add(sums: ComplexArray, values: FloatArray, rows: IntArray | None = None) -> None:
    """Add values to contiguous sums, or to some rows of them, in place."""
    flat, values = sums.reshape(-1).view(np.float64), np.ascontiguousarray(values)
    if rows is None:
        _add_all(flat, values.reshape(-1))
    elif len(rows):
        _add_rows(flat, np.ascontiguousarray(rows, np.int64), values.reshape(-1), values[0].size)


def add_sums(sums: ComplexArray, others: ComplexArray) -> None:
    """Add other sums, in place. Which of the two are the others makes no difference."""
    low = sums.imag + others.imag
    sums.imag = 0.0
    add(sums, others.real)
    sums.imag += low


def rounded(sums: ComplexArray) -> FloatArray:
    """Return sums as plain floats."""
    total = sums.real + sums.imag
    lost = ~np.isfinite(sums.imag)
    if lost.any():
        total[lost] = sums.real[lost]
    return total
