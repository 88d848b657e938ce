# SPDX-License-Identifier: BSD-3-Clause
"""Numbers as a person reads them: counts in every sentence, table and message, and numbers in names."""

from __future__ import annotations

import re


def counted(count: int, plural: str) -> str:
    """Return for example ``22,106 points`` or ``1 image``."""
    return f"{count:,} {plural.removesuffix('s') if count == 1 else plural}"


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a key by which img2 comes before img10."""
    parts = re.split(r"(\d+)", name)
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts]
