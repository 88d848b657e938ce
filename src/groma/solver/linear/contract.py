# SPDX-License-Identifier: BSD-3-Clause
"""What a solver of the reduced system S x = b offers, and the registry of such solvers.

A solver is made once per layout and called once per step. One may be added from outside::

    @register_linear_solver("mine")
    class Mine:
        def __init__(self, layout: Layout) -> None: ...

and chosen by its name, as ``SolverOptions(linear_solver="mine")``. ``auto`` takes the one that expects to be fastest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol, TypeVar

from groma._typing import FloatArray
from groma.errors import InputError
from groma.problem.layout import Layout
from groma.solver.linear.blocks import Blocks

#: A pivot of a factorisation below this fraction of its diagonal entry means a singular matrix.
PIVOT_TOLERANCE = 1e-13


class LinearSolver(Protocol):
    """Solves S x = b for the blocks of one layout. What takes long to prepare is prepared at the first solve."""

    @property
    def name(self) -> str:
        """What reports call it."""
        ...

    @property
    def num_iterations(self) -> int:
        """Iterations of the last solve; 0 for direct solvers."""
        ...

    @property
    def residual(self) -> list[FloatArray] | None:
        """Return b - S x of the last solve by class, flat; None for direct solvers."""
        ...

    def expected_seconds(self) -> float:
        """Return how long a solve should take; infinite for a solver that ``auto`` should not take."""
        ...

    def follow(self, states: Mapping[str, FloatArray]) -> None:
        """Take notice of the states at which the next systems are formed."""
        ...

    def solve(self, blocks: Blocks, rhs: list[FloatArray]) -> list[FloatArray] | None:
        """Return x by class, flat, or None when S is not positive definite."""
        ...


Make = TypeVar("Make", bound=Callable[[Layout], LinearSolver])

_SOLVERS: dict[str, Callable[[Layout], LinearSolver]] = {}


def register_linear_solver(name: str) -> Callable[[Make], Make]:
    """Make a solver known by a name. Decorates a class, or a function, that takes a layout."""

    def decorate(make: Make) -> Make:
        known = _SOLVERS.get(name)
        if name == "auto" or (known is not None and known.__qualname__ != make.__qualname__):
            raise InputError(f"A linear solver named {name!r} is registered already. Choose another name.")
        _SOLVERS[name] = make
        return make

    return decorate


def registered_linear_solvers() -> dict[str, Callable[[Layout], LinearSolver]]:
    """Return what makes each solver, by name."""
    return dict(_SOLVERS)


def keeps_poses_alone(layout: Layout) -> bool:
    """Whether poses are all that is kept: no calibration, no planes."""
    variables = layout.problem.variables
    return all(variables[member.group].manifold.kind == "pose" for kept in layout.kept for member in kept.members)


def is_pose_graph(layout: Layout) -> bool:
    """Whether nothing is eliminated and all blocks are poses of one kind."""
    return not layout.eliminated and len(layout.kept) == 1 and keeps_poses_alone(layout)
