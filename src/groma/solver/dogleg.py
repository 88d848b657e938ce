# SPDX-License-Identifier: BSD-3-Clause
r"""Powell's dogleg: the step follows the steepest descent and then turns towards the Gauss-Newton step.

Lengths are measured in the scaled norm :math:`\lVert D^{1/2}\delta \rVert`, D the diagonal of :math:`J^\top J`. One
linear system is solved per linearisation; a refused step is only shortened, which costs no factorisation.

M. J. D. Powell, *A hybrid method for nonlinear equations*, 1970; Lourakis and Argyros, *Is Levenberg-Marquardt the most
efficient optimization algorithm for implementing bundle adjustment?*, 2005. A slight damping keeps the Gauss-Newton
step finite when the scene is free to move.
"""

from __future__ import annotations

import numpy as np

from groma.solver.linear.reduction import Reduction
from groma.solver.steps import States, Step, curvature, diagonal, gradient

#: Damping of the Gauss-Newton step, relative to the diagonal.
GAUSS_NEWTON_DAMPING = 1e-9
MIN_RADIUS = 1e-14


class Dogleg:
    """Proposes steps inside a trust region and adapts its radius."""

    def __init__(self, reduction: Reduction, damping: float) -> None:
        self._reduction = reduction
        #: Reported in place of a damping: the inverse of the radius.
        self.damping = damping
        #: What the trust region holds back of the decrease is not known; where it does not, nothing.
        self.withheld = 0.0
        self._radius = 0.0
        self._newton: Step | None = None

    def linearize(self, states: States, inputs: list[tuple]) -> float:
        """Form the normal equations, and the two corners of the dogleg; return the cost of the states."""
        equations, system = self._reduction.equations, self._reduction.system
        damping = GAUSS_NEWTON_DAMPING
        cost = self._reduction.linearize(states, inputs, damping)
        if not np.isfinite(cost):
            return cost
        kept = self._reduction.solve(damping)
        while kept is None and damping < 0.01:
            damping *= 100.0
            self._reduction.damp(damping)
            kept = self._reduction.solve(damping)
        with self._reduction.watch("backsubstitute"):
            D = diagonal(equations, system)
            g = gradient(equations)
            self._root = Step([np.sqrt(d) for d in D.kept], [np.sqrt(d) for d in D.landmarks])
            descent = Step(
                [-a / d for a, d in zip(g.kept, D.kept, strict=True)],
                [-a / d for a, d in zip(g.landmarks, D.landmarks, strict=True)],
            )
            bend = curvature(equations, system, descent)
            length = -g.dot(descent) / bend if bend > 0 else 0.0
            self._cauchy = descent.blend(length, descent, 0.0)
            self._newton = Step(kept, system.landmark_steps(kept)) if kept is not None else None
            if self._radius == 0.0:
                self._radius = max(self._length(self._newton or self._cauchy), 1e-12)
        return cost

    def _length(self, step: Step) -> float:
        return float(
            np.sqrt(sum(float((r * d) @ (r * d)) for r, d in zip(self._root.parts(), step.parts(), strict=True)))
        )

    def propose(self) -> tuple[Step, float] | None:
        """Return the dogleg step for the present radius and the decrease of the quadratic model."""
        with self._reduction.watch("backsubstitute"):
            step = self._point()
            self.withheld = 0.0 if step is self._newton else np.inf
            self._proposed = self._length(step)
            equations, system = self._reduction.equations, self._reduction.system
            decrease = -gradient(equations).dot(step) - 0.5 * curvature(equations, system, step)
        return step, decrease

    def _point(self) -> Step:
        cauchy, newton, radius = self._cauchy, self._newton, self._radius
        if newton is not None and self._length(newton) <= radius:
            return newton
        cauchy_length = self._length(cauchy)
        if newton is None or cauchy_length >= radius:
            return cauchy.blend(min(1.0, radius / max(cauchy_length, 1e-300)), cauchy, 0.0)
        leg = newton.blend(1.0, cauchy, -1.0)
        a, c = self._length(leg) ** 2, cauchy_length**2 - radius**2
        b = sum(
            float((r * x) @ (r * y)) for r, x, y in zip(self._root.parts(), leg.parts(), cauchy.parts(), strict=True)
        )
        t = -c / (b + np.sqrt(b * b - a * c)) if b > 0 else (-b + np.sqrt(b * b - a * c)) / a
        return cauchy.blend(1.0, leg, float(t))

    def accept(self, gain_ratio: float) -> None:
        """Widen the region after a good step, narrow it after a poor one."""
        if gain_ratio > 0.75:
            self._radius = max(self._radius, 3.0 * self._proposed)
        elif gain_ratio < 0.25:
            self._radius *= 0.5
        self.damping = 1.0 / self._radius

    def refuse(self) -> bool:
        """Shorten the step; return False when there is no use in trying on."""
        self._radius = 0.5 * min(self._radius, self._proposed)
        self.damping = 1.0 / max(self._radius, 1e-300)
        return self._radius > MIN_RADIUS
