# SPDX-License-Identifier: BSD-3-Clause
"""How likely so many chance events are, without SciPy's own statistics, which take half a second to load.

In come a number and a mean; out goes a probability.
"""

from __future__ import annotations

import numpy as np
from scipy.special import pdtrc


def log10_more_than(count: float, mean: float) -> float:
    """Base-10 logarithm of the probability of more events than ``count``; minus infinity where it is no number."""
    if count < 0:
        return 0.0
    with np.errstate(divide="ignore"):
        return float(np.log10(pdtrc(np.floor(count), mean)))


__all__ = ["log10_more_than"]
