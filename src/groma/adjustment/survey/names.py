# SPDX-License-Identifier: BSD-3-Clause
"""Messages about names of a file that are not in the scene."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from groma._typing import IntArray
from groma.errors import InputError


def nearest(name: str, known: Sequence[str]) -> str:
    """Return words that name the known name most like another; none where nothing is like it."""
    close = difflib.get_close_matches(name, known[:5000], n=1, cutoff=0.5)
    return f" (nearest: {close[0]})" if close else ""


def require_some(found: IntArray, wanted: Sequence[str], known: Sequence[str], source: str) -> None:
    """Raise if no name was found.

    Raises
    ------
    InputError
        It names the first one and the most similar known name.
    """
    if len(wanted) and not (found >= 0).any():
        example = nearest(wanted[0], known) or f" (such as {known[0]})" if len(known) else ""
        raise InputError(
            f"{source}: none of its {len(wanted)} names is an image of the scene; the first is {wanted[0]!r}{example}. "
            "Use the same names."
        )
