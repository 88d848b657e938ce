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

from typing import Any

import numpy as np

from groma._typing import ComplexArray, FloatArray


def add(sums: ComplexArray, values: FloatArray, where: Any = ...) -> None:
    """Add values to the sums at ``where``, in place; no place comes twice."""
    high = sums.real[where]
    with np.errstate(invalid="ignore"):  # infinite costs
        total = high + values
        back = total - high
        sums.imag[where] += (high - (total - back)) + (values - back)
    sums.real[where] = total


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


__all__ = ["add", "add_sums", "rounded"]
