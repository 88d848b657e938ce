# SPDX-License-Identifier: BSD-3-Clause
r"""A least-squares problem: groups of variables and groups of factors.

The cost is :math:`\\tfrac12 \\sum_i \\rho_i(\\lVert \\Sigma_i^{-1/2} r_i \\rVert^2)` over all factors.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from groma._typing import FloatArray
from groma.errors import ProblemError, check_kind
from groma.factors.contract import Factor
from groma.factors.losses import Loss
from groma.problem._numbers import refuse_unusable_numbers
from groma.problem.variables import Variables

#: Kinds of variables that are plain numbers; a slot of kind ``vector`` takes any of them.
PLAIN_KINDS = ("vector", "intrinsics", "point")


@dataclass(frozen=True, init=False)
class Problem:
    """Variables by group name, and the factors between them."""

    variables: Mapping[str, Variables]
    factors: tuple[Factor, ...]

    def __init__(self, variables: Mapping[str, Variables], factors: Iterable[Factor]) -> None:
        check_kind(variables, Mapping, "variables", "Name the groups: {'points': groma.Variables(manifold, state)}.")
        object.__setattr__(self, "variables", dict(variables))
        object.__setattr__(self, "factors", tuple(factors))
        for factor in self.factors:
            self._check(factor)
            refuse_unusable_numbers(factor, self.variables)

    def _check(self, factor: Factor) -> None:
        """Check that every reference of a factor meets an existing variable of the right kind."""
        name = factor.type_name or type(factor).__name__
        for slot, ref in factor.references():
            if ref.group not in self.variables:
                raise ProblemError(
                    f"Factor {name!r} refers to the group {ref.group!r} in its slot {slot.name!r}; "
                    f"the problem has the groups {sorted(self.variables)}."
                )
            variables = self.variables[ref.group]
            takes = PLAIN_KINDS if slot.kind == "vector" else (slot.kind,)
            if variables.manifold.kind not in takes:
                raise ProblemError(
                    f"Slot {slot.name!r} of factor {name!r} takes variables of kind {' or '.join(takes)}; "
                    f"group {ref.group!r} holds {variables.manifold.kind!r}."
                )
            if len(ref.index) != len(factor):
                raise ProblemError(
                    f"Slot {slot.name!r} of factor {name!r} has {len(ref.index)} indices for {len(factor)} factors."
                )
            if len(ref.index) and (ref.index.min() < 0 or ref.index.max() >= len(variables)):
                bad = int(np.flatnonzero((ref.index < 0) | (ref.index >= len(variables)))[0])
                raise ProblemError(
                    f"Factor {bad} of {name!r} refers to variable {int(ref.index[bad])} of group {ref.group!r}, "
                    f"which has {len(variables)} (0 to {len(variables) - 1}). Drop it or add the variable."
                )

    def with_states(self, states: Mapping[str, FloatArray]) -> Problem:
        """Return the same problem at other states; groups that are not named keep theirs."""
        variables = {
            name: group if states.get(name, group.state) is group.state else group.with_state(states[name])
            for name, group in self.variables.items()
        }
        if any(len(group) != len(self.variables[name]) for name, group in variables.items()):
            return Problem(variables, self.factors)
        moved = copy.copy(self)  # the checks hold for other states, too
        object.__setattr__(moved, "variables", variables)
        return moved

    def with_losses(self, losses: Sequence[Loss]) -> Problem:
        """Return the same problem with other losses, one for each group of factors."""
        other = copy.copy(self)  # the checks do not concern losses
        object.__setattr__(other, "factors", tuple(map(under_loss, self.factors, losses)))
        return other

    def has_structure_of(self, other: Problem) -> bool:
        """Whether another problem differs in nothing but states and losses, as those made from one another do."""
        groups, others = self.variables, other.variables
        return (
            list(groups) == list(others)
            and all(_moves_alike(group, others[name]) for name, group in groups.items())
            and len(self.factors) == len(other.factors)
            and all(map(_differ_by_loss, self.factors, other.factors))
        )

    @property
    def num_residuals(self) -> int:
        """Total number of independent residual rows."""
        return sum(len(factor) * factor.residual_rank for factor in self.factors)


def under_loss(factor: Factor, loss: Loss) -> Factor:
    """Return a group of factors with another loss; the rest of it is the same objects."""
    if factor.loss == loss:
        return factor
    other = copy.copy(factor)
    object.__setattr__(other, "loss", loss)
    return other


def _moves_alike(group: Variables, other: Variables) -> bool:
    return len(group) == len(other) and group.manifold is other.manifold and group.constant is other.constant


def _differ_by_loss(factor: Factor, other: Factor) -> bool:
    if type(factor) is not type(other):
        return False
    names = (field.name for field in fields(factor) if field.name != "loss")
    return all(getattr(factor, name) is getattr(other, name) for name in names)
