# SPDX-License-Identifier: BSD-3-Clause
"""The state of a solve in shards, and the interface of what stores it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from groma.solver.standing import Standing
from groma.solver.steps import States


@dataclass(frozen=True)
class Waypoint:
    """Where a solve in shards stands after an accepted step, besides the states."""

    standing: Standing
    #: The damping of the next step, and the gain ratio and curvature of the last one.
    damping: float
    last_ratio: float
    curvature: float


class Journal(Protocol):
    """Saves the state of a solve, so that another one can resume."""

    #: State from which the solve resumes, which the variables then have; None: the start.
    begin: Waypoint | None

    def keep(self, states: States, waypoint: Waypoint) -> None:
        """Keep where the solve stands; called by all processes after every accepted step."""
        ...
