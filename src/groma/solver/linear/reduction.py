# SPDX-License-Identifier: BSD-3-Clause
"""The reduced system at the present states, for one damping after the other."""

from __future__ import annotations

from groma._stopwatch import Stopwatch
from groma._typing import FloatArray
from groma.problem.layout import Chunk
from groma.problem.linearization import NormalEquations
from groma.solver.linear.contract import LinearSolver
from groma.solver.linear.schur import ReducedSystem
from groma.solver.steps import States


class Reduction:
    """Linearises, eliminates landmarks and solves for the kept blocks; the time is booked by stage."""

    def __init__(
        self, equations: NormalEquations, system: ReducedSystem, linear: LinearSolver, watch: Stopwatch
    ) -> None:
        self.equations, self.system, self.linear, self.watch = equations, system, linear, watch
        self._states: States = {}
        self._damping = 0.0

    def linearize(self, states: States, inputs: list[tuple], damping: float) -> float:
        """Form the normal equations; eliminate each chunk's landmarks right after, while they are in cache.

        Returns the cost at the states.
        """
        self._states, self._damping = states, damping
        with self.watch("solve"):
            self.linear.follow(states)
        spent = [0.0] * len(self.equations.shares)

        def eliminate(share: int, chunk: Chunk) -> None:
            begin = self.watch.elapsed()
            self.system.eliminate_chunk(share, chunk, damping)
            spent[share] += self.watch.elapsed() - begin

        with self.watch("linearize"):
            self.system.clear()
            cost = self.equations.linearize(states, inputs, eliminate)
        self.watch.move("linearize", "schur", sum(spent) / min(self.equations.workers.count, len(spent)))
        return cost

    def form(self, states: States, inputs: list[tuple], damping: float) -> None:
        """Form the reduced system for states and a damping, with as little work as the last call allows.

        For another damping alone landmarks are eliminated again; compact equations are linearised, too.
        """
        if states is not self._states or (damping != self._damping and self.equations.compact):
            self.linearize(states, inputs, damping)
        elif damping != self._damping:
            self._damping = damping
            with self.watch("schur"):
                self.system.eliminate(damping)

    def solve(self) -> list[FloatArray] | None:
        """Return the steps of the kept blocks by class, flat; None if the system is not positive definite."""
        with self.watch("schur"):
            self.system.assemble(self._damping)
        with self.watch("solve"):
            return self.linear.solve(self.system.S, self.system.rhs)
