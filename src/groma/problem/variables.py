# SPDX-License-Identifier: BSD-3-Clause
"""Groups of equal variables: states in one array, one chart, and what is held constant."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.errors import ProblemError, ShapeError, check_kind
from groma.geometry.algebra import numbers
from groma.geometry.manifold import Manifold


@dataclass(frozen=True)
class Variables:
    """Variables of one kind in one chart."""

    #: The chart: how states are read by factors and how they move.
    manifold: Manifold
    #: (count, state_size) current states.
    state: FloatArray
    #: What does not move: False, True, (count,) booleans for whole variables, or (count, dof) for single coordinates
    #: of the increment.
    constant: bool | BoolArray = False

    def __post_init__(self) -> None:
        check_kind(self.manifold, Manifold, "manifold", "Pass a chart, such as groma.geometry.Euclidean(3, 'point').")
        state = np.ascontiguousarray(numbers(self.state, "state"))
        if state.ndim != 2 or state.shape[1] != self.manifold.state_size:
            raise ShapeError(
                f"Variables of {self.manifold!r} need a state of shape (count, {self.manifold.state_size}); "
                f"got {state.shape}. Convert with manifold.from_ambient()."
            )
        if not np.isfinite(state).all():
            bad = int(np.flatnonzero(~np.isfinite(state).all(axis=1))[0])
            raise ProblemError(
                f"The state of variable {bad} is not finite ({self.manifold.kind}): {state[bad].tolist()}. "
                "Remove or re-initialise it."
            )
        object.__setattr__(self, "state", state)
        if not isinstance(self.constant, bool | np.bool_):
            constant = np.asarray(self.constant, dtype=bool)
            allowed = {(len(state),), (len(state), self.manifold.dof)}
            if constant.shape not in allowed:
                raise ShapeError(f"`constant` must have one of the shapes {sorted(allowed)}; got {constant.shape}.")
            object.__setattr__(self, "constant", constant)

    def __len__(self) -> int:
        return len(self.state)

    @property
    def is_constant(self) -> bool:
        """Whether nothing in this group can move."""
        constant = self.constant if isinstance(self.constant, bool | np.bool_) else self.constant.all()
        return bool(constant) or len(self) == 0

    def free_coordinates(self) -> BoolArray | None:
        """Return (count, dof) booleans of the coordinates that may move; None if all may."""
        if isinstance(self.constant, bool | np.bool_):
            return np.zeros((len(self), self.manifold.dof), dtype=bool) if self.constant else None
        if not self.constant.any():
            return None
        constant = self.constant if self.constant.ndim == 2 else self.constant[:, None]
        return np.broadcast_to(~constant, (len(self), self.manifold.dof)).copy()

    @property
    def num_free(self) -> int:
        """How many coordinates may move."""
        free = self.free_coordinates()
        return len(self) * self.manifold.dof if free is None else int(free.sum())

    def ambient(self) -> FloatArray:
        """Return what factors read, (count, ambient_size); it is computed once, and not to be written to."""
        return self._ambient

    @cached_property
    def _ambient(self) -> FloatArray:
        return self.manifold.ambient(self.state)

    def held_kept(self, state: FloatArray) -> FloatArray:
        """Return what a solve found, with held variables as they were: a step of zero rounds those of unit length."""
        free = self.free_coordinates()
        return state if free is None else np.where(free.any(axis=1, keepdims=True), state, self.state)

    def with_state(self, state: FloatArray) -> Variables:
        """Return the same group at another state."""
        return dataclasses.replace(self, state=state)
