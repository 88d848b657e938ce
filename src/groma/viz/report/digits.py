# SPDX-License-Identifier: BSD-3-Clause
"""Formatting of numbers in charts, tables and tiles, and ticks of axes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np


def fixed(value: float) -> str:
    """Return three decimals for magnitudes from 0.01 to 10,000, else three digits."""
    return f"{value:.3f}" if 0.01 <= abs(value) < 1e4 else f"{value:.3g}"


def even(values: Sequence[float]) -> list[str]:
    """Return numbers with the same decimals, three digits of the middle one; a dash for those that are not finite."""
    known = [value for value in values if math.isfinite(value) and value > 0]
    decimals = max(2 - math.floor(math.log10(float(np.median(known)))), 0) if known else 0
    form = ".1e" if decimals > 8 else f",.{decimals}f"
    return [format(value, form) if math.isfinite(value) else "–" for value in values]


def short(values: Sequence[float]) -> list[str]:
    """Return numbers with three digits each, with k and M for thousands and millions, else as :func:`even` does."""
    known = [abs(value) for value in values if math.isfinite(value)]
    if max(known, default=0.0) < 1e3:
        return even(values)
    return [_with_unit(value) for value in values]


def _with_unit(value: float) -> str:
    for limit, unit in ((1e6, "M"), (1e3, "k")):
        if limit <= abs(value) < 1e3 * limit:
            return f"{value / limit:.3g} {unit}"
    return f"{value:.3g}"


def percent(share: float) -> str:
    """Return a share in per cent, with two digits."""
    return f"{100 * share:.2g} %" if share < 0.995 else "100 %"


def tick(value: float) -> str:
    """Return a number beside an axis of any range."""
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e6:
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    if 1e6 <= abs(value) < 1e9:
        return f"{value / 1e6:.4g} M"
    mantissa, exponent = f"{value:.0e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def tick_of_step(value: float, step: float) -> str:
    """Return a number beside an axis with as many decimals as its step needs."""
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return f"{value + 0.0:,.{decimals}f}" if decimals <= 6 else f"{value:.2g}"


def round_step(extent: float, most: int) -> float:
    """Return the smallest of 1, 2 or 5 times a power of ten that divides an extent into at most ``most`` parts."""
    power = 10.0 ** math.floor(math.log10(extent / most))
    return next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if extent / (factor * power) <= most)


def ticks(low: float, high: float, step: float) -> list[float]:
    """Return the multiples of a step from ``low`` to ``high``."""
    return [step * k for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]
