# SPDX-License-Identifier: BSD-3-Clause
r"""From states to normal equations.

For every chunk of the layout the factors write their records ``[J_1 | J_2 | ... | r]`` into a scratch that stays in
cache. The records are whitened, weighted by the robust loss, chained with the charts, and summed into

.. math:: V = \sum J_l^\top J_l, \quad W = \sum J_l^\top J_c, \quad H = \sum J_c^\top J_c, \quad g = \sum J^\top r .

V, W and the landmarks' gradient belong to a chunk alone; H and the cameras' gradient are summed per share.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from groma._typing import FloatArray
from groma.problem._factor_records import records_of
from groma.problem._share_sums import LandmarkSums, ShareSums
from groma.problem.layout import CHUNK_SIZE, Chunk, Layout, in_runs
from groma.problem.parallel import COSTS_IN_THREADS, LINEARISED_IN_THREADS, Workers, shares_of, sum_of

States = Mapping[str, FloatArray]
#: Where costs of landmarks are not asked for.
_NO_COSTS = np.empty(0)


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
        most = [0] * len(layout.factors)
        for chunk in layout.chunks:
            for f, begin, end in chunk.factors:
                most[f] = max(most[f], end - begin)
        if not layout.kept:
            most = [max(n, min(CHUNK_SIZE, len(f.factor))) for n, f in zip(most, layout.factors, strict=True)]
        self._records = records_of(layout, most)
        self._known: dict[str, tuple[FloatArray, FloatArray]] = {}
        landmarks = LandmarkSums.of(layout, compact)
        self.V, self.g_landmarks, self.W = landmarks.V, landmarks.g, landmarks.W
        self.shares = shares_of(layout)
        self._shares = [ShareSums(layout, chunks, self._records, landmarks, compact) for chunks in self.shares]
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
            one.layout.factor.prepare(tuple(ambients[ref.group] for ref in one.references)) for one in self._records
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
            for f, begin, end in self._shares[share].runs(wanted):
                e = self.layout.factors[f].eliminated
                costs = _NO_COSTS if landmark_costs is None or e is None else landmark_costs[e]
                value, degenerate = self._records[f].cost(inputs[f], begin, end, costs)
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
        for one in self._records:
            for chain in one.layout.chains:
                name = one.references[chain.reference].group
                if name not in bases:
                    bases[name] = self.layout.problem.variables[name].manifold.basis(states[name])

        def work(share: int) -> tuple[list[float], list[int]]:
            costs, degenerate = [0.0] * len(self.layout.factors), [0] * len(self.layout.factors)
            sums = self._shares[share]
            sums.clear()
            chosen = (chunk for chunk in sums.chunks if wanted is None or wanted(chunk))
            for chunks in in_runs(chosen, 0 if self.layout.kept else CHUNK_SIZE):
                chunk = chunks[0].up_to(chunks[-1])
                sums.clear_landmarks(chunk)
                for f, begin, end in chunk.factors:
                    if begin < end:
                        record, cost, count = self._records[f].linearize(inputs[f], begin, end, bases)
                        sums.add(chunk, f, record, begin)
                        costs[f] += cost
                        degenerate[f] += count
                if after_chunk is not None and chunk.eliminated is not None:
                    after_chunk(share, chunk)
                sums.round(chunk)
            return costs, degenerate

        parts = self.workers.map(work, len(self.shares), self._is_little(wanted, LINEARISED_IN_THREADS))
        self.costs = [0.5 * sum(part[0][f] for part in parts) for f in range(len(self.layout.factors))]
        self.num_degenerate = [sum(part[1][f] for part in parts) for f in range(len(self.layout.factors))]
        self.H = {pair: sum_of([one.H[pair] for one in self._shares], self.workers) for pair in self.layout.num_direct}
        self.g_kept = [sum_of([one.g[c] for one in self._shares], self.workers) for c in range(len(self.layout.kept))]
        return float(sum(self.costs))

    def blocks_of_chunk(self, share: int, chunk: Chunk, kept_class: int) -> tuple[FloatArray, int]:
        """Return an array with the blocks W of a chunk, in double precision, and its first incidence."""
        return self._shares[share].blocks_of(chunk, kept_class)


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
