# SPDX-License-Identifier: BSD-3-Clause
r"""How steps are damped: :math:`(J^\top J + \lambda D)\,\delta = -g` with :math:`D` the diagonal.

Levenberg-Marquardt, with the rule of Nielsen: with the gain ratio :math:`\varrho` = actual / predicted decrease,
:math:`\lambda \leftarrow \lambda \max(1/3, 1 - (2\varrho - 1)^3)` after an accepted step; after a refused one
:math:`\lambda \leftarrow \nu\lambda`, :math:`\nu \leftarrow 2\nu`. A refused step would come again where the damping is
too little to change it: this is repeated until :math:`\lambda\,\delta^\top D\,\delta` would be what the step promised,
which takes a third of the length from a step in one direction. Gauss-Newton: :math:`\lambda = 0`; a refused step ends
the solve.

H. B. Nielsen, *Damping parameter in Marquardt's method*, IMM-REP-1999-05, 1999.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from groma._typing import FloatArray
from groma.problem.variables import Variables
from groma.solver.damped_problem import Trial
from groma.solver.linear.schur import MIN_DIAGONAL
from groma.solver.termination import Termination

MAX_DAMPING = 1e16
#: A scene that is free to move has a singular system; this much damping keeps its factorisation stable.
MIN_DAMPING = 1e-10
#: Where nothing is free to move, what is held back is lost: this little is rounding.
ROUNDING_DAMPING = 1e-15


class Damping(Protocol):
    """The damping of a joint step, adapted to the outcome of the steps before."""

    value: float

    def lowered(self, gain_ratio: float) -> float:
        """Return the damping after an accepted step."""
        ...

    def accept(self, gain_ratio: float) -> None:
        """Adapt to an accepted step."""
        ...

    def refuse(self, trial: Trial) -> Termination | None:
        """Adapt to a refused step; return why to stop where there is no use in trying on."""
        ...


class NielsenDamping:
    """The damping of Levenberg-Marquardt."""

    def __init__(self, value: float, lowest: float = MIN_DAMPING) -> None:
        self.value = value
        self._lowest = lowest
        self._growth = 2.0

    def lowered(self, gain_ratio: float) -> float:  # noqa: D102
        return max(self.value * max(1.0 / 3.0, 1.0 - (2.0 * gain_ratio - 1.0) ** 3), self._lowest)

    def accept(self, gain_ratio: float) -> None:  # noqa: D102
        self.value, self._growth = self.lowered(gain_ratio), 2.0

    def refuse(self, trial: Trial) -> Termination | None:  # noqa: D102
        enough = self.value * trial.promised / trial.withheld if trial.withheld > 0.0 else 0.0
        self.value, self._growth = self.value * self._growth, self._growth * 2.0
        while self.value < enough:
            self.value, self._growth = self.value * self._growth, self._growth * 2.0
        return Termination.DAMPING_EXHAUSTED if self.value > MAX_DAMPING else None


class NoDamping:
    """Gauss-Newton."""

    value = 0.0

    def lowered(self, gain_ratio: float) -> float:  # noqa: D102
        return 0.0

    def accept(self, gain_ratio: float) -> None:  # noqa: D102
        pass

    def refuse(self, trial: Trial) -> Termination | None:  # noqa: D102
        return Termination.STEP_REFUSED if trial.has_step else Termination.SINGULAR


def damping_from(first: float, variables: Mapping[str, Variables]) -> Damping:
    """Return the damping with an initial value; none if that is zero.

    Poses of a long chain have directions that its motions determine ten orders of magnitude less than single poses:
    steps along these end only where the damping is lower still. It may be, where some pose is held.
    """
    if first <= 0.0:
        return NoDamping()
    graph = all(group.manifold.kind == "pose" for group in variables.values())
    held = any(
        free is not None and not free.any(axis=1).all()
        for free in (group.free_coordinates() for group in variables.values())
    )
    return NielsenDamping(first, ROUNDING_DAMPING if graph and held else MIN_DAMPING)


def predicted_decrease(
    kept: Sequence[tuple[FloatArray, FloatArray, FloatArray]],
    residual: Sequence[FloatArray] | None,
    landmark_sums: tuple[float, float],
    damping: float,
) -> tuple[float, float]:
    r"""Return the decrease of the quadratic model, and what the damping holds back of it to first order.

    The decrease is :math:`-g^\top\delta - \tfrac12\delta^\top J^\top J\delta`. From
    :math:`(J^\top J + \lambda D)\,\delta = -g - e`, with e the residual that an iterative solver leaves, it is
    :math:`\tfrac12(-g^\top\delta + \lambda\,\delta^\top D\,\delta + e^\top\delta)`.

    Parameters
    ----------
    kept
        Of every class of kept blocks: diagonal of the normal equations, gradient, step; flat.
    residual
        e by class; None for direct solvers.
    landmark_sums
        :math:`\delta^\top D\,\delta` and :math:`g^\top\delta` over all landmarks.
    damping
        :math:`\lambda`.
    """
    held, total = damping * landmark_sums[0], -landmark_sums[1]
    for diagonal, gradient, delta in kept:
        held += damping * float((np.maximum(diagonal, MIN_DIAGONAL) * delta) @ delta)
        total -= float(gradient @ delta)
    if residual is not None:
        total += sum(float(r @ delta) for r, (_, _, delta) in zip(residual, kept, strict=True))
    return 0.5 * (total + held), held
