# SPDX-License-Identifier: BSD-3-Clause
"""Names in one file found in another: as they are, without folders, or without ending."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np

from groma._counted import counted
from groma._typing import IntArray
from groma.errors import InputError


def rows_by_name(wanted: Sequence[str], known: Sequence[str]) -> IntArray:
    """Return the row in ``known`` of each wanted name, -1 where there is none.

    A name counts as found if it is the same; else, if that tells one from all others, if it is the same without
    folders, or without folders and ending, in small letters.
    """
    found = np.full(len(wanted), -1, np.int64)
    for short in (_whole, _file, _stem):
        rows: dict[str, int] = {}
        for row, name in enumerate(known):
            rows[short(name)] = row if short(name) not in rows else -1
        for place in np.flatnonzero(found < 0).tolist():
            found[place] = rows.get(short(wanted[place]), -1)
    return found


def nearest(name: str, known: Sequence[str]) -> str:
    """Return words that name the known name most like another; none where nothing is like it."""
    close = difflib.get_close_matches(name, known[:5000], n=1, cutoff=0.5)
    return f" (nearest: {close[0]})" if close else ""


def require_some(found: IntArray, wanted: Sequence[str], known: Sequence[str], source: str, kind: str) -> None:
    """Raise if no name was found.

    Raises
    ------
    InputError
        It names the first one, and what it is most like.
    """
    if len(wanted) and not (found >= 0).any():
        example = nearest(wanted[0], known) or f" (such as {known[0]})" if len(known) else ""
        raise InputError(
            f"{source}: none of its {len(wanted)} names is {kind} of the scene; the first is {wanted[0]!r}{example}. "
            "Use the same names."
        )


def tell_partly(found: IntArray, wanted: Sequence[str], known: Sequence[str], source: str) -> list[str]:
    """Say which names were found without their folder or ending, in at most one sentence."""
    pairs = {name: known[int(row)] for name, row in zip(wanted, found.tolist(), strict=True) if row >= 0}
    partly = [(name, of) for name, of in pairs.items() if _whole(name) != _whole(of)]
    if not partly:
        return []
    number = f"{counted(len(partly), 'names')} of images {'was' if len(partly) == 1 else 'were'}"
    return [f"{source}: {number} found without folder or ending, such as {partly[0][0]} for {partly[0][1]}."]


def _whole(name: str) -> str:
    return name.replace("\\", "/")


def _file(name: str) -> str:
    return PurePosixPath(_whole(name)).name.lower()


def _stem(name: str) -> str:
    path = PurePosixPath(_file(name))
    return (
        path.stem if path.suffix in (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".dng", ".heic", ".webp") else path.name
    )
