# SPDX-License-Identifier: BSD-3-Clause
"""A factor group on its way into a layout: where its blocks lie in a record, and in which order its factors are.

A record is ``[kept blocks | landmark | raw columns of charts | residual]``; blocks of one class that belong to the same
variable of the reduced system share their columns.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from functools import cache, cached_property

import numpy as np

from groma._typing import IntArray
from groma.factors.contract import Factor, Ref
from groma.problem.layout import Chain, FactorLayout, KeptClass, KeptEntry
from groma.problem.problem import Problem
from groma.problem.sorting import PairTable, argsort_by


def _reordered(factor: Factor, order: IntArray, name: str, landmarks: Ref) -> Factor:
    """Return the factors ``order`` of a group, with other references in the slot ``name``.

    Rows that were checked once need not be checked again in another order. So no ``__post_init__`` runs, unless a
    factor derives something there.
    """
    fields = _field_names(type(factor))
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


@cache
def _field_names(kind: type[Factor]) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind))


class Draft:
    """A factor group on its way to a :class:`FactorLayout`.

    Parameters
    ----------
    problem, number
        The problem with its variables, and the number of the group among its factors.
    landmarks
        The groups of variables that are eliminated.
    member_of, kept
        Class and member of each kept group, and the classes.
    """

    def __init__(
        self,
        problem: Problem,
        number: int,
        landmarks: tuple[str, ...],
        member_of: Mapping[str, tuple[int, int]],
        kept: tuple[KeptClass, ...],
    ) -> None:
        self.factor, self.number = problem.factors[number], number
        self.kept = kept
        #: Class, block of each factor and first column of each kept block.
        self.entries: list[tuple[int, IntArray, int]] = []
        self.landmark_group: str | None = None
        self.landmark_reference = self.landmark_column = -1
        placed = self._place(problem, landmarks, member_of)
        self._add_raw_columns(problem, placed)
        self.is_free = bool(self.entries) or self.landmark_group is not None

    def _place(
        self, problem: Problem, landmarks: tuple[str, ...], member_of: Mapping[str, tuple[int, int]]
    ) -> list[int]:
        """Return the first column of each reference's increments, -1 where it is constant: kept blocks come first."""
        placed: list[int] = []
        column = 0
        references = self.factor.references()
        for _slot, ref in references:
            if ref.group not in member_of:
                placed.append(-1)
                continue
            c, m = member_of[ref.group]
            member = self.kept[c].members[m]
            block = member.blocks(ref.index)
            for known_class, known_block, known_column in self.entries:
                taken = [p for p in placed if known_column <= p < known_column + self.kept[c].width]
                if known_class == c and known_column + member.offset not in taken and (known_block == block).all():
                    placed.append(known_column + member.offset)
                    break
            else:
                self.entries.append((c, np.ascontiguousarray(block, np.int32), column))
                placed.append(column + member.offset)
                column += self.kept[c].width
        for r, (_, ref) in enumerate(references):
            if ref.group in landmarks:
                self.landmark_group, self.landmark_reference, self.landmark_column = ref.group, r, column
                placed[r] = column
                column += problem.variables[ref.group].manifold.dof
        self.width = column + 1
        return placed

    def _add_raw_columns(self, problem: Problem, placed: list[int]) -> None:
        """Make room for what charts turn into increments, and note the coordinates that are held constant."""
        columns, chains, masked, written = [], [], [], 0
        column = self.width - 1
        for r, (_, ref) in enumerate(self.factor.references()):
            group = problem.variables[ref.group]
            if placed[r] < 0:
                columns.append(-1)
                continue
            written += group.manifold.dof
            if group.manifold.basis(group.state[:1]) is None:
                columns.append(placed[r])
            else:
                raw = group.manifold.factor_columns
                chains.append(Chain(r, column, raw, placed[r], group.manifold.dof))
                columns.append(column)
                column += raw
                written += raw
            if group.free_coordinates() is not None:
                masked.append((r, placed[r], group.manifold.dof))
        self.columns, self.chains, self.masked = tuple(columns), tuple(chains), tuple(masked)
        self.width = column + 1
        self.has_gaps = written < column

    def sort(self, orders: Mapping[str, tuple[IntArray, IntArray]]) -> None:
        """Sort by landmark and kept block, and renumber the landmarks by their position."""
        if self.landmark_group is None:
            self.landmark = np.zeros(0, np.int32)
            return
        _, position = orders[self.landmark_group]
        references = self.factor.references()
        slot, ref = references[self.landmark_reference]
        landmark = position.take(ref.index)
        if len(position) == 1 and not self.entries:  # nothing to sort by
            self.landmark = landmark
            return
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
            number=self.number,
        )
