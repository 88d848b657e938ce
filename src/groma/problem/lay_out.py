# SPDX-License-Identifier: BSD-3-Clause
"""From a problem to its layout: eliminated variables, kept variables, and the order of everything.

The steps of :func:`lay_out`, in order: choose the landmarks, form classes of kept blocks, draft the records of every
factor group, sort landmarks and factors, number the blocks of the reduced system, and cut the work into chunks.

States and losses have no part in it. Where the same problem is solved from other states or under another loss,
:class:`Layouts` keeps what was found.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from groma._rows import pointers_of
from groma._typing import IntArray
from groma.problem._draft import Draft
from groma.problem._partition import LANDMARK_KINDS, choose_landmarks, couplings, kept_classes
from groma.problem.layout import CHUNK_SIZE, Chunk, Eliminated, FactorLayout, Incidences, KeptClass, Layout
from groma.problem.problem import Problem, under_loss
from groma.problem.sorting import PairTable, argsort_by, distinct_pairs, first_and_last
from groma.problem.tied import Divided, with_tied_apart

#: Factors per chunk where no variable shares a factor with another: what has converged is left alone, chunk by chunk.
#: Those that follow each other are done together (cost: time alone).
CHUNK_ALONE = 512


def lay_out(problem: Problem, eliminate: str | tuple[str, ...] = "auto", chunk_size: int = CHUNK_SIZE) -> Layout:
    """Choose the eliminated groups, sort the factors and find the blocks of the reduced system."""
    warnings: list[str] = []
    landmarks = choose_landmarks(problem, eliminate, warnings)
    kept, member_of = kept_classes(problem, landmarks)
    tables = {(a, b): PairTable(kept[a].count, kept[b].count) for a in range(len(kept)) for b in range(a, len(kept))}
    for c, kept_class in enumerate(kept):
        diagonal = np.arange(kept_class.count, dtype=np.int32)
        tables[c, c].add_list(diagonal, diagonal)
    drafts = [Draft(problem, n, landmarks, member_of, kept) for n, factor in enumerate(problem.factors) if len(factor)]
    drafts = [draft for draft in drafts if draft.is_free]
    orders = {group: _landmark_order(problem, group, drafts, kept) for group in landmarks}
    for draft in drafts:
        draft.sort(orders)
    layouts = [draft.finish(tables, landmarks) for draft in drafts]
    num_direct = {pair: table.count for pair, table in tables.items()}
    eliminated = []
    for e, group in enumerate(landmarks):
        eliminated.append(_incidences(problem, group, e, orders[group][0], layouts, kept, tables))
    blocks = {pair: table.pairs() for pair, table in tables.items() if table.count}
    chunks = _chunks(layouts, eliminated, chunk_size if kept else min(chunk_size, CHUNK_ALONE))
    return Layout(
        problem, kept, tuple(eliminated), tuple(layouts), chunks, blocks, {p: num_direct[p] for p in blocks}, warnings
    )


class Layouts:
    """The last layout, for problems that are solved again at other states or under other losses."""

    def __init__(self) -> None:
        self._last: tuple[Problem, Layout, str | tuple[str, ...]] | None = None

    def of(self, problem: Problem, eliminate: str | tuple[str, ...] = "auto") -> tuple[Divided, Layout]:
        """Return the problem with its tied landmarks apart, and the layout of that."""
        last, self._last = self._last, None  # its memory is free for the next one
        parts = with_tied_apart(problem, eliminate)
        if last is not None and last[2] == eliminate and problem.has_structure_of(last[0]):
            layout = _of_problem(last[1], parts.problem)
        else:
            last = None
            layout = lay_out(parts.problem, eliminate)
        self._last = problem, layout, eliminate
        return parts, layout


def landmarks_kept(layout: Layout) -> list[str]:
    """Return the groups of landmarks in the reduced system of which no factor couples two."""
    variables = layout.problem.variables
    names = [member.group for kept in layout.kept for member in kept.members]
    return [
        name
        for name in names
        if variables[name].manifold.kind in LANDMARK_KINDS and not couplings(layout.problem, {name})
    ]


def lay_out_landmarks(layout: Layout, groups: tuple[str, ...]) -> Layout:
    """Return the layout of the same problem in which only these groups move: each of their landmarks on its own."""
    if groups not in layout.of_landmarks:
        problem = layout.problem
        held = {
            name: group if name in groups else dataclasses.replace(group, constant=True)
            for name, group in problem.variables.items()
        }
        numbers = tuple(
            number
            for number, factor in enumerate(problem.factors)
            if any(ref.group in groups for _, ref in factor.references())
        )
        alone = Problem(held, [problem.factors[number] for number in numbers])
        layout.of_landmarks[groups] = lay_out(alone, groups), numbers
    return layout.of_landmarks[groups][0]


def _of_problem(layout: Layout, problem: Problem) -> Layout:
    """Return a layout for a problem of the same structure."""
    factors = tuple(
        dataclasses.replace(one, factor=under_loss(one.factor, problem.factors[one.number].loss))
        for one in layout.factors
    )
    of_landmarks = {}
    for groups, (inner, numbers) in layout.of_landmarks.items():
        alone = inner.problem.with_losses([problem.factors[number].loss for number in numbers])
        of_landmarks[groups] = _of_problem(inner, alone), numbers
    return dataclasses.replace(layout, problem=problem, factors=factors, of_landmarks=of_landmarks)


def _landmark_order(
    problem: Problem, group: str, drafts: list[Draft], kept: Sequence[KeptClass]
) -> tuple[IntArray, IntArray]:
    """Return the original index at each position, and the position of each index, sorted by the kept blocks seen."""
    count = len(problem.variables[group])
    mine = [draft for draft in drafts if draft.landmark_group == group and draft.entries]
    if not mine:
        identity = np.arange(count, dtype=np.int32)
        return identity, identity
    num_blocks = max(kept[draft.entries[0][0]].count for draft in mine)
    indices = [draft.factor.references()[draft.landmark_reference][1].index for draft in mine]
    blocks = [draft.entries[0][1] for draft in mine]
    first, last = first_and_last(_joined(indices), _joined(blocks), count, num_blocks)
    order = argsort_by(((first, num_blocks), (last, num_blocks)), count)
    position = np.empty(count, np.int32)
    position[order] = np.arange(count, dtype=np.int32)
    return order, position


def _joined(parts: list[IntArray]) -> IntArray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _incidences(
    problem: Problem, group: str, e: int, order: IntArray, layouts: list[FactorLayout], kept: Sequence[KeptClass],
    tables: dict[tuple[int, int], PairTable],
) -> Eliminated:  # fmt: skip
    """Find the landmark-block pairs of one eliminated group and number the pairs of the reduced system they fill.

    ``layouts`` get the numbers of these pairs, ``tables`` the pairs of kept blocks that share a landmark.
    """
    count = len(problem.variables[group])
    incidences: dict[int, Incidences] = {}
    for c, kept_class in enumerate(kept):
        uses = [
            (f, k) for f, layout in enumerate(layouts) if layout.eliminated == e
            for k, entry in enumerate(layout.kept) if entry.kept_class == c
        ]  # fmt: skip
        if not uses:
            continue
        landmark = _joined([layouts[f].landmark for f, _ in uses])
        block = _joined([layouts[f].kept[k].block for f, k in uses])
        if len(uses) == 1 and uses[0][1] == 0:  # the order in which factors are sorted
            slot, pointer, block_of_slot = distinct_pairs(landmark, block, count)
        else:
            order_of = argsort_by(((landmark, count), (block, kept_class.count)), len(landmark))
            sorted_pairs = landmark.take(order_of), block.take(order_of)
            slot_sorted, pointer, block_of_slot = distinct_pairs(*sorted_pairs, count)
            slot = np.empty(len(landmark), np.int32)
            slot[order_of] = slot_sorted
        pair_slots, pair_pointer = tables[c, c].add_pairs(pointer, block_of_slot)
        incidences[c] = Incidences(pointer, block_of_slot, pair_slots, pair_pointer)
        offset = 0
        for f, k in uses:
            n = len(layouts[f].factor)
            entry = dataclasses.replace(layouts[f].kept[k], incidence=slot[offset : offset + n])
            entries = (*layouts[f].kept[:k], entry, *layouts[f].kept[k + 1 :])
            layouts[f] = dataclasses.replace(layouts[f], kept=entries)
            offset += n
    cross = {}
    for a in incidences:
        for b in incidences:
            if a < b:
                first, second = incidences[a], incidences[b]
                slots, pointer = tables[a, b].add_cross(first.pointer, first.block, second.pointer, second.block)
                if len(slots):  # no landmark may touch both classes; the pair then has no blocks
                    cross[a, b] = slots, pointer
    return Eliminated(group, problem.variables[group].manifold.dof, count, order, incidences, cross)


def _chunks(layouts: list[FactorLayout], eliminated: list[Eliminated], chunk_size: int) -> tuple[Chunk, ...]:
    """Cut the work into chunks of about ``chunk_size`` factors."""
    chunks = []
    for e, group in enumerate(eliminated):
        mine = [f for f, layout in enumerate(layouts) if layout.eliminated == e]
        starts = [pointers_of(np.bincount(layouts[f].landmark, minlength=group.count)) for f in mine]
        total = sum(starts, np.zeros(group.count + 1, np.int64))
        begin = 0
        while begin < group.count:
            end = int(np.searchsorted(total, total[begin] + chunk_size, side="right")) - 1
            end = min(max(end, begin + 1), group.count)
            parts = tuple((f, int(s[begin]), int(s[end])) for f, s in zip(mine, starts, strict=True))
            chunks.append(Chunk(e, begin, end, parts, int(total[end] - total[begin])))
            begin = end
    for f, layout in enumerate(layouts):
        if layout.eliminated is None:
            for begin in range(0, len(layout.factor), chunk_size):
                end = min(begin + chunk_size, len(layout.factor))
                chunks.append(Chunk(None, 0, 0, ((f, begin, end),), end - begin))
    return tuple(chunks)
