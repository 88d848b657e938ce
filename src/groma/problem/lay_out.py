# SPDX-License-Identifier: BSD-3-Clause
"""From a problem to its layout: what is eliminated, what is kept, and in which order everything lies.

The steps of :func:`lay_out`, in order: choose the landmarks, form classes of kept blocks, draft the records of every
factor group, sort landmarks and factors, number the blocks of the reduced system, and cut the work into chunks.
"""

from __future__ import annotations

import copy
import dataclasses
from functools import cached_property

import numpy as np

from groma._typing import IntArray
from groma.errors import ProblemError
from groma.factors._factor import Factor, Ref
from groma.problem._sorting import PairTable, argsort_by, distinct_pairs, first_and_last
from groma.problem.layout import (
    Chain,
    Chunk,
    Eliminated,
    FactorLayout,
    Incidences,
    KeptClass,
    KeptEntry,
    Layout,
    Member,
)
from groma.problem.problem import Problem

#: Factors per chunk: their records (a few hundred bytes each) should fit the second-level cache.
CHUNK_SIZE = 4096
#: Kinds of variables that are eliminated where possible.
LANDMARK_KINDS = ("point", "line")
#: Largest number of variables that may be moved to the reduced system without being asked.
MAX_KEPT_LANDMARKS = 4000


def lay_out(problem: Problem, eliminate: str | tuple[str, ...] = "auto", chunk_size: int = CHUNK_SIZE) -> Layout:
    """Choose what is eliminated, sort the factors and find the blocks of the reduced system."""
    warnings: list[str] = []
    landmarks = _choose_landmarks(problem, eliminate, warnings)
    kept, member_of = _kept_classes(problem, landmarks)
    tables = {(a, b): PairTable(kept[a].count, kept[b].count) for a in range(len(kept)) for b in range(a, len(kept))}
    for c, kept_class in enumerate(kept):
        diagonal = np.arange(kept_class.count, dtype=np.int32)
        tables[c, c].add_list(diagonal, diagonal)
    drafts = [_Draft(problem, factor, landmarks, member_of, kept) for factor in problem.factors if len(factor)]
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
    chunks = _chunks(layouts, eliminated, chunk_size)
    return Layout(
        problem, kept, tuple(eliminated), tuple(layouts), chunks, blocks, {p: num_direct[p] for p in blocks}, warnings
    )


# ---------------------------------------------------------------------------------------------- what is eliminated


def _free_groups(problem: Problem) -> list[str]:
    used = {ref.group for factor in problem.factors if len(factor) for _, ref in factor.references()}
    return [name for name, group in problem.variables.items() if name in used and not group.is_constant]


def _couplings(problem: Problem, groups: set[str]) -> list[tuple[str, str, str]]:
    """Return (factor, group, group) for every factor type that touches two variables of the given groups."""
    found = []
    for factor in problem.factors:
        if len(factor) == 0:
            continue
        touched = [ref.group for _, ref in factor.references() if ref.group in groups]
        if len(touched) > 1:
            found.append((factor.type_name, touched[0], touched[1]))
    return found


def _choose_landmarks(problem: Problem, eliminate: str | tuple[str, ...], warnings: list[str]) -> tuple[str, ...]:
    free = _free_groups(problem)
    if eliminate == "auto":
        if not _couplings(problem, set(free)):
            return tuple(free)  # nothing is coupled: every variable is a small problem of its own
        chosen = [name for name in free if problem.variables[name].manifold.kind in LANDMARK_KINDS]
        while coupled := _couplings(problem, set(chosen)):
            name, first, second = coupled[0]
            smaller = min(first, second, key=lambda group: len(problem.variables[group]))
            if len(problem.variables[smaller]) > MAX_KEPT_LANDMARKS:
                raise ProblemError(
                    f"Factor {name!r} couples the landmarks {first!r} and {second!r}; both cannot be eliminated, and "
                    f"{smaller!r} has {len(problem.variables[smaller])} variables, too many to keep in the reduced "
                    f"system unasked. Pass eliminate=({(set(chosen) - {smaller}).pop()!r},) if that is intended."
                )
            chosen.remove(smaller)
            warnings.append(
                f"Factor {name!r} couples {first!r} and {second!r}; {smaller!r} stays in the reduced system."
            )
        return tuple(chosen)
    groups = (eliminate,) if isinstance(eliminate, str) else tuple(eliminate)
    for name in groups:
        if name not in problem.variables:
            raise ProblemError(f"eliminate names {name!r}; the problem has the groups {sorted(problem.variables)}.")
    groups = tuple(name for name in groups if name in free)
    for name, first, second in _couplings(problem, set(groups)):
        rest = tuple(group for group in groups if group != second) or tuple(g for g in groups if g != first)
        raise ProblemError(
            f"Factor {name!r} couples two eliminated landmarks (groups {first!r} and {second!r}); their blocks are "
            f"then not independent. Keep one of them in the reduced system: eliminate={rest!r}."
        )
    return groups


# ------------------------------------------------------------------------------------------------------ kept blocks


def _private_intrinsics(problem: Problem, group: str, kept: list[str]) -> tuple[str, IntArray] | None:
    """Find a pose group that uses each variable of ``group`` in exactly one pose, one variable a pose."""
    partner: str | None = None
    uses: list[tuple[IntArray, IntArray]] = []
    for factor in problem.factors:
        refs = {slot.name: ref for slot, ref in factor.references()}
        mine = [ref for ref in refs.values() if ref.group == group]
        if not mine:
            continue
        if len(mine) > 1:
            return None
        poses = [
            ref for ref in refs.values() if ref.group in kept and problem.variables[ref.group].manifold.kind == "pose"
        ]
        if len(refs) > 1:
            if len(poses) != 1 or (partner is not None and poses[0].group != partner):
                return None
            partner = poses[0].group
            uses.append((mine[0].index, poses[0].index))
    count = len(problem.variables[group])
    if partner is None or len(problem.variables[partner]) != count:
        return None
    block_of = np.full(count, -1, np.int32)
    for index, pose in uses:
        block_of[index] = pose
    if any((block_of.take(index) != pose).any() for index, pose in uses):
        return None
    return (partner, block_of) if (np.sort(block_of) == np.arange(count)).all() else None


def _kept_classes(
    problem: Problem, landmarks: tuple[str, ...]
) -> tuple[tuple[KeptClass, ...], dict[str, tuple[int, int]]]:
    """Return the kept classes, and for each kept group its (class, member)."""
    kept = [name for name in _free_groups(problem) if name not in landmarks]
    rank = {"pose": 0, "intrinsics": 1}
    kept.sort(key=lambda name: rank.get(problem.variables[name].manifold.kind, 2))
    hosts: dict[str, list[tuple[str, IntArray]]] = {}
    guests = set()
    for name in kept:
        if problem.variables[name].manifold.kind == "intrinsics":
            found = _private_intrinsics(problem, name, kept)
            if found is not None:
                hosts.setdefault(found[0], []).append((name, found[1]))
                guests.add(name)
    classes: list[KeptClass] = []
    member_of: dict[str, tuple[int, int]] = {}
    start = 0
    for name in kept:
        if name in guests:
            continue
        dof = problem.variables[name].manifold.dof
        members = [Member(name, 0, dof)]
        for guest, block_of in hosts.get(name, []):
            guest_dof = problem.variables[guest].manifold.dof
            members.append(Member(guest, members[-1].offset + members[-1].dof, guest_dof, block_of))
        for m, member in enumerate(members):
            member_of[member.group] = (len(classes), m)
        width = members[-1].offset + members[-1].dof
        count = len(problem.variables[name])
        classes.append(KeptClass(width, count, tuple(members), start))
        start += width * count
    return tuple(classes), member_of


# ---------------------------------------------------------------------------------------------------------- factors


def _reordered(factor: Factor, order: IntArray, name: str, landmarks: Ref) -> Factor:
    """Return the factors ``order`` of a group, with other references in the slot ``name``.

    Rows that were checked once need not be checked again in another order. So no ``__post_init__`` runs, unless a
    factor derives something there.
    """
    fields = [field.name for field in dataclasses.fields(factor)]
    derived = [key for key in vars(factor) if key not in fields]
    plain = all(isinstance(getattr(type(factor), key, None), cached_property) for key in derived)
    if not plain or type(factor).take is not Factor.take:
        return dataclasses.replace(factor.take(order), **{name: landmarks})
    result = copy.copy(factor)
    for key in derived:
        del vars(result)[key]
    for key in fields:
        value = getattr(factor, key)
        if key == name:
            value = landmarks
        elif isinstance(value, Ref):
            value = Ref(value.group, value.index.take(order))
        elif isinstance(value, np.ndarray) and value.ndim > 0:
            same = key == "sqrt_information" and value.ndim == 1 and (value == value[0]).all()
            value = float(value[0]) if same else value.take(order, axis=0)
        object.__setattr__(result, key, value)
    return result


class _Draft:
    """A factor group on its way to a :class:`FactorLayout`."""

    def __init__(self, problem, factor, landmarks, member_of, kept) -> None:
        self.factor: Factor = factor
        references = factor.references()
        columns, chains, masked = [], [], []
        entries: list[tuple[int, IntArray, int]] = []  # class, block of each factor, column
        self.landmark_group: str | None = None
        self.landmark_reference = -1
        self.landmark_column = -1
        column = 0
        placed: list[int] = []
        for _slot, ref in references:  # kept blocks come first
            if ref.group not in member_of:
                placed.append(-1)
                continue
            c, m = member_of[ref.group]
            member = kept[c].members[m]
            block = member.blocks(ref.index)
            for known_class, known_block, known_column in entries:
                taken = [p for p in placed if known_column <= p < known_column + kept[c].width]
                if known_class == c and known_column + member.offset not in taken and (known_block == block).all():
                    placed.append(known_column + member.offset)
                    break
            else:
                entries.append((c, np.ascontiguousarray(block, np.int32), column))
                placed.append(column + member.offset)
                column += kept[c].width
        for r, (_, ref) in enumerate(references):
            if ref.group in landmarks:
                self.landmark_group, self.landmark_reference, self.landmark_column = ref.group, r, column
                placed[r] = column
                column += problem.variables[ref.group].manifold.dof
        for r, (_, ref) in enumerate(references):
            group = problem.variables[ref.group]
            if placed[r] < 0:
                columns.append(-1)
                continue
            if group.manifold.basis(group.state[:1]) is None:
                columns.append(placed[r])
            else:
                raw = group.manifold.factor_columns
                chains.append(Chain(r, column, raw, placed[r], group.manifold.dof))
                columns.append(column)
                column += raw
            if group.free_coordinates() is not None:
                masked.append((r, placed[r], group.manifold.dof))
        self.columns, self.chains, self.masked = tuple(columns), tuple(chains), tuple(masked)
        self.entries, self.width = entries, column + 1
        written = sum(
            problem.variables[ref.group].manifold.dof
            for (_, ref), start in zip(references, placed, strict=True)
            if start >= 0
        )
        self.has_gaps = written + sum(chain.raw_size for chain in chains) < column
        self.is_free = bool(entries) or self.landmark_group is not None
        self.kept = kept

    def sort(self, orders) -> None:
        """Sort by landmark and kept block, and renumber the landmarks by their position."""
        if self.landmark_group is None:
            self.landmark = np.zeros(0, np.int32)
            return
        _, position = orders[self.landmark_group]
        references = self.factor.references()
        slot, ref = references[self.landmark_reference]
        landmark = position.take(ref.index)
        keys = [(landmark, len(position))]
        if self.entries:
            c, block, _ = self.entries[0]
            keys.append((block, self.kept[c].count))
        order = argsort_by(tuple(keys), len(landmark))
        self.landmark = landmark.take(order)
        self.factor = _reordered(self.factor, order, slot.name, Ref(ref.group, self.landmark))
        sorted_index = {
            id(ref.index): moved.index
            for (_, ref), (_, moved) in zip(references, self.factor.references(), strict=True)
        }
        self.entries = [
            (c, sorted_index[id(block)] if id(block) in sorted_index else block.take(order), column)
            for c, block, column in self.entries
        ]

    def finish(self, tables: dict[tuple[int, int], PairTable], landmarks: tuple[str, ...]) -> FactorLayout:
        """Number the blocks of the reduced system that these factors touch directly."""
        crosses = []
        for i, (class_i, block_i, _) in enumerate(self.entries):
            for j in range(i + 1, len(self.entries)):
                class_j, block_j, _ = self.entries[j]
                if class_i < class_j:
                    crosses.append((i, j, tables[class_i, class_j].add_list(block_i, block_j)))
                elif class_i > class_j:
                    crosses.append((j, i, tables[class_j, class_i].add_list(block_j, block_i)))
                else:
                    low, high = np.minimum(block_i, block_j), np.maximum(block_i, block_j)
                    crosses.append((i, j, tables[class_i, class_i].add_list(low, high)))
        return FactorLayout(
            factor=self.factor,
            columns=self.columns,
            width=self.width,
            has_gaps=self.has_gaps,
            chains=self.chains,
            masked=self.masked,
            kept=tuple(KeptEntry(c, column, block) for c, block, column in self.entries),
            crosses=tuple(crosses),
            eliminated=None if self.landmark_group is None else landmarks.index(self.landmark_group),
            landmark_column=self.landmark_column,
            landmark=self.landmark,
        )


def _landmark_order(problem, group: str, drafts: list[_Draft], kept) -> tuple[IntArray, IntArray]:
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


def _incidences(problem, group, e, order, layouts: list[FactorLayout], kept, tables) -> Eliminated:
    """Find the landmark-block pairs of one eliminated group and number the pairs of the reduced system they fill."""
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
        starts = [np.searchsorted(layouts[f].landmark, np.arange(group.count + 1)) for f in mine]
        total = np.sum([np.zeros(group.count + 1, np.int64), *starts], axis=0)
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
