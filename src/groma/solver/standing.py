# SPDX-License-Identifier: BSD-3-Clause
"""The state of the loop after a step: what it needs to resume, besides the problem at its states."""

from __future__ import annotations

from dataclasses import dataclass

from groma.solver.report import Iteration
from groma.solver.termination import Termination


@dataclass(frozen=True)
class Standing:
    """The loop after an accepted step."""

    initial_cost: float
    #: Relative decrease of the cost in the step, which the next one is compared with.
    fell: float
    #: All steps so far.
    history: tuple[Iteration, ...]
    #: Reason of termination after this step; None: it continues.
    ended: Termination | None = None
