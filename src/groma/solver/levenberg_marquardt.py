# SPDX-License-Identifier: BSD-3-Clause
r"""Levenberg-Marquardt: the step is damped, :math:`(J^\top J + \lambda D)\,\delta = -g` with :math:`D` the diagonal.

The damping follows Nielsen: with the gain ratio :math:`\varrho` = actual / predicted decrease,
:math:`\lambda \leftarrow \lambda \max(1/3, 1 - (2\varrho - 1)^3)` after an accepted step; after a refused one
:math:`\lambda \leftarrow \nu\lambda`, :math:`\nu \leftarrow 2\nu`.

H. B. Nielsen, *Damping parameter in Marquardt's method*, IMM-REP-1999-05, 1999.
"""

from __future__ import annotations

import numpy as np

from groma.solver.linear.reduced import ConjugateGradients
from groma.solver.linear.reduction import Reduction
from groma.solver.linear.schur import MIN_DIAGONAL
from groma.solver.steps import States, Step

MAX_DAMPING = 1e16
#: A scene that is free to move has a singular system; this much damping keeps its factorisation stable.
MIN_DAMPING = 1e-10


class LevenbergMarquardt:
    """Proposes damped steps and adapts the damping."""

    def __init__(self, reduction: Reduction, damping: float) -> None:
        self._reduction = reduction
        self.damping = damping
        #: Of the last step: what the damping holds back of the decrease, to first order.
        self.withheld = 0.0
        self._growth = 2.0

    def linearize(self, states: States, inputs: list[tuple]) -> float:
        """Form the reduced system at new states; return their cost."""
        return self._reduction.linearize(states, inputs, self.damping)

    def propose(self) -> tuple[Step, float] | None:
        r"""Return a step and the decrease of the quadratic model.

        The decrease is :math:`-g^\top\delta - \tfrac12\delta^\top J^\top J\delta`. From
        :math:`(J^\top J + \lambda D)\,\delta = -g - e`, with e the residual that an iterative solver leaves, it is
        :math:`\tfrac12(-g^\top\delta + \lambda\,\delta^\top D\,\delta + e^\top\delta)`.
        """
        system, linear = self._reduction.system, self._reduction.linear
        kept = self._reduction.solve(self.damping)
        if kept is None:
            return None
        with self._reduction.watch("backsubstitute"):
            step = Step(kept, system.landmark_steps(kept))
            damped = self.damping * system.landmark_squares
            total = -system.landmark_slope
            for c, delta in enumerate(kept):
                diagonal = np.maximum(system.diagonal(c).reshape(-1), MIN_DIAGONAL)
                damped += self.damping * float((diagonal * delta) @ delta)
                total -= float(system.equations.g_kept[c] @ delta)
            if isinstance(linear, ConjugateGradients):
                total += sum(float(r @ d) for r, d in zip(linear.residual, kept, strict=True))
        self.withheld = damped
        return step, 0.5 * (total + damped)

    def accept(self, gain_ratio: float) -> None:
        """Lower the damping after an accepted step."""
        self.damping = max(self.damping * max(1.0 / 3.0, 1.0 - (2.0 * gain_ratio - 1.0) ** 3), MIN_DAMPING)
        self._growth = 2.0

    def refuse(self) -> bool:
        """Raise the damping after a refused step; return False when there is no use in trying on."""
        self.damping, self._growth = self.damping * self._growth, self._growth * 2.0
        if self.damping > MAX_DAMPING:
            return False
        self._reduction.damp(self.damping)
        return True
