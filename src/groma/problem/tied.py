# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks that factors tie to other landmarks, apart from the rest of their group.

Of two landmarks that a factor couples only one can be eliminated. In comes a problem; out comes the same one in which
the few that must stay in the reduced system form a group of their own, so that all others are eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
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

    def join(self, states: dict[str, FloatArray]) -> dict[str, FloatArray]:
        """Return states of the divided problem as those of the whole one."""
        whole = np.empty((len(self.is_tied), states[self.group].shape[1]))
        whole[~self.is_tied], whole[self.is_tied] = states[self.group], states[self.name]
        return {**{name: state for name, state in states.items() if name != self.name}, self.group: whole}


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
