# SPDX-License-Identifier: BSD-3-Clause
"""Numbers as a person reads them: counts and durations in sentences, tables and messages, and numbers in names."""

from __future__ import annotations

import re
from collections.abc import Sequence


def counted(count: int, plural: str) -> str:
    """Return for example ``22,106 points`` or ``1 image``."""
    return f"{count:,} {plural.removesuffix('s') if count == 1 else plural}"


def whole_percent(share: float) -> str:
    """Return a share in whole percents, or that it is less than half a one."""
    # derived from rounding to whole percents
    return "under 1 %" if 0 < share < 0.005 else f"{100 * share:.0f} %"


def first_of(names: Sequence[str], most: int) -> str:
    """Return the first names of a list and how many more there are, for example ``a, b, c and 4 more``."""
    return ", ".join(names[:most]) + (f" and {len(names) - most:,} more" if len(names) > most else "")


def duration(seconds: float) -> str:
    """Return a duration in at most two units: ``40 s``, ``2 min 5 s``, ``3 h 10 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a key by which img2 comes before img10."""
    parts = re.split(r"(\d+)", name)
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts]
