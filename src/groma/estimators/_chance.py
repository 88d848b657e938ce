# SPDX-License-Identifier: BSD-3-Clause
"""What happens by chance: quantiles and tails, without the half second that importing scipy.stats takes."""

from __future__ import annotations

import math

from scipy.special import gammaincinv, pdtrc


def chi_square_quantile(share: float, dof: int) -> float:
    """Return the value that a share of all chi squares with so many degrees of freedom does not exceed."""
    return 2.0 * float(gammaincinv(0.5 * dof, share))


def log10_poisson_tail(count: float, mean: float) -> float:
    """Return the logarithm of the probability of more than ``count`` events where ``mean`` are expected."""
    if count < 0:
        return 0.0
    if mean <= 0.0:
        return -math.inf
    tail = float(pdtrc(count, mean))
    # Below the smallest number the first term is nearly all of the sum.
    first = math.floor(count) + 1
    log_tail = math.log(tail) if tail > 0.0 else first * math.log(mean) - mean - math.lgamma(first + 1)
    return log_tail / math.log(10.0)
