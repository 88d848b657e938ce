# SPDX-License-Identifier: BSD-3-Clause
"""The sums of one share of the chunks of a problem."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from groma._typing import FloatArray
from groma.problem._factor_records import FactorRecords
from groma.problem._room import room_for_chunks, room_for_sums
from groma.problem._sums import add_block, add_cross, add_incidence, add_primary
from groma.problem.layout import Chunk, Layout


@dataclass(frozen=True, eq=False)
class LandmarkSums:
    """Sums that belong to landmarks, by their group: no two shares add to the same."""

    V: list[FloatArray]
    g: list[FloatArray]
    #: By class of kept blocks too.
    W: list[dict[int, Any]]

    @classmethod
    def of(cls, layout: Layout, compact: bool) -> LandmarkSums:
        """Return room for them; W in single precision if ``compact``."""
        return cls(*room_for_sums(layout, compact))


class ShareSums:
    """H and the kept gradient of one share, and its part of the sums of landmarks.

    Parameters
    ----------
    layout, chunks
        The problem and the chunks of this share.
    records
        Of each factor group.
    landmarks, compact
        What all shares add to, and whether its W is in single precision: a chunk's part is then formed elsewhere.
    """

    def __init__(
        self, layout: Layout, chunks: list[Chunk], records: list[FactorRecords], landmarks: LandmarkSums, compact: bool
    ) -> None:
        self.layout, self.chunks = layout, chunks
        self._records, self._landmarks, self._is_compact = records, landmarks, compact
        self._W: list[dict[int, Any]] = room_for_chunks(layout) if compact else landmarks.W
        width = [one.width for one in layout.kept]
        self.H = {pair: np.zeros(n * width[pair[0]] * width[pair[1]]) for pair, n in layout.num_direct.items()}
        self.g = [np.zeros(c.count * c.width) for c in layout.kept]
        self._alone = [
            {c: _has_one_source(layout, number, c) for c in e.incidences} for number, e in enumerate(layout.eliminated)
        ]
        self._loops = [self._loops_of(one) for one in records]
        self._all_runs: list[tuple[int, int, int]] | None = None

    def runs(self, wanted: Callable[[Chunk], bool] | None) -> Iterable[tuple[int, int, int]]:
        """Return factor group, begin and end of factors of many chunks: costs need less room than records."""
        if wanted is not None:
            return self._find_runs(wanted)
        if self._all_runs is None:
            self._all_runs = list(self._find_runs(None))
        return self._all_runs

    def _find_runs(self, wanted: Callable[[Chunk], bool] | None) -> Iterator[tuple[int, int, int]]:
        runs: dict[int, tuple[int, int]] = {}
        room = [one.most_costs for one in self._records]
        for chunk in self.chunks:
            if wanted is not None and not wanted(chunk):
                continue
            for f, begin, end in chunk.factors:
                if begin == end:
                    continue
                first, last = runs.get(f, (begin, begin))
                if last != begin or end - first > room[f]:
                    yield f, first, last
                    first = begin
                runs[f] = first, end
        yield from ((f, *run) for f, run in runs.items())

    def clear(self) -> None:
        """Set what belongs to this share alone to zero."""
        for sums in (*self.H.values(), *self.g):
            sums[:] = 0.0

    def clear_landmarks(self, chunk: Chunk) -> None:
        """Set the sums of the landmarks of a chunk to zero."""
        if chunk.eliminated is None:
            return
        e = self.layout.eliminated[chunk.eliminated]
        self._landmarks.V[chunk.eliminated][chunk.begin * e.dof**2 : chunk.end * e.dof**2] = 0.0
        self._landmarks.g[chunk.eliminated][chunk.begin * e.dof : chunk.end * e.dof] = 0.0
        for c, incidences in e.incidences.items():
            if self._alone[chunk.eliminated][c]:
                continue
            size = e.dof * self.layout.kept[c].width
            begin, end = incidences.pointer[chunk.begin], incidences.pointer[chunk.end]
            W, first = self.blocks_of(chunk, c)
            W[(begin - first) * size : (end - first) * size] = 0.0

    def blocks_of(self, chunk: Chunk, kept_class: int) -> tuple[FloatArray, int]:
        """Return an array with the blocks W of a chunk, in double precision, and its first incidence."""
        e = chunk.eliminated
        assert e is not None
        first = self.layout.eliminated[e].incidences[kept_class].pointer[chunk.begin] if self._is_compact else 0
        return self._W[e][kept_class], int(first)

    def round(self, chunk: Chunk) -> None:
        """Keep the blocks W of a chunk in single precision, if they are not kept as they are."""
        if chunk.eliminated is None or not self._is_compact:
            return
        e, kept, rounded = self.layout.eliminated[chunk.eliminated], self._W, self._landmarks.W[chunk.eliminated]
        for c, incidences in e.incidences.items():
            size = e.dof * self.layout.kept[c].width
            begin, end = incidences.pointer[chunk.begin] * size, incidences.pointer[chunk.end] * size
            rounded[c][begin:end] = kept[chunk.eliminated][c][: end - begin]

    def add(self, chunk: Chunk, f: int, record: FloatArray, begin: int) -> None:
        """Add the records of one factor group in a chunk."""
        for add, kept_class, arguments in self._loops[f]:
            if kept_class is None:
                add(record, begin, *arguments)
            else:
                add(record, begin, self.blocks_of(chunk, kept_class)[1], *arguments)

    def _loops_of(self, records: FactorRecords) -> list[tuple[Callable, int | None, tuple]]:
        """Return the loops that sum the records of a factor group, the class of W they add to, and arguments."""
        layout, sized = records.layout, records.sized
        rows, one = sized(layout.factor.residual_size), sized(1)
        sums: list[tuple[Callable, int | None, tuple]] = []
        rest = layout.kept
        if layout.eliminated is not None:
            e = layout.eliminated
            l_width = sized(self.layout.eliminated[e].dof)
            landmarks = (self._landmarks.V[e], self._landmarks.g[e])
            if not layout.kept:
                return [(add_block, None, (layout.landmark, layout.landmark_column, *landmarks, rows, l_width, one))]
            first, rest = layout.kept[0], layout.kept[1:]
            c = first.kept_class
            indices = (layout.landmark, layout.landmark_column, first.incidence, first.block, first.column)
            targets = (*landmarks, self._W[e][c], self.H[c, c], self.g[c], self._alone[e][c])
            widths = (rows, l_width, sized(self.layout.kept[c].width), one)
            sums.append((add_primary, c, (*indices, *targets, *widths)))
            for entry in rest:
                c = entry.kept_class
                indices = (layout.landmark_column, entry.incidence, entry.column)
                widths = (rows, l_width, sized(self.layout.kept[c].width))
                sums.append((add_incidence, c, (*indices, self._W[e][c], *widths)))
        for entry in rest:
            c = entry.kept_class
            targets = (self.H[c, c], self.g[c])
            sums.append(
                (add_block, None, (entry.block, entry.column, *targets, rows, sized(self.layout.kept[c].width), one))
            )
        for i, j, slot in layout.crosses:
            a, b = layout.kept[i], layout.kept[j]
            pair = (a.kept_class, b.kept_class)
            widths = [sized(self.layout.kept[c].width) for c in pair]
            blocks = (a.block, a.column, b.block, b.column, slot)
            sums.append((add_cross, None, (*blocks, pair[0] == pair[1], self.H[pair], rows, *widths)))
        return sums


def _has_one_source(layout: Layout, eliminated: int, kept_class: int) -> bool:
    """Return whether all blocks W of a class come from the first kept block of one factor group.

    Its factors are sorted by incidence, so that the first of each can write the block: it need not be cleared.
    """
    positions = [
        position
        for factor in layout.factors
        if factor.eliminated == eliminated
        for position, entry in enumerate(factor.kept)
        if entry.kept_class == kept_class and entry.incidence is not None
    ]
    return positions == [0]
