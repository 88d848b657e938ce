# SPDX-License-Identifier: BSD-3-Clause
r"""The contract that every chart fulfils: how an object is stored, what factors read of it, how it moves.

A *manifold* describes one kind of variable. Three sizes belong to it:

``state_size``
    numbers stored per element (a pose: quaternion and translation, 7; a line in the orthonormal chart: 5).
``ambient_size``
    numbers that factors read (a pose: the 3x4 matrix, 12; a line: the Plücker vector, 6; a plane: (n, w), 4).
``dof``
    numbers of a minimal increment :math:`\delta` (a pose: 6; a line: 4; a plane: 3).

Factors differentiate with respect to the *factor coordinates* of a kind, never with respect to a chart: the ambient
numbers themselves, except for poses and similarities, where it is the left twist :math:`\xi` of
:math:`T_{cw} \leftarrow \mathrm{Exp}(\xi)\,T_{cw}`. A chart supplies the matrix :meth:`Manifold.basis`
:math:`B = \partial(\text{factor coordinates})/\partial\delta` at :math:`\delta = 0`; the chain
:math:`\partial r/\partial\delta = \partial r/\partial(\text{factor coordinates})\; B` joins any residual to any chart.

All methods are batched over the leading axis and change none of their arguments.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from groma._typing import FloatArray

#: Numbers read by factors, and columns of a factor's Jacobian, per kind. ``intrinsics`` and ``vector`` have any size.
AMBIENT_SIZE = {"pose": 12, "point": 3, "line": 6, "plane": 4, "direction": 3, "similarity": 8}
FACTOR_COLUMNS = {"pose": 6, "point": 3, "line": 6, "plane": 4, "direction": 3, "similarity": 7}


class Manifold(ABC):
    """One kind of variable in one chart."""

    #: Name of the chart, as options and files spell it, for example ``"cartesian"``.
    name: ClassVar[str]
    #: ``pose``, ``point``, ``line``, ``plane``, ``direction``, ``similarity``, ``intrinsics`` or ``vector``.
    kind: ClassVar[str]
    state_size: int
    ambient_size: int
    #: Columns of a factor's Jacobian for this kind (see :data:`FACTOR_COLUMNS`).
    factor_columns: int
    dof: int

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"

    @abstractmethod
    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Move states (N, state_size) by increments (N, dof); a zero increment changes nothing."""

    @abstractmethod
    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Return the increments (N, dof) that lead from one state to another; the inverse of :meth:`retract`."""

    @abstractmethod
    def ambient(self, state: FloatArray) -> FloatArray:
        """What factors read, (N, ambient_size)."""

    @abstractmethod
    def from_ambient(self, ambient: FloatArray) -> FloatArray:
        """State (N, state_size) of the given ambient numbers; ambient(from_ambient(a)) is the same object as a."""

    @abstractmethod
    def basis(self, state: FloatArray) -> FloatArray | None:
        """Derivative of the factor coordinates with respect to the increment, (N, factor_columns, dof).

        None stands for the identity.
        """

    @abstractmethod
    def random(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Valid states (count, state_size) in general position, for conformance tests and examples."""


class Euclidean(Manifold):
    """Plain numbers: points, intrinsics, any vector. retract(x, d) = x + d."""

    name: ClassVar[str] = "euclidean"

    def __init__(self, size: int, kind: str = "vector") -> None:
        self.kind = kind  # type: ignore[misc]
        self.state_size = self.ambient_size = self.factor_columns = self.dof = size

    def __repr__(self) -> str:
        return f"Euclidean({self.dof}, {self.kind!r})"

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Return the sum."""
        return state + delta

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Return the difference."""
        return other - state

    def ambient(self, state: FloatArray) -> FloatArray:
        """Return the state itself."""
        return state

    def from_ambient(self, ambient: FloatArray) -> FloatArray:
        """Return the coordinates themselves."""
        return ambient

    def basis(self, state: FloatArray) -> None:
        """Return None: the derivative is the identity."""
        return None

    def random(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Return standard normal states."""
        return rng.normal(size=(count, self.dof))
