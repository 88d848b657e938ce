# SPDX-License-Identifier: BSD-3-Clause
"""Options of a solve."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from groma.errors import InputError, did_you_mean
from groma.gates import gate
from groma.problem.variables import Variables
from groma.solver.linear.choice import linear_solver_names

METHODS = ("levenberg_marquardt", "gauss_newton")
SHARED_SYSTEMS = ("auto", "formed", "products")


@dataclass(frozen=True)
class SolverOptions:
    """Options of a solve. The defaults suit bundle adjustment."""

    #: Maximum number of steps, accepted or rejected (cost: time; most solves end before).
    max_iterations: int = 50
    #: Stop when the cost falls by less than this fraction in an accepted step.
    function_tolerance: float = 1e-6
    #: Keep the start, as converged, when the predicted decrease of the first step is at most this fraction of the cost.
    start_tolerance: float = 0.0
    #: Stop when no component of the gradient, over the root of its diagonal in the normal equations, exceeds this.
    gradient_tolerance: float = 1e-10
    #: Stop when translations, rotations and all other parts of a step are below this fraction of those of the states.
    step_tolerance: float = 1e-10
    #: ``levenberg_marquardt``, or ``gauss_newton`` for undamped steps: for well-determined problems that start near
    #: their minimum. It stops if the system is singular or a step does not lower the cost.
    method: str = "levenberg_marquardt"
    #: Initial damping, relative to the diagonal of the normal equations; None: 1e-4 with free lines, 1e-8 for poses
    #: only, else 1e-5.
    initial_damping: float | None = None
    #: Solver of the reduced system: ``auto``, ``dense``, ``sparse``, ``pcg``, or a registered one
    #: (:mod:`groma.solver.linear.contract`).
    linear_solver: str = "auto"
    #: With shards of landmarks: ``formed``, every process holds the whole reduced system; ``products``, off-diagonal
    #: blocks stay with their shards, and conjugate gradients sum products with them; ``auto``: products for very many
    #: cameras (:data:`groma.solver.reduce.shards.MAX_FORMED`).
    shared_system: str = "auto"
    #: Separate steps of every landmark after each accepted joint step; a step that does not help is undone.
    landmark_steps: int = 0
    #: The groups of landmarks with separate steps; None: all that are eliminated.
    landmark_groups: tuple[str, ...] | None = None
    #: Groups of variables that are eliminated, or ``auto``.
    eliminate: str | tuple[str, ...] = "auto"
    #: Threads; None takes one for small problems and all cores for large ones.
    threads: int | None = None

    def __post_init__(self) -> None:
        choices = {"method": METHODS, "linear_solver": linear_solver_names(), "shared_system": SHARED_SYSTEMS}
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                given = getattr(self, name)
                raise InputError(
                    f"{name} must be one of {', '.join(allowed)}; got {given!r}.{did_you_mean(given, allowed)}"
                )
        if self.shared_system == "products" and self.linear_solver not in ("auto", "pcg"):
            raise InputError(
                f"shared_system='products' is for conjugate gradients; got linear_solver={self.linear_solver!r}. Leave "
                "one of them out."
            )
        if self.initial_damping is not None and not self.initial_damping > 0.0:
            raise InputError(
                f"initial_damping must be positive; got {self.initial_damping}. Steps without damping are "
                "method='gauss_newton'."
            )
        for name in ("max_iterations", "landmark_steps"):
            if getattr(self, name) < 0:
                raise InputError(f"{name} must not be negative; got {getattr(self, name)}.")
        for name in ("function_tolerance", "start_tolerance", "gradient_tolerance", "step_tolerance"):
            if not getattr(self, name) >= 0:
                raise InputError(f"{name} must be a number that is not negative; got {getattr(self, name)}.")
        if self.threads is not None and self.threads < 1:
            raise InputError(f"threads must be at least 1, or None; got {self.threads}.")


@dataclass(frozen=True)
class DampingGates:
    """Damping of the first step, relative to the diagonal of the normal equations."""

    poses: float = gate(1e-8, "1", "where there are motions alone", "cost: steps; they are nearly linear")
    points: float = gate(1e-5, "1", "where there are landmarks, but no lines", "cost: steps")
    lines: float = gate(1e-4, "1", "where lines move", "cost: steps; smaller ones throw lines into minima of their own")


#: The defaults.
DAMPING = DampingGates()


def first_damping(variables: Mapping[str, Variables], options: SolverOptions) -> float:
    """Return the damping of the first step; 0 for steps without damping.

    Lines are more bent than points, and long first steps throw some into minima of their own; motions are not.
    """
    if options.method == "gauss_newton":
        return 0.0
    if options.initial_damping is not None:
        return options.initial_damping
    groups = variables.values()
    if all(group.manifold.kind == "pose" for group in groups):
        return DAMPING.poses
    moving_lines = any(group.manifold.kind == "line" and not group.is_constant for group in groups)
    return DAMPING.lines if moving_lines else DAMPING.points
