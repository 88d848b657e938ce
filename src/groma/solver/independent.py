# SPDX-License-Identifier: BSD-3-Clause
"""Many small problems at once: variables that share no factor with another free variable.

A camera against fixed landmarks (motion only) and landmarks seen by fixed cameras (structure only) are of this kind.
Every variable has a damping of its own, and its step is kept only if it lowers that variable's cost.
"""

from __future__ import annotations

import numpy as np

from groma._simd import width
from groma._typing import FloatArray
from groma.problem._parallel import Workers
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations
from groma.solver.schur import invert_blocks

#: A variable whose damping exceeds this has reached its minimum to machine precision.
MAX_DAMPING = 1e12


class IndependentBlocks:
    """Levenberg-Marquardt on every variable of a layout without kept blocks."""

    def __init__(self, layout: Layout, workers: Workers, initial_damping: float) -> None:
        self.layout = layout
        self.equations = NormalEquations(layout, workers)
        self._N = [np.zeros_like(V) for V in self.equations.V]
        self._h = [np.zeros_like(g) for g in self.equations.g_landmarks]
        self._initial_damping = initial_damping
        self.reset()

    def reset(self) -> None:
        """Forget the dampings of earlier steps."""
        self.damping = [np.full(e.count, self._initial_damping) for e in self.layout.eliminated]
        self._growth = [np.full(e.count, 2.0) for e in self.layout.eliminated]

    def costs(self, states: dict[str, FloatArray], inputs: list[tuple] | None = None) -> list[FloatArray]:
        """Return the cost of each variable of each group."""
        costs = [np.zeros(e.count) for e in self.layout.eliminated]
        self.equations.cost(self.equations.prepare(states) if inputs is None else inputs, costs)
        return costs

    def step(
        self, states: dict[str, FloatArray], costs: list[FloatArray]
    ) -> tuple[dict[str, FloatArray], list[FloatArray], list[FloatArray], float]:
        """Try one step of every variable.

        Returns the new states, their costs, the lengths of the kept steps, and the largest gradient component.
        """
        equations = self.equations
        equations.linearize(states, equations.prepare(states))
        self.num_singular = 0
        candidate = dict(states)
        deltas = []
        for e, group in enumerate(self.layout.eliminated):
            V, g, N, h = equations.V[e], equations.g_landmarks[e], self._N[e], self._h[e]
            self.num_singular += invert_blocks(V, g, self.damping[e], 1, 0, group.count, N, h, width(group.dof))
            delta = h.reshape(group.count, group.dof)
            deltas.append(delta)
            manifold = self.layout.problem.variables[group.group].manifold
            candidate[group.group] = manifold.retract(states[group.group], delta)
        new_costs = self.costs(candidate)
        lengths = []
        for e, group in enumerate(self.layout.eliminated):
            better = new_costs[e] < costs[e]
            better_rows = better[:, None]
            candidate[group.group] = np.where(better_rows, candidate[group.group], states[group.group])
            lengths.append(np.where(better, np.linalg.norm(deltas[e], axis=1), 0.0))
            new_costs[e] = np.where(better, new_costs[e], costs[e])
            self.damping[e] = np.where(
                better, np.maximum(self.damping[e] / 5.0, 1e-15), self.damping[e] * self._growth[e]
            )
            self._growth[e] = np.where(better, 2.0, np.minimum(2.0 * self._growth[e], 1e6))
        gradient = max((float(np.abs(g).max()) for g in equations.g_landmarks if g.size), default=0.0)
        return candidate, new_costs, lengths, gradient

    def unfinished(self, before: list[FloatArray], after: list[FloatArray], tolerance: float) -> int:
        """Count the variables that still moved their cost by more than ``tolerance`` or may after more damping."""
        count = 0
        for e in range(len(before)):
            decrease = before[e] - after[e]
            moving = decrease > tolerance * before[e]
            stuck = (decrease == 0) & (self.damping[e] < 1e-2) & (before[e] > 0)
            count += int((moving | stuck).sum())
        return count
