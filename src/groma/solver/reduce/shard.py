# SPDX-License-Identifier: BSD-3-Clause
"""One shard: landmarks with all their factors, and which shards stay in memory from one visit to the next."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np

from groma.factors.contract import Factor
from groma.problem.lay_out import lay_out
from groma.problem.layout import Layout
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.solver.steps import States


@dataclass(frozen=True)
class Shard:
    """Landmarks with all their factors."""

    #: Rows of each group of landmarks that are in this shard.
    landmarks: Mapping[str, slice]
    #: Makes the factors, for example from memory-mapped files. References to landmarks count from the first row of the
    #: shard, all others from the first of their group.
    factors: Callable[[], Sequence[Factor]]


@dataclass(frozen=True)
class OpenShard:
    """A shard laid out, and how many factors and residuals it has."""

    layout: Layout
    num_factors: int
    num_residuals: int


class Shelf:
    """Opens shards, and keeps as many of them as there is room for.

    A shard that is kept is neither read nor laid out again. What is kept is its layout: some hundred bytes for an
    observation. Its normal equations take several times as much, and are formed anew at every visit.

    Parameters
    ----------
    variables
        All variables of this process.
    room
        Bytes that may be used.
    """

    def __init__(self, variables: Mapping[str, Variables], room: float) -> None:
        self._variables, self._room = variables, room
        self._kept: dict[int, OpenShard] = {}

    def open(self, shard: Shard, states: States) -> OpenShard:
        """Return a shard as a separate problem, laid out at given states."""
        known = self._kept.get(id(shard))
        if known is not None:
            problem = known.layout.problem.with_states(self._states_of(shard, states))
            return replace(known, layout=replace(known.layout, problem=problem))
        problem = self._problem(shard, states)
        layout = lay_out(problem, tuple(shard.landmarks))
        opened = OpenShard(layout, sum(map(len, problem.factors)), problem.num_residuals)
        if self._room > 0:
            without = replace(layout, problem=Problem(problem.variables, ()))  # sorted copies are in the layout
            size = num_bytes((without.kept, without.eliminated, without.factors, without.blocks))
            if size <= self._room:
                self._room -= size
                self._kept[id(shard)] = replace(opened, layout=without)
        return opened

    def _states_of(self, shard: Shard, states: States) -> States:
        return {name: state[shard.landmarks.get(name, slice(None))] for name, state in states.items()}

    def _problem(self, shard: Shard, states: States) -> Problem:
        own = self._states_of(shard, states)
        groups = {}
        for name, state in own.items():
            group, rows = self._variables[name], shard.landmarks.get(name, slice(None))
            constant = group.constant if isinstance(group.constant, bool | np.bool_) else group.constant[rows]
            groups[name] = Variables(group.manifold, state, constant)
        return Problem(groups, shard.factors())


def num_bytes(value: Any) -> int:
    """Return how much memory the arrays in a value take, those of dataclasses and containers included."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, Mapping):
        return sum(map(num_bytes, value.values()))
    if isinstance(value, tuple | list):
        return sum(map(num_bytes, value))
    if is_dataclass(value) and not isinstance(value, type):
        return sum(num_bytes(getattr(value, item.name)) for item in fields(value))
    return 0
