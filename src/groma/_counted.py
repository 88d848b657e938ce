# SPDX-License-Identifier: BSD-3-Clause
"""Counts as a person reads them, for every sentence, table and message."""


def counted(count: int, plural: str) -> str:
    """Return for example ``22,106 points`` or ``1 image``."""
    return f"{count:,} {plural.removesuffix('s') if count == 1 else plural}"


__all__ = ["counted"]
