# SPDX-License-Identifier: BSD-3-Clause
r"""From states to normal equations.

For every chunk of the layout the factors write their records ``[J_1 | J_2 | ... | r]`` into a scratch that stays in
cache. The records are whitened, weighted by the robust loss, chained with the charts, and summed into

.. math:: V = \sum J_l^\top J_l, \quad W = \sum J_l^\top J_c, \quad H = \sum J_c^\top J_c, \quad g = \sum J^\top r .

V, W and the landmarks' gradient belong to a chunk alone; H and the cameras' gradient are summed per share.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from groma._simd import width_for
from groma._typing import FloatArray
from groma.problem._records import chain_rule, cost_scaled, cost_whitened, weigh, whiten
from groma.problem._room import room_for_chunks, room_for_sums
from groma.problem._sums import add_block, add_cross, add_incidence, add_primary
from groma.problem.layout import CHUNK_SIZE, Chunk, FactorLayout, Layout, in_runs
from groma.problem.parallel import COSTS_IN_THREADS, LINEARISED_IN_THREADS, Workers, shares_of, sum_of

States = Mapping[str, FloatArray]
#: Where costs of landmarks are not asked for.
_NO_COSTS = np.empty(0)


class Noise:
    """The noise and the loss of a factor group in the form the loops take."""

    def __init__(self, layout: FactorLayout) -> None:
        factor = layout.factor
        information = np.asarray(factor.sqrt_information, dtype=np.float64)
        self.matrices: FloatArray | None = None
        self.scale = np.ones(1)
        self.step = 0
        if information.ndim == 3:
            self.matrices = np.ascontiguousarray(information)
        elif information.ndim == 1:
            self.scale, self.step = np.ascontiguousarray(information), 1
        else:
            self.scale = information.reshape(1)
        self.loss = factor.loss.tag, factor.loss.parameters


class NormalEquations:
    """The sums V, W, H and g of a layout, and the scratch to form them.

    Parameters
    ----------
    layout, workers
        What is summed, and by which threads.
    compact
        Keep W in single precision. Each chunk's part of it is formed in double precision in a scratch, which is there
        for ``after_chunk`` of :meth:`linearize`; only what is read later, for back-substitution, is rounded.
    """

    def __init__(self, layout: Layout, workers: Workers, compact: bool = False) -> None:
        self.layout = layout
        self.workers = workers
        self.compact = compact
        self._noise = [Noise(factor) for factor in layout.factors]
        self._sizes = [0] * len(layout.factors)
        for chunk in layout.chunks:
            for f, begin, end in chunk.factors:
                self._sizes[f] = max(self._sizes[f], end - begin)
        if not layout.kept:
            self._sizes = [
                max(n, min(CHUNK_SIZE, len(f.factor))) for n, f in zip(self._sizes, layout.factors, strict=True)
            ]
        self.shares = shares_of(layout)
        self._all_runs: dict[int, list[tuple[int, int, int]]] = {}
        self._scratch = threading.local()  # one per thread, not per share: it stays in cache
        self._references = [tuple(ref for _, ref in factor.factor.references()) for factor in layout.factors]
        self._known: dict[str, tuple[FloatArray, FloatArray]] = {}
        self._held = {}
        for factor, references in zip(layout.factors, self._references, strict=True):
            for name in {references[reference].group for reference, _, _ in factor.masked} - self._held.keys():
                free = layout.problem.variables[name].free_coordinates()
                assert free is not None
                order = next((e.order for e in layout.eliminated if e.group == name), None)
                self._held[name] = ~(free if order is None else free[order])
        self.V, self.g_landmarks, self.W = room_for_sums(layout, compact)
        self._chunk_W: list[list[dict[int, Any]]] = [
            room_for_chunks(layout) if compact else self.W for _ in self.shares
        ]
        self._alone = [
            {c: _has_one_source(layout, number, c) for c in e.incidences} for number, e in enumerate(layout.eliminated)
        ]
        self._H = [
            {p: np.zeros(n * layout.kept[p[0]].width * layout.kept[p[1]].width) for p, n in layout.num_direct.items()}
            for _ in self.shares
        ]
        self._g = [[np.zeros(c.count * c.width) for c in layout.kept] for _ in self.shares]
        most = max((len(f.factor) for f in layout.factors), default=0)
        self._sized = [width_for(len(f.factor), most) for f in layout.factors]
        numbers = range(len(layout.factors))
        self._sums = [[self._sums_of(share, f) for f in numbers] for share in range(len(self.shares))]
        self.num_degenerate = [0] * len(layout.factors)
        self.costs = [0.0] * len(layout.factors)
        self.hidden = [0] * len(layout.factors)

    # ------------------------------------------------------------------------------------------------ evaluation

    @property
    def num_hidden(self) -> int:
        """Degenerate factors in the last evaluation of the cost."""
        return sum(self.hidden)

    def prepare(self, states: States) -> list[tuple]:
        """Evaluate what each factor group reads of the states."""
        ambients = {name: self._ambient(name, state) for name, state in states.items()}
        return [
            layout.factor.prepare(tuple(ambients[ref.group] for ref in references))
            for layout, references in zip(self.layout.factors, self._references, strict=True)
        ]

    def _ambient(self, name: str, state: FloatArray) -> FloatArray:
        """Return what factors read of a group; of one that has not moved, the same array, what was found before."""
        known = self._known.get(name)
        if known is None or known[0] is not state:
            known = self._known[name] = state, self.layout.problem.variables[name].manifold.ambient(state)
        return known[1]

    def cost(
        self,
        inputs: list[tuple],
        landmark_costs: list[FloatArray] | None = None,
        wanted: Callable[[Chunk], bool] | None = None,
    ) -> float:
        """Return the total cost; also store ``costs`` and ``hidden``, the degenerate factors, both by factor group.

        With ``landmark_costs`` (one array of zeros per eliminated group) the cost of each landmark is added there.
        Chunks not in ``wanted`` are left out.
        """

        def work(share: int) -> tuple[list[float], list[int]]:
            sums, hidden = [0.0] * len(self.layout.factors), [0] * len(self.layout.factors)
            runs = self._runs_of_all(share) if wanted is None else self._runs(share, wanted)
            for f, begin, end in runs:
                e = self.layout.factors[f].eliminated
                costs = _NO_COSTS if landmark_costs is None or e is None else landmark_costs[e]
                value, degenerate = self._chunk_cost(f, inputs[f], begin, end, costs)
                sums[f] += value
                hidden[f] += degenerate
            return sums, hidden

        parts = self.workers.map(work, len(self.shares), self._is_little(wanted, COSTS_IN_THREADS))
        self.costs = [0.5 * sum(part[0][f] for part in parts) for f in range(len(self.layout.factors))]
        self.hidden = [sum(part[1][f] for part in parts) for f in range(len(self.layout.factors))]
        return float(sum(self.costs))

    def _is_little(self, wanted: Callable[[Chunk], bool] | None, least: int) -> bool:
        """Whether the selected chunks hold fewer factors than another thread is worth waking for."""
        return sum(c.size for c in self.layout.chunks if wanted is None or wanted(c)) < least

    def _runs_of_all(self, share: int) -> list[tuple[int, int, int]]:
        if share not in self._all_runs:
            self._all_runs[share] = list(self._runs(share, None))
        return self._all_runs[share]

    def _runs(self, share: int, wanted: Callable[[Chunk], bool] | None) -> Iterator[tuple[int, int, int]]:
        """Yield factor group, begin and end of factors of many chunks: costs need less room than records."""
        runs: dict[int, tuple[int, int]] = {}
        room = [self._room_of(f) // (one.factor.residual_size + 1) for f, one in enumerate(self.layout.factors)]
        for chunk in self.shares[share]:
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

    def cost_of(self, inputs: list[tuple], eliminated: set[int | None], costs: list[float], hidden: list[int]) -> float:
        """Return the total cost where only factors of some groups of landmarks, or without one, have moved.

        See :meth:`cost`.

        ``costs`` and ``hidden`` are those of an earlier evaluation; of all other factors they are taken over.
        """
        self.cost(inputs, wanted=lambda chunk: chunk.eliminated in eliminated)
        for f, layout in enumerate(self.layout.factors):
            if layout.eliminated not in eliminated:
                self.costs[f], self.hidden[f] = costs[f], hidden[f]
        return float(sum(self.costs))

    def _chunk_cost(self, f: int, inputs: tuple, begin: int, end: int, costs: FloatArray) -> tuple[float, int]:
        """Return the cost of factors, and how many are degenerate; add to the costs of their landmarks."""
        layout, noise = self.layout.factors[f], self._noise[f]
        n, m = end - begin, layout.factor.residual_size
        out = self._record(f)[: n * m].reshape(n, m)
        degenerate = layout.factor.residuals(inputs, begin, end, out)
        if noise.matrices is not None:
            value = cost_whitened(out, begin, noise.matrices, *noise.loss, layout.landmark, costs)
        else:
            value = cost_scaled(out, begin, noise.scale, noise.step, *noise.loss, layout.landmark, costs)
        return value, degenerate

    def _record(self, f: int) -> FloatArray:
        scratch = self._scratch.__dict__.setdefault("records", {})
        if f not in scratch:
            scratch[f] = np.zeros(self._room_of(f))
        return scratch[f]

    def _room_of(self, f: int) -> int:
        """Numbers in the records of a chunk of a factor group, and their norms."""
        layout = self.layout.factors[f]
        return self._sizes[f] * (layout.factor.residual_size * layout.width + 1)

    def linearize(
        self,
        states: States,
        inputs: list[tuple],
        after_chunk: Callable[[int, Chunk], None] | None = None,
        wanted: Callable[[Chunk], bool] | None = None,
    ) -> float:
        """Form all sums at the given states and return the cost.

        ``after_chunk(share, chunk)`` is called as soon as the sums of a chunk's landmarks are complete, while they
        are still in cache; where nothing is kept, of chunks that follow each other as one. Chunks that are not
        ``wanted`` are left out; the sums of their landmarks stay as they were.
        """
        bases = {}
        for f, layout in enumerate(self.layout.factors):
            for chain in layout.chains:
                name = self._references[f][chain.reference].group
                if name not in bases:
                    bases[name] = self.layout.problem.variables[name].manifold.basis(states[name])

        def work(share: int) -> tuple[list[float], list[int]]:
            costs, degenerate = [0.0] * len(self.layout.factors), [0] * len(self.layout.factors)
            for H in self._H[share].values():
                H[:] = 0.0
            for g in self._g[share]:
                g[:] = 0.0
            chosen = (chunk for chunk in self.shares[share] if wanted is None or wanted(chunk))
            for chunks in in_runs(chosen, 0 if self.layout.kept else CHUNK_SIZE):
                chunk = chunks[0].up_to(chunks[-1])
                self._clear(share, chunk)
                for f, begin, end in chunk.factors:
                    if begin < end:
                        cost, count = self._linearize_chunk(share, chunk, f, inputs[f], bases, begin, end)
                        costs[f] += cost
                        degenerate[f] += count
                if after_chunk is not None and chunk.eliminated is not None:
                    after_chunk(share, chunk)
                if self.compact and chunk.eliminated is not None:
                    self._round(share, chunk)
            return costs, degenerate

        parts = self.workers.map(work, len(self.shares), self._is_little(wanted, LINEARISED_IN_THREADS))
        self.costs = [0.5 * sum(part[0][f] for part in parts) for f in range(len(self.layout.factors))]
        self.num_degenerate = [sum(part[1][f] for part in parts) for f in range(len(self.layout.factors))]
        self.H = {pair: sum_of([H[pair] for H in self._H], self.workers) for pair in self.layout.num_direct}
        self.g_kept = [sum_of([g[c] for g in self._g], self.workers) for c in range(len(self.layout.kept))]
        return float(sum(self.costs))

    def _clear(self, share: int, chunk: Chunk) -> None:
        if chunk.eliminated is None:
            return
        e = self.layout.eliminated[chunk.eliminated]
        self.V[chunk.eliminated][chunk.begin * e.dof**2 : chunk.end * e.dof**2] = 0.0
        self.g_landmarks[chunk.eliminated][chunk.begin * e.dof : chunk.end * e.dof] = 0.0
        for c, incidences in e.incidences.items():
            if self._alone[chunk.eliminated][c]:
                continue
            size = e.dof * self.layout.kept[c].width
            begin, end = incidences.pointer[chunk.begin], incidences.pointer[chunk.end]
            W, first = self.blocks_of_chunk(share, chunk, c)
            W[(begin - first) * size : (end - first) * size] = 0.0

    def blocks_of_chunk(self, share: int, chunk: Chunk, kept_class: int) -> tuple[FloatArray, int]:
        """Return an array with the blocks W of a chunk, in double precision, and its first incidence."""
        e = chunk.eliminated
        assert e is not None
        first = self.layout.eliminated[e].incidences[kept_class].pointer[chunk.begin] if self.compact else 0
        return self._chunk_W[share][e][kept_class], int(first)

    def _round(self, share: int, chunk: Chunk) -> None:
        """Keep the blocks W of a chunk in single precision."""
        assert chunk.eliminated is not None
        e, kept, rounded = self.layout.eliminated[chunk.eliminated], self._chunk_W[share], self.W[chunk.eliminated]
        for c, incidences in e.incidences.items():
            size = e.dof * self.layout.kept[c].width
            begin, end = incidences.pointer[chunk.begin] * size, incidences.pointer[chunk.end] * size
            rounded[c][begin:end] = kept[chunk.eliminated][c][: end - begin]

    def _linearize_chunk(
        self, share: int, chunk: Chunk, f: int, inputs: tuple, bases: dict, begin: int, end: int
    ) -> tuple[float, int]:
        """Write, weigh, chain and sum the records of one factor group in one chunk."""
        layout, noise = self.layout.factors[f], self._noise[f]
        n, m = end - begin, layout.factor.residual_size
        flat = self._record(f)
        record = flat[: n * m * layout.width].reshape(n, m, layout.width)
        norms = flat[len(flat) - n :]
        if layout.has_gaps:
            record[:] = 0.0
        degenerate = layout.factor.linearize(inputs, begin, end, layout.columns, record)
        if noise.matrices is not None:
            whiten(record, begin, noise.matrices)
        cost = weigh(record, begin, noise.scale, noise.step, *noise.loss, norms)
        references, sized = self._references[f], self._sized[f]
        for chain in layout.chains:
            ref = references[chain.reference]
            chain_rule(
                record, begin, chain.raw_column, chain.column, ref.index, bases[ref.group],
                sized(chain.raw_size), sized(chain.dof), sized(1),
            )  # fmt: skip
        for reference, column, _ in layout.masked:
            ref = references[reference]
            held = self._held[ref.group][ref.index[begin:end], None]
            np.copyto(record[:, :, column : column + held.shape[2]], 0.0, where=held)
        for add, kept_class, arguments in self._sums[share][f]:
            if kept_class is None:
                add(record, begin, *arguments)
            else:
                add(record, begin, self.blocks_of_chunk(share, chunk, kept_class)[1], *arguments)
        return cost, degenerate

    def _sums_of(self, share: int, f: int) -> list[tuple[Callable, int | None, tuple]]:
        """Return the loops that sum the records of a factor group, the class of W they add to, and arguments."""
        layout, sized = self.layout.factors[f], self._sized[f]
        rows, one = sized(layout.factor.residual_size), sized(1)
        H, g = self._H[share], self._g[share]
        sums: list[tuple[Callable, int | None, tuple]] = []
        rest = layout.kept
        if layout.eliminated is not None:
            e = layout.eliminated
            l_width = sized(self.layout.eliminated[e].dof)
            landmarks = (self.V[e], self.g_landmarks[e])
            if not layout.kept:
                return [(add_block, None, (layout.landmark, layout.landmark_column, *landmarks, rows, l_width, one))]
            first, rest = layout.kept[0], layout.kept[1:]
            c = first.kept_class
            indices = (layout.landmark, layout.landmark_column, first.incidence, first.block, first.column)
            targets = (*landmarks, self._chunk_W[share][e][c], H[c, c], g[c], self._alone[e][c])
            widths = (rows, l_width, sized(self.layout.kept[c].width), one)
            sums.append((add_primary, c, (*indices, *targets, *widths)))
            for entry in rest:
                c = entry.kept_class
                indices = (layout.landmark_column, entry.incidence, entry.column)
                widths = (rows, l_width, sized(self.layout.kept[c].width))
                sums.append((add_incidence, c, (*indices, self._chunk_W[share][e][c], *widths)))
        for entry in rest:
            c = entry.kept_class
            targets = (H[c, c], g[c])
            sums.append(
                (add_block, None, (entry.block, entry.column, *targets, rows, sized(self.layout.kept[c].width), one))
            )
        for i, j, slot in layout.crosses:
            a, b = layout.kept[i], layout.kept[j]
            pair = (a.kept_class, b.kept_class)
            widths = [sized(self.layout.kept[c].width) for c in pair]
            blocks = (a.block, a.column, b.block, b.column, slot)
            sums.append((add_cross, None, (*blocks, pair[0] == pair[1], H[pair], rows, *widths)))
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


def to_original_order(layout: Layout, states: States) -> dict[str, FloatArray]:
    """Undo the sorting of landmarks."""
    result = dict(states)
    for e in layout.eliminated:
        original = np.empty_like(states[e.group])
        original[e.order] = states[e.group]
        result[e.group] = original
    return result


def to_solver_order(layout: Layout) -> dict[str, FloatArray]:
    """States of the problem's variables, landmarks in the order of the layout."""
    states = {name: group.state for name, group in layout.problem.variables.items()}
    for e in layout.eliminated:
        states[e.group] = states[e.group].take(e.order, axis=0)
    return states
