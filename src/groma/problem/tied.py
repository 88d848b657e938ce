# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks that factors tie to other landmarks, apart from the rest of their group.

Of two landmarks that a factor couples only one can be eliminated. In comes a problem; out comes the same one in which
the few that must stay in the reduced system form a group of their own, so that all others are eliminated; and the way
back, from what is found for the parts of a group to the whole of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import check_kind
from groma.factors.contract import Factor, Ref
from groma.problem._partition import LANDMARK_KINDS, free_groups
from groma.problem.problem import Problem
from groma.problem.variables import Variables


@dataclass(frozen=True)
class Tied:
    """Which variables of a group were taken out of it."""

    group: str
    #: (count,)
    is_tied: BoolArray

    @property
    def name(self) -> str:
        """The group that holds them."""
        return f"tied {self.group}"

    def divide(self, problem: Problem) -> Problem:
        """Return the problem with the tied variables in a group of their own."""
        variables, whole = dict(problem.variables), problem.variables[self.group]
        for name, mine in ((self.group, ~self.is_tied), (self.name, self.is_tied)):
            constant = whole.constant if isinstance(whole.constant, bool | np.bool_) else whole.constant[mine]
            variables[name] = Variables(whole.manifold, whole.state[mine], constant)
        return Problem(variables, [part for factor in problem.factors for part in self._parts(factor)])

    def _parts(self, factor: Factor) -> list[Factor]:
        """A factor that refers to the group, cut in two: no factor refers to variables of both kinds."""
        slots = [slot.name for slot, ref in factor.references() if ref.group == self.group]
        if not slots:
            return [factor]
        row = np.where(self.is_tied, np.cumsum(self.is_tied), np.cumsum(~self.is_tied)) - 1
        tied = self.is_tied[getattr(factor, slots[0]).index]
        parts = []
        for name, mine in ((self.group, ~tied), (self.name, tied)):
            part = factor if mine.all() else factor.take(np.flatnonzero(mine))
            refs = {slot: Ref(name, row[getattr(part, slot).index]) for slot in slots}
            parts += [replace(part, **refs)] if len(part) else []
        return parts

    def join(self, values: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return values, such as states, of the variables of the divided problem as those of the whole one."""
        whole = np.empty((len(self.is_tied), *values[self.group].shape[1:]))
        whole[~self.is_tied], whole[self.is_tied] = values[self.group], values[self.name]
        return {**{name: value for name, value in values.items() if name != self.name}, self.group: whole}


@dataclass(frozen=True)
class Divided:
    """A problem in which tied landmarks are groups of their own."""

    problem: Problem
    tied: tuple[Tied, ...]

    def parts(self, group: str) -> list[tuple[str, IntArray]]:
        """Return the groups that hold the variables of a group of the whole, and which of its rows each has."""
        for tied in self.tied:
            if tied.group == group:
                return [(group, np.flatnonzero(~tied.is_tied)), (tied.name, np.flatnonzero(tied.is_tied))]
        return [(group, np.arange(len(self.problem.variables[group])))]

    def places(self, group: str, index: IntArray) -> Iterator[tuple[IntArray, str, IntArray]]:
        """Yield for each part of a group: which variables of ``index`` it holds, its name, their rows in it."""
        for name, mine in self.parts(group):
            at = np.flatnonzero(np.isin(index, mine))
            if len(at):
                yield at, name, np.searchsorted(mine, index[at])

    def whole(self, group: str, row: int) -> tuple[str, int]:
        """Return the group and the row of a variable in the whole problem."""
        for tied in self.tied:
            if group in (tied.group, tied.name):
                return tied.group, int(np.flatnonzero(tied.is_tied == (group == tied.name))[row])
        return group, row

    def divide(self, values: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return values of the variables of the whole problem as those of the divided one."""
        return {name: value[mine] for group, value in values.items() for name, mine in self.parts(group)}

    def join(self, values: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return values of the variables of the divided problem as those of the whole one."""
        return reduce(lambda parts, tied: tied.join(parts), self.tied, dict(values))


def with_tied_apart(problem: Problem, eliminate: str | tuple[str, ...] = "auto") -> Divided:
    """Return the problem with the landmarks that must be kept apart; as it is where it is said what to eliminate."""
    check_kind(problem, Problem, "problem", "Make one: groma.Problem(variables, factors).")
    tied = find_tied(problem) if eliminate == "auto" else []
    return Divided(reduce(lambda whole, group: group.divide(whole), tied, problem), tuple(tied))


def find_tied(problem: Problem) -> list[Tied]:
    """Return what must be divided for all but the tied landmarks to be eliminated: of coupled groups the one with fewer
    tied variables, unless all of it are.
    """
    landmarks = {name for name in free_groups(problem) if problem.variables[name].manifold.kind in LANDMARK_KINDS}
    couplings: list[dict[str, list[IntArray]]] = []
    for factor in problem.factors:
        touched = [ref for _, ref in factor.references() if ref.group in landmarks]
        if len(factor) and len(touched) > 1:
            couplings.append({ref.group: [r.index for r in touched if r.group == ref.group] for ref in touched})
    tied = {
        name: np.unique(np.concatenate([index for coupled in couplings for index in coupled.get(name, [])]))
        for name in {name for coupled in couplings for name in coupled}
    }
    kept: set[str] = set()
    for coupled in sorted(couplings, key=len):  # those within one group first: they leave no choice
        if not kept & coupled.keys():
            kept.add(min(sorted(coupled), key=lambda name: len(tied[name])))
    masks = {name: np.isin(np.arange(len(problem.variables[name])), tied[name]) for name in sorted(kept)}
    return [Tied(name, mask) for name, mask in masks.items() if not mask.all()]
