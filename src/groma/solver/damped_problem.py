# SPDX-License-Identifier: BSD-3-Clause
"""The interface between the solver's loop and a problem: linearise, try a step, improve, accept or reject it.

:func:`groma.solver.solve.minimise` drives whatever has these methods: the joint solve (``joint.py``), variables that do
not depend on each other (``independent.py``), landmarks that come in shards (``reduce/shards.py``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, Self, TypeVar

import numpy as np

from groma.solver.termination import Termination


@dataclass(frozen=True)
class Trial:
    """States after a step, as far as the loop needs them, and the step."""

    cost: float
    #: Factors that cannot be evaluated at these states and count nothing.
    num_hidden: int = 0
    #: Actual over predicted decrease of the cost.
    gain_ratio: float = 0.0
    #: Decrease of the cost that the quadratic model predicts.
    promised: float = np.inf
    #: Euclidean length of the step in increments.
    length: float = np.inf
    #: How large the step is for the states, whatever the unit of length: :func:`groma.solver.steps.share_of_states`.
    relative_length: float = np.inf
    #: What the damping holds back of the decrease, to first order.
    withheld: float = 0.0
    #: Whether all variables have converged, where each is judged on its own; None where the cost decides.
    all_converged: bool | None = None

    def without_step(self) -> Self:
        """Return what stands for a step that could not be found, because the linear system was singular."""
        return replace(
            self, cost=np.inf, gain_ratio=0.0, promised=np.inf, length=np.inf, relative_length=np.inf, withheld=0.0
        )

    @property
    def has_step(self) -> bool:
        """Whether the linear system gave a step."""
        return self.length < np.inf

    def lowers(self, best: Trial, share: float) -> bool:
        """Whether the cost is below that of ``best``.

        A factor that became degenerate counts nothing. Its ``share`` of the cost is put back, because steps would
        otherwise hide their effect.
        """
        return self.cost + max(0, self.num_hidden - best.num_hidden) * share < best.cost


T = TypeVar("T", bound=Trial)


class DampedProblem(Protocol[T]):
    """A least-squares problem at its present states, with a damping."""

    @property
    def num_factors(self) -> int:
        """How many factors share the cost."""
        ...

    @property
    def damping(self) -> float:
        """The damping of the next step; the largest, where there are many."""
        ...

    @property
    def linear_iterations(self) -> int:
        """Iterations of the linear solver in the last step; 0 for direct solvers."""
        ...

    def start(self) -> T:
        """Evaluate the problem at its initial states."""
        ...

    def linearize(self) -> None:
        """Form the normal equations of the present states and damping, unless they are formed."""
        ...

    def largest_gradient(self) -> float:
        """Return the largest component of the gradient, each over the root of its diagonal in the normal equations."""
        ...

    def is_curved(self) -> bool:
        """Whether the linearised cost depends on any variable: some factor counts."""
        ...

    def try_step(self) -> T:
        """Solve for a step and evaluate the states after it; :meth:`Trial.without_step` where there is none."""
        ...

    def stretch(self, trial: T, factor: float) -> T:
        """Evaluate a multiple of the step of a trial; return the trial itself where multiples do not apply."""
        ...

    def refine(self, trial: T) -> T:
        """Improve a trial that will be accepted; the trial itself where there is nothing to improve it with."""
        ...

    def rescue(self, trial: T) -> T:
        """Improve a trial that would be refused; the trial itself where there is nothing to improve it with."""
        ...

    def accept(self, trial: T) -> None:
        """Take the states of a trial, and lower the damping."""
        ...

    def refuse(self, trial: T) -> Termination | None:
        """Keep the states and raise the damping; return why to stop where that is of no use."""
        ...
