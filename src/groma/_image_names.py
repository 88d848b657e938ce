# SPDX-License-Identifier: BSD-3-Clause
"""Names of images in one file found in another: as they are, in other folders, in other letters, without ending."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence

import numpy as np

from groma._counted import counted
from groma._typing import IntArray
from groma.bounded.names import IMAGES

#: Row of a name that is nowhere, and of one that several names fit equally well.
NOWHERE, SEVERAL = -1, -2

_ENDINGS = (*IMAGES, ".dng", ".heic")


def rows_by_name(wanted: Sequence[str], known: Sequence[str]) -> IntArray:
    """Return the row in ``known`` of each wanted name, ``NOWHERE`` or ``SEVERAL`` where it is not told.

    The first of these counts that finds any:

    1. the same name;
    2. one path is the end of the other, in small letters, as of ``images/left/1.png`` and ``left/1.png``;
    3. the same without the ending of an image;
    4. the same file in another folder, with its ending or without: where no two names of this list agree in a folder,
       and no other wanted name has this file in yet another folder. Cameras number their files anew in every folder, so
       ``101/1.jpg`` is not ``100/1.jpg`` where folders are known to mean something.
    """
    wanted = [_whole(name) for name in wanted]
    known = [_whole(name) for name in known]
    found = np.full(len(wanted), NOWHERE, np.int64)
    rows = {name: row for row, name in enumerate(known)}
    for place, name in enumerate(wanted):
        found[place] = rows.get(name, NOWHERE)
    for short in (str.lower, _without_ending):
        _by_ends(found, wanted, known, short)
    agreed = any(row >= 0 and "/" in wanted[place] and "/" in known[row] for place, row in enumerate(found.tolist()))
    if not agreed:
        for short in (str.lower, _without_ending):
            _by_files(found, wanted, known, short)
    return found


def tell_partly(found: IntArray, wanted: Sequence[str], known: Sequence[str], source: str) -> list[str]:
    """Say which names were found without their folder or ending, in at most one sentence."""
    pairs = {name: known[int(row)] for name, row in zip(wanted, found.tolist(), strict=True) if row >= 0}
    partly = [(name, of) for name, of in pairs.items() if _whole(name) != _whole(of)]
    if not partly:
        return []
    number = f"{counted(len(partly), 'names')} of images {'was' if len(partly) == 1 else 'were'}"
    return [f"{source}: {number} found without folder or ending, such as {partly[0][0]} for {partly[0][1]}."]


def _by_ends(found: IntArray, wanted: list[str], known: list[str], short: Callable[[str], str]) -> None:
    """Find names of which one is the end of the other; of several that are, the longest counts."""
    ends: dict[str, list[int]] = defaultdict(list)
    whole: dict[str, list[int]] = defaultdict(list)
    for row, name in enumerate(known):
        whole[short(name)].append(row)
        for end in _ends(short(name)):
            ends[end].append(row)
    for place in np.flatnonzero(found == NOWHERE).tolist():
        name = short(wanted[place])
        fitting = ends.get(name) or next((whole[end] for end in _ends(name) if end in whole), [])
        if fitting:
            found[place] = fitting[0] if len(fitting) == 1 else SEVERAL


def _by_files(found: IntArray, wanted: list[str], known: list[str], short: Callable[[str], str]) -> None:
    """Find files in other folders, where one name alone on each side has that file."""
    rows: dict[str, list[int]] = defaultdict(list)
    for row, name in enumerate(known):
        rows[_file(short(name))].append(row)
    askers: dict[str, set[str]] = defaultdict(set)
    for name in wanted:
        askers[_file(short(name))].add(short(name))
    for place in np.flatnonzero(found == NOWHERE).tolist():
        file = _file(short(wanted[place]))
        if file in rows:
            found[place] = rows[file][0] if len(rows[file]) == len(askers[file]) == 1 else SEVERAL


def _ends(name: str) -> list[str]:
    """All ends of a path, the longest first: itself, without its first folder, and so on."""
    parts = name.split("/")
    return ["/".join(parts[start:]) for start in range(len(parts))]


def _whole(name: str) -> str:
    return name.replace("\\", "/").removeprefix("./")


def _file(name: str) -> str:
    return name.rpartition("/")[2]


def _without_ending(name: str) -> str:
    name = name.lower()
    return next((name.removesuffix(ending) for ending in _ENDINGS if name.endswith(ending)), name)
