# SPDX-License-Identifier: BSD-3-Clause
r"""How a problem is laid out in memory before it is solved.

Free variables fall into two sets. *Landmarks* (points, lines) are eliminated one by one; they must not share a factor.
Everything else is *kept*: cameras, planes, directions. Kept variables of equal width form a *class*; a pose and the
intrinsics that only it uses are merged into one wider block.

With landmarks :math:`l` and kept blocks :math:`c` the normal equations are

.. math:: \begin{bmatrix} H & W^\top \\ W & V \end{bmatrix}
          \begin{bmatrix} \delta_c \\ \delta_l \end{bmatrix} = -\begin{bmatrix} g_c \\ g_l \end{bmatrix},

with V block-diagonal. An *incidence* is one non-zero block of W: a landmark and a kept block that share a factor.

Landmarks are sorted by their first and last kept block, and factors by landmark, so that a chunk of consecutive
landmarks touches few kept blocks and all it needs stays in cache. A chunk is the unit of work.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from groma._typing import IntArray
from groma.factors.contract import Factor
from groma.problem.problem import Problem

#: Factors per chunk: their records (a few hundred bytes each) should fit the second-level cache (cost: time alone).
CHUNK_SIZE = 4096


@dataclass(frozen=True)
class Member:
    """A group of variables inside a class of kept blocks."""

    group: str
    #: First column of this variable inside the block.
    offset: int
    dof: int
    #: Block of each variable; None if variable i is in block i.
    block_of: IntArray | None = None

    @property
    def columns(self) -> slice:
        """Columns of this variable inside the block."""
        return slice(self.offset, self.offset + self.dof)

    def blocks(self, index: IntArray) -> IntArray:
        """Return the block of each variable in ``index``."""
        return index if self.block_of is None else self.block_of[index]


@dataclass(frozen=True)
class KeptClass:
    """Kept blocks of equal width."""

    width: int
    count: int
    members: tuple[Member, ...]
    #: Position of the first unknown of this class in the reduced system.
    start: int

    @property
    def unknowns(self) -> slice:
        """Where the unknowns of this class are in the reduced system."""
        return slice(self.start, self.start + self.count * self.width)

    def blocks_of(self, x: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the part of a vector, or of columns, (unknowns, ...) as (count, width, ...), without a copy."""
        return x[self.unknowns].reshape(self.count, self.width, *x.shape[1:])


@dataclass(frozen=True)
class Incidences:
    """Non-zero blocks between the landmarks of one group and the kept blocks of one class."""

    #: (num_landmarks + 1,) first incidence of each landmark.
    pointer: IntArray
    #: Kept block of each incidence.
    block: IntArray
    #: Slots of the pairs within this class, and the first pair of each landmark.
    pair_slots: IntArray
    pair_pointer: IntArray


@dataclass(frozen=True)
class Eliminated:
    """A group of landmarks that is eliminated."""

    group: str
    dof: int
    count: int
    #: Original index of the landmark at each position.
    order: IntArray
    #: Incidences by kept class.
    incidences: dict[int, Incidences]
    #: For class pairs a < b: slots and pointer of the pairs between the incidences of both.
    cross: dict[tuple[int, int], tuple[IntArray, IntArray]]


@dataclass(frozen=True)
class Chain:
    """Columns of a record that turn from factor coordinates into increments of a chart."""

    reference: int
    raw_column: int
    raw_size: int
    column: int
    dof: int


@dataclass(frozen=True)
class KeptEntry:
    """A kept block inside the records of a factor group."""

    kept_class: int
    column: int
    #: (N,) block of each factor.
    block: IntArray
    #: (N,) incidence of each factor, if it has a landmark.
    incidence: IntArray | None = None


@dataclass(frozen=True)
class FactorLayout:
    """One factor group, sorted for its place in the elimination."""

    factor: Factor
    #: First column of each reference in a record, as :meth:`Factor.linearize` takes them.
    columns: tuple[int, ...]
    #: Doubles in one row of a record, and whether some of them are never written and must be zero.
    width: int
    has_gaps: bool
    chains: tuple[Chain, ...]
    #: References whose increments are partly held constant: (reference, column, dof).
    masked: tuple[tuple[int, int, int], ...]
    kept: tuple[KeptEntry, ...]
    #: (first entry, second entry, slot of each factor).
    crosses: tuple[tuple[int, int, IntArray], ...]
    #: Eliminated group and its column, or None.
    eliminated: int | None = None
    landmark_column: int = -1
    #: (N,) position of each factor's landmark; empty if there is none.
    landmark: IntArray = field(default_factory=lambda: np.zeros(0, np.int32))
    #: Its number among the groups of the problem.
    number: int = -1


@dataclass(frozen=True)
class Chunk:
    """A unit of work: some landmarks of one group with all their factors, or some factors without a landmark."""

    eliminated: int | None
    begin: int
    end: int
    #: (factor layout, begin, end).
    factors: tuple[tuple[int, int, int], ...]
    size: int

    def up_to(self, last: Chunk) -> Chunk:
        """Return this chunk and those that follow it, up to ``last``, as one; all have landmarks of the same group."""
        if last is self:
            return self
        factors = tuple((f, begin, end) for (f, begin, _), (_, _, end) in zip(self.factors, last.factors, strict=True))
        return Chunk(self.eliminated, self.begin, last.end, factors, sum(end - begin for _, begin, end in factors))


@dataclass
class Layout:
    """Everything about a problem that does not change while it is solved."""

    problem: Problem
    kept: tuple[KeptClass, ...]
    eliminated: tuple[Eliminated, ...]
    factors: tuple[FactorLayout, ...]
    chunks: tuple[Chunk, ...]
    #: (rows, columns) of the blocks of the reduced system for class pairs a <= b, and how many of them, at the front,
    #: are touched by factors directly.
    blocks: dict[tuple[int, int], tuple[IntArray, IntArray]]
    num_direct: dict[tuple[int, int], int]
    warnings: list[str] = field(default_factory=list)
    #: Layouts in which some groups of landmarks move alone, found so far, and the groups of factors that they have.
    of_landmarks: dict[tuple[str, ...], tuple[Layout, tuple[int, ...]]] = field(default_factory=dict)

    @property
    def num_kept_unknowns(self) -> int:
        """Size of the reduced system."""
        return sum(c.width * c.count for c in self.kept)

    @property
    def kinds(self) -> list[str]:
        """Kind of each kept class: that of its first member."""
        return [self.problem.variables[c.members[0].group].manifold.kind for c in self.kept]

    @cached_property
    def unknowns(self) -> dict[str, IntArray]:
        """Where the coordinates (count, dof) of the kept variables of each group are in the reduced system."""
        found = {}
        for kept in self.kept:
            for member in kept.members:
                blocks = member.blocks(np.arange(len(self.problem.variables[member.group])))
                found[member.group] = kept.start + member.offset + blocks[:, None] * kept.width + np.arange(member.dof)
        return found


def in_runs(chunks: Iterable[Chunk], most: int) -> Iterator[list[Chunk]]:
    """Yield chunks of landmarks that follow each other together, up to ``most`` factors; others one by one."""
    run: list[Chunk] = []
    size = 0
    for chunk in chunks:
        fits = size + chunk.size <= most and chunk.eliminated is not None
        if run and not (fits and (run[-1].eliminated, run[-1].end) == (chunk.eliminated, chunk.begin)):
            yield run
            run, size = [], 0
        run.append(chunk)
        size += chunk.size
    if run:
        yield run
