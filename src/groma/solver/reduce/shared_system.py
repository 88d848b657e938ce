# SPDX-License-Identifier: BSD-3-Clause
"""The reduced system of a problem that comes in shards: what each leaves behind when its landmarks are eliminated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from groma._typing import ComplexArray, FloatArray, IntArray
from groma.errors import ProblemError
from groma.problem.layout import KeptClass, Layout, Member
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.solver.linear.blocks import joined, split
from groma.solver.linear.choice import linear_solver
from groma.solver.linear.contract import LinearSolver
from groma.solver.linear.pcg import ConjugateGradients
from groma.solver.linear.schur import MIN_DIAGONAL, ReducedSystem
from groma.solver.reduce import exact_sums
from groma.solver.reduce.contract import Reducer
from groma.solver.reduce.scattered import ScatteredBlocks
from groma.solver.steps import States, largest_slope

#: Numbers that are summed with the system: the cost and such (a format of messages).
NUM_FOUND = 11


class SharedSystem:
    """The reduced system of all shards, with one class of blocks per group of variables.

    A shard may merge a camera's intrinsics with its pose, and another one not; so its blocks are cut into those of
    single variables. Blocks off the diagonal are found by number, row * columns + column.

    Which blocks there are is agreed between processes at the first :meth:`reduce`. From then on all sums lie in one
    buffer, and are reduced in one go.

    Parameters
    ----------
    kept : mapping
        The variables.
    reducer : Reducer
        All processes.
    formed : bool
        Whether the system is formed on every process; otherwise blocks off the diagonal stay with their shards.
    """

    def __init__(self, kept: Mapping[str, Variables], reducer: Reducer, formed: bool = True) -> None:
        self._reducer = reducer
        self._groups = list(kept)
        self._variables = kept
        self._sizes = [(len(group), group.manifold.dof) for group in kept.values()]
        self._scattered = None if formed else ScatteredBlocks(self._sizes, reducer)
        self._number: dict[tuple[int, int], IntArray] = {}
        #: Exact sums, as shards are added: by group the diagonal blocks, curvature, gradient and right-hand side, the
        #: blocks off the diagonal by pairs of groups, and what else was found.
        self._sums: dict[tuple[str, int], ComplexArray] = {("found", 0): np.zeros(NUM_FOUND, complex)}
        for a, (count, dof) in enumerate(self._sizes):
            self._sums["diagonal", a] = np.zeros((count, dof, dof), complex)
            self._sums |= {(name, a): np.zeros((count, dof), complex) for name in ("curvature", "gradient", "rhs")}
        self._buffer: ComplexArray | None = None
        self._on_diagonal: list[FloatArray] = []
        self._curvature: list[FloatArray] = []
        self._gradient: list[FloatArray] = []
        self._rhs: list[FloatArray] = []
        self._blocks: dict[tuple[int, int], FloatArray] = {}

    def clear(self) -> None:
        """Set all sums to zero; what was reduced before stays until the next :meth:`reduce`."""
        for sums in self._sums.values():
            sums[...] = 0.0
        if self._scattered is not None:
            self._scattered.clear()

    def largest_gradient(self) -> float:
        """Return the largest component of the gradient of the kept variables, each over the root of its curvature."""
        return max(map(largest_slope, self._gradient, self._curvature), default=0.0)

    def is_curved(self) -> bool:
        """Whether the cost depends on any kept variable, where there are any."""
        return not self._curvature or any(bool(part.any()) for part in self._curvature)

    def find(self, values: FloatArray) -> None:
        """Add to what else was found, :data:`NUM_FOUND` numbers."""
        exact_sums.add(self._sums["found", 0], values)

    def add(self, layout: Layout, system: ReducedSystem) -> None:
        """Add the part of a shard."""
        system.assemble(0.0)
        if self._scattered is not None:
            self._scattered.begin_shard()
        for c, kept in enumerate(layout.kept):
            # Blocks that this shard does not touch were given a one, so that they could be inverted.
            steps = np.arange(kept.width)
            system.S[c, c][: kept.count, steps, steps] -= system.diagonal(c) == 0.0
        gradient, rhs = joined(system.equations.g_kept), joined(system.rhs)
        sums = {"curvature": system.flat_diagonal(), "gradient": gradient, "rhs": rhs}
        for name, at in layout.unknowns.items():
            for kind, values in sums.items():
                exact_sums.add(self._sums[kind, self._groups.index(name)], values[at])
        for a, b, rows, columns, blocks in self._cut(layout, system):
            if a == b:
                same = rows == columns
                exact_sums.add(self._sums["diagonal", a], blocks[same], rows[same])
                rows, columns, blocks = rows[~same], columns[~same], blocks[~same]
                upper = rows < columns
                blocks = np.where(upper[:, None, None], blocks, blocks.swapaxes(1, 2))
                rows, columns = np.minimum(rows, columns), np.maximum(rows, columns)
            if self._scattered is None:
                self._add_blocks(a, b, rows.astype(np.int64) * self._sizes[b][0] + columns, blocks)
            else:
                self._scattered.keep(a, b, rows, columns, blocks)

    def _add_blocks(self, a: int, b: int, number: IntArray, blocks: FloatArray) -> None:
        known = self._number.get((a, b), np.zeros(0, np.int64))
        place = np.searchsorted(known, number)
        if (len(known) == 0 and len(number)) or (known[np.minimum(place, len(known) - 1)] != number).any():
            known = np.union1d(known, number)
            self._grow(a, b, known)
            place = np.searchsorted(known, number)
        if len(number):
            exact_sums.add(self._sums["blocks", self._pair(a, b)], blocks, place)

    def _pair(self, a: int, b: int) -> int:
        return a * len(self._sizes) + b

    def _grow(self, a: int, b: int, number: IntArray) -> None:
        """Make room for the blocks of these numbers, which contain those that are there."""
        if self._buffer is not None:
            raise ProblemError(
                "A shard couples variables that it did not couple when it was visited first. Shard.factors must make "
                "the same factors every time."
            )
        grown = np.zeros((len(number), self._sizes[a][1], self._sizes[b][1]), complex)
        if (a, b) in self._number:
            grown[np.searchsorted(number, self._number[a, b])] = self._sums["blocks", self._pair(a, b)]
        self._number[a, b], self._sums["blocks", self._pair(a, b)] = number, grown

    def reduce(self) -> FloatArray:
        """Sum over all processes, when the shards have been visited; return what else was found."""
        if self._buffer is None:
            self._agree()
        assert self._buffer is not None
        total = exact_sums.rounded(self._reducer.sum(self._buffer))
        parts, start = {}, 0
        for key, sums in self._sums.items():
            parts[key] = total[start : start + sums.size].reshape(sums.shape)
            start += sums.size
        groups = range(len(self._sizes))
        self._on_diagonal, self._curvature = (
            [parts["diagonal", a] for a in groups],
            [parts["curvature", a] for a in groups],
        )
        self._gradient, self._rhs = [parts["gradient", a] for a in groups], [parts["rhs", a] for a in groups]
        self._blocks = {(a, b): parts["blocks", self._pair(a, b)] for a, b in self._number}
        return parts["found", 0]

    def _agree(self) -> None:
        """Find which blocks there are on any process; put all sums into one buffer, in the same order everywhere."""
        for a in range(len(self._sizes)):
            for b in range(a, len(self._sizes)):
                number = self._reducer.union(self._number.get((a, b), np.zeros(0, np.int64)))
                if len(number):
                    self._grow(a, b, number)
        self._number = {pair: self._number[pair] for pair in sorted(self._number)}
        self._sums = {key: self._sums[key] for key in sorted(self._sums)}
        self._buffer, start = np.concatenate([sums.reshape(-1) for sums in self._sums.values()]), 0
        for key, sums in self._sums.items():
            self._sums[key] = self._buffer[start : start + sums.size].reshape(sums.shape)
            start += sums.size

    def _cut(self, layout: Layout, system: ReducedSystem) -> Iterator[tuple[int, int, IntArray, IntArray, FloatArray]]:
        """Yield the blocks of a shard by pairs of groups a <= b: rows, columns and blocks of single variables."""
        for (c, d), S in system.S.items():
            rows, columns = layout.blocks[c, d]
            for m, first in enumerate(layout.kept[c].members):
                for n, second in enumerate(layout.kept[d].members):
                    if c == d and n < m:
                        continue
                    a, b = self._groups.index(first.group), self._groups.index(second.group)
                    mine, other = first.columns, second.columns
                    found = [(self._variable(first)[rows], self._variable(second)[columns], S[:, mine, other])]
                    if c == d and m != n:  # below the diagonal lies the transpose
                        off = rows != columns
                        below = S[off][:, other, mine].swapaxes(1, 2)
                        found.append((self._variable(first)[columns[off]], self._variable(second)[rows[off]], below))
                    for row, column, blocks in found:
                        yield (a, b, row, column, blocks) if a <= b else (b, a, column, row, blocks.swapaxes(1, 2))

    def _variable(self, member: Member) -> IntArray:
        """Return the variable of each block."""
        count = len(self._variables[member.group])
        return np.arange(count) if member.block_of is None else np.argsort(member.block_of)

    def solver(self, layout: Layout, name: str) -> LinearSolver:
        """Return the solver of a name for the layout of :meth:`system`; where that is not formed, it is always pcg."""
        return linear_solver(layout, name) if self._scattered is None else ConjugateGradients(layout, self._scattered)

    def system(self, damping: float) -> tuple[Layout, dict[tuple[int, int], FloatArray], list[FloatArray]]:
        """Return a layout of the kept variables, the damped blocks, and the right-hand side."""
        classes, start = [], 0
        for name, (count, dof) in zip(self._groups, self._sizes, strict=True):
            classes.append(KeptClass(dof, count, (Member(name, 0, dof),), start))
            start += count * dof
        blocks, S = {}, {}
        for a, (count, dof) in enumerate(self._sizes):
            diagonal = self._on_diagonal[a].copy()
            steps = np.arange(dof)
            diagonal[:, steps, steps] += damping * np.maximum(self._curvature[a], MIN_DIAGONAL)
            diagonal[:, steps, steps] += self._curvature[a] == 0.0
            every = np.arange(count, dtype=np.int32)
            row, column = self._places(a, a)
            blocks[a, a] = (np.concatenate([every, row]), np.concatenate([every, column]))
            S[a, a] = np.concatenate([diagonal, self._blocks[a, a]]) if (a, a) in self._blocks else diagonal
        for (a, b), values in self._blocks.items():
            if a != b:
                blocks[a, b], S[a, b] = self._places(a, b), values
        layout = Layout(Problem(self._variables, ()), tuple(classes), (), (), (), blocks, {})
        return layout, S, [rhs.reshape(-1) for rhs in self._rhs]

    def _places(self, a: int, b: int) -> tuple[IntArray, IntArray]:
        number = self._number.get((a, b), np.zeros(0, np.int64))
        row, column = np.divmod(number, self._sizes[b][0])
        return row.astype(np.int32), column.astype(np.int32)

    def model(self, step: list[FloatArray]) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        """Return diagonal, gradient and step of every class, flat; they are kept when the sums are cleared."""
        return [
            (curvature.reshape(-1), gradient.reshape(-1), delta)
            for curvature, gradient, delta in zip(self._curvature, self._gradient, step, strict=True)
        ]

    def retract(self, states: States, step: list[FloatArray]) -> States:
        """Return the kept variables moved by a step."""
        return {
            name: group.manifold.retract(states[name], np.ascontiguousarray(delta.reshape(len(group), -1)))
            for (name, group), delta in zip(self._variables.items(), step, strict=True)
        }

    def part(self, layout: Layout, step: list[FloatArray]) -> list[FloatArray]:
        """Return a step in the blocks of a shard."""
        flat = np.zeros(layout.num_kept_unknowns)
        for name, at in layout.unknowns.items():
            flat[at] = step[self._groups.index(name)].reshape(at.shape)
        return split(layout, flat)
