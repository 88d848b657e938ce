# SPDX-License-Identifier: BSD-3-Clause
"""Room for the sums of a layout that belong to its landmarks."""

from __future__ import annotations

from itertools import accumulate
from typing import Any

import numpy as np

from groma._typing import FloatArray
from groma.problem.layout import Layout

#: Numbers in a line of the cache, at which every array begins (cost: time alone).
_LINE = 8


def room_for_sums(layout: Layout, compact: bool) -> tuple[list[FloatArray], list[FloatArray], list[dict[int, Any]]]:
    """Return room for V and the gradient by group of landmarks, and for W by class too; nothing is written to it.

    It is one piece of memory. glibc gives back to the system what is freed beyond twice the largest piece so far, and
    the next solve would have to get all of it again, page by page.
    """
    groups = list(enumerate(layout.eliminated))
    lengths: dict[Any, int] = {(number, "V"): group.count * group.dof**2 for number, group in groups}
    lengths |= {(number, "g"): group.count * group.dof for number, group in groups}
    blocks = {
        (number, c): len(seen.block) * group.dof * layout.kept[c].width
        for number, group in groups
        for c, seen in group.incidences.items()
    }
    room: dict[Any, Any] = _in_one_piece(lengths if compact else lengths | blocks)
    if compact:
        room |= {key: np.empty(length, np.float32) for key, length in blocks.items()}
    V, g = ([room[number, name] for number, _ in groups] for name in "Vg")
    return V, g, [{c: room[number, c] for c in group.incidences} for number, group in groups]


def _in_one_piece(lengths: dict[Any, int]) -> dict[Any, Any]:
    """Return arrays of these lengths, one behind the other."""
    begin = list(accumulate((-(-length // _LINE) * _LINE for length in lengths.values()), initial=0))
    piece = np.empty(begin[-1])
    return {key: piece[at : at + length] for (key, length), at in zip(lengths.items(), begin, strict=False)}


def room_for_chunks(layout: Layout) -> list[dict[int, Any]]:
    """Return room for the part of W of any one chunk, by group of landmarks and class."""
    room = []
    for e, group in enumerate(layout.eliminated):
        most = {
            c: max(i.pointer[chunk.end] - i.pointer[chunk.begin] for chunk in layout.chunks if chunk.eliminated == e)
            for c, i in group.incidences.items()
        }
        room.append({c: np.zeros(n * group.dof * layout.kept[c].width) for c, n in most.items()})
    return room
