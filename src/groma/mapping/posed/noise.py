# SPDX-License-Identifier: BSD-3-Clause
r"""How good given values are, and which of them are no measurements at all.

Given are squared residuals of N measurements of three coordinates each, and their redundancies :math:`r_i`: the share
of its own error that a measurement shows after it took part in an adjustment. Noise alone gives

.. math:: e_i^2 / (\sigma^2 r_i) \sim \chi^2_3, \qquad \hat\sigma^2 = \frac{\sum e_i^2}{3 \sum r_i} .

A forward search begins with the half whose normalised residuals are smallest and takes in one measurement after the
other as long as the next is within what the noise of those before explains: :math:`F_{3, 3k}` at a probability that is
divided by the number of measurements, so that a set without gross errors is found clean with the stated probability.
The noise of the k smallest of n underestimates that of all, by the mean of the truncated :math:`\chi^2_3`.

Reference: A. Hadi, J. Simonoff, *Procedures for the identification of multiple outliers in linear models*, 1993.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.gates import NORMAL, gate


@dataclass(frozen=True)
class GrossErrorGates:
    """When a given value is no measurement."""

    least_redundancy: float = gate(0.05, "share", "below which a residual says nothing", "convention: of geodesy")


GROSS_ERRORS = GrossErrorGates()


@dataclass(frozen=True, eq=False)
class GivenNoise:
    """The noise of given values and which of them have gross errors."""

    #: Standard deviation of a coordinate; None where the values show none: they are better than what they are compared
    #: with, or too few.
    sigma: float | None
    #: (N,) which have gross errors.
    gross: BoolArray


def noise_of_given(squared: FloatArray, redundancy: FloatArray) -> GivenNoise:
    """Return the noise of values of three coordinates each from squared residuals (N,) and redundancies (N,).

    Values that are not there have a redundancy of 0; they are not gross.
    """
    from scipy.stats import f  # takes half a second to import

    usable = np.flatnonzero(redundancy > GROSS_ERRORS.least_redundancy)
    gross = np.zeros(len(squared), bool)
    if 2 * len(usable) <= np.count_nonzero(redundancy > 0.0) or len(usable) < 3:
        return GivenNoise(None, gross)
    order = usable[np.argsort(squared[usable] / redundancy[usable], kind="stable")]
    ratio = squared[order] / redundancy[order]
    total, freedom = np.cumsum(squared[order]), 3.0 * np.cumsum(redundancy[order])  # derived from three coordinates
    count = len(order)
    half, k, variance = (count + 2) // 2, count, 0.0
    for k in range(half, count + 1):
        variance = total[k - 1] / freedom[k - 1] / _truncated(k / count)
        # derived from three coordinates
        if k == count or ratio[k] > 3.0 * variance * f.isf(NORMAL.false_alarm / count, 3, 3 * k):
            break
    if k < count:
        variance = total[k - 1] / freedom[k - 1]  # the others are none of them, and nothing was cut off
    gross[order[k:]] = True
    return GivenNoise(float(np.sqrt(variance)) if variance > 0.0 else None, gross)


def _truncated(share: float) -> float:
    """Return the mean of the smallest share of squares of three normal coordinates, relative to that of all."""
    from scipy.stats import chi2  # takes half a second to import

    return float(chi2.cdf(chi2.ppf(share, 3), 5) / share) if share < 1.0 else 1.0
