# SPDX-License-Identifier: BSD-3-Clause
"""Names of images in the order in which a person would put them."""

from __future__ import annotations

import re


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a key by which img2 comes before img10."""
    parts = re.split(r"(\d+)", name)
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts]


__all__ = ["natural_key"]
