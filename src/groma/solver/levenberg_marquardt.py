# SPDX-License-Identifier: BSD-3-Clause
r"""Levenberg-Marquardt: the step is damped, :math:`(J^\top J + \lambda D)\,\delta = -g` with :math:`D` the diagonal.

The damping follows Nielsen: with the gain ratio :math:`\varrho` = actual / predicted decrease,
:math:`\lambda \leftarrow \lambda \max(1/3, 1 - (2\varrho - 1)^3)` after an accepted step; after a refused one
:math:`\lambda \leftarrow \nu\lambda`, :math:`\nu \leftarrow 2\nu`.

H. B. Nielsen, *Damping parameter in Marquardt's method*, IMM-REP-1999-05, 1999.
"""

from __future__ import annotations

import numpy as np

from groma.problem.linearization import NormalEquations
from groma.solver.linear import ConjugateGradients, LinearSolver
from groma.solver.report import Stopwatch
from groma.solver.schur import MIN_DIAGONAL, ReducedSystem
from groma.solver.steps import States, Step

MAX_DAMPING = 1e16
#: A scene that is free to move has a singular system; this much damping keeps its factorisation stable.
MIN_DAMPING = 1e-10


class LevenbergMarquardt:
    """Proposes damped steps and adapts the damping."""

    def __init__(
        self, equations: NormalEquations, system: ReducedSystem, linear: LinearSolver, watch: Stopwatch, damping: float
    ) -> None:
        self._equations, self._system, self._linear, self._watch = equations, system, linear, watch
        self.damping = damping
        self._growth = 2.0
        self._at: tuple[States, list[tuple]] = ({}, [])

    def linearize(self, states: States, inputs: list[tuple]) -> None:
        """Form the normal equations and eliminate each chunk's landmarks while they are in cache."""
        self._at = (states, inputs)
        self._linear.follow(states)
        linearize_and_eliminate(self._equations, self._system, states, inputs, self.damping, self._watch)

    def propose(self) -> tuple[Step, float] | None:
        r"""Return a step and the decrease of the quadratic model.

        The decrease is :math:`-g^\top\delta - \tfrac12\delta^\top J^\top J\delta`. From
        :math:`(J^\top J + \lambda D)\,\delta = -g - e`, with e the residual that an iterative solver leaves, it is
        :math:`\tfrac12(-g^\top\delta + \lambda\,\delta^\top D\,\delta + e^\top\delta)`.
        """
        with self._watch("schur"):
            self._system.assemble(self.damping)
        with self._watch("solve"):
            kept = self._linear.solve(self._system.S, self._system.rhs)
        if kept is None:
            return None
        with self._watch("backsubstitute"):
            step = Step(kept, self._system.landmark_steps(kept))
            total = self.damping * self._system.landmark_squares - self._system.landmark_slope
            for c, delta in enumerate(kept):
                diagonal = np.maximum(self._system.diagonal(c).reshape(-1), MIN_DIAGONAL)
                total += self.damping * float((diagonal * delta) @ delta) - float(self._equations.g_kept[c] @ delta)
            if isinstance(self._linear, ConjugateGradients):
                total += sum(float(r @ d) for r, d in zip(self._linear.residual, kept, strict=True))
        return step, 0.5 * total

    def accept(self, gain_ratio: float) -> None:
        """Lower the damping after an accepted step."""
        self.damping = max(self.damping * max(1.0 / 3.0, 1.0 - (2.0 * gain_ratio - 1.0) ** 3), MIN_DAMPING)
        self._growth = 2.0

    def refuse(self) -> bool:
        """Raise the damping after a refused step; return False when there is no use in trying on."""
        self.damping, self._growth = self.damping * self._growth, self._growth * 2.0
        if self.damping > MAX_DAMPING:
            return False
        eliminate_again(self._equations, self._system, *self._at, self.damping, self._watch)
        return True


def linearize_and_eliminate(
    equations: NormalEquations,
    system: ReducedSystem,
    states: States,
    inputs: list[tuple],
    damping: float,
    watch: Stopwatch,
) -> None:
    """Form the normal equations; eliminate each chunk's landmarks right after, while they are in cache."""
    spent = [0.0]

    def eliminate(share: int, chunk) -> None:
        begin = watch.elapsed()
        system.eliminate_chunk(share, chunk, damping)
        if share == 0:
            spent[0] += watch.elapsed() - begin

    with watch("linearize"):
        system.clear()
        equations.linearize(states, inputs, eliminate)
    watch.move("linearize", "schur", spent[0])


def eliminate_again(
    equations: NormalEquations,
    system: ReducedSystem,
    states: States,
    inputs: list[tuple],
    damping: float,
    watch: Stopwatch,
) -> None:
    """Eliminate the landmarks for another damping; compact equations are formed anew for that."""
    if equations.compact:
        linearize_and_eliminate(equations, system, states, inputs, damping, watch)
        return
    with watch("schur"):
        system.eliminate(damping)
