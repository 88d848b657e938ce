# SPDX-License-Identifier: BSD-3-Clause
"""The report of a solve: termination, costs, timings, notes."""

from __future__ import annotations

from dataclasses import dataclass, field

from groma._counted import counted
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations
from groma.problem.problem import Problem
from groma.solver.termination import Termination

#: Position, rotation and scale of a whole scene: nobody misses residuals for these.
_GAUGE = 7
STAGES = ("setup", "linearize", "schur", "solve", "backsubstitute", "cost")


@dataclass(frozen=True)
class Iteration:
    """One step that was tried."""

    iteration: int
    #: Cost after the step if it was accepted, else the cost that was refused.
    cost: float
    accepted: bool
    damping: float
    #: Actual over predicted decrease of the cost.
    gain_ratio: float
    #: Euclidean length of the step in increments.
    step_norm: float
    #: Largest component of the gradient at the start of the step, over the root of its curvature.
    gradient_max: float
    #: Iterations of the linear solver; 0 for direct solvers.
    linear_iterations: int
    #: Since the start of the solve.
    seconds: float


@dataclass
class SolveReport:
    """Outcome of a solve. Not converging is an outcome, not an error: see ``termination``."""

    termination: Termination = Termination.NOTHING_TO_DO
    #: Half the sum of the robustified squared residuals.
    initial_cost: float = 0.0
    final_cost: float = 0.0
    #: Steps tried, accepted or not.
    iterations: int = 0
    history: list[Iteration] = field(default_factory=list)
    #: Cost by factor type at the start and at the end.
    initial_costs: dict[str, float] = field(default_factory=dict)
    final_costs: dict[str, float] = field(default_factory=dict)
    #: Number of factors and of residual rows.
    num_factors: int = 0
    num_residuals: int = 0
    #: Unknowns that could move.
    num_unknowns: int = 0
    #: Factors by type that could not be evaluated (a line through the camera centre, say) and were left out.
    num_degenerate: dict[str, int] = field(default_factory=dict)
    #: Landmarks with a direction that the data did not determine at the last linearisation.
    num_underdetermined_landmarks: int = 0
    #: ``dense``, ``sparse``, ``pcg``, or ``blocks`` if every variable is an independent problem.
    linear_solver: str = ""
    threads: int = 1
    #: Wall time by stage, and ``total``.
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))
    #: Sentences for the user about what may be wrong.
    warnings: list[str] = field(default_factory=list)
    #: Sentences about choices that were made.
    notes: list[str] = field(default_factory=list)

    @property
    def converged(self) -> bool:
        """Whether a stop criterion was met."""
        return self.termination.converged

    @property
    def reduced_chi_square(self) -> float:
        """Twice the final cost over the redundancy; about 1 when the noise is as stated and no loss bends it."""
        redundancy = self.num_residuals - self.num_unknowns
        return 2 * self.final_cost / redundancy if redundancy > 0 else float("nan")

    def __str__(self) -> str:
        rows = [
            f"{self.termination.sentence}",
            f"cost {self.initial_cost:.6e} -> {self.final_cost:.6e} in {self.iterations} steps, "
            f"{self.seconds.get('total', 0.0):.3f} s ({self.linear_solver}, {counted(self.threads, 'threads')})",
            f"{self.num_factors:,} factors, {self.num_residuals:,} residuals, {self.num_unknowns:,} unknowns",
        ]
        return "\n".join(
            rows + [f"warning: {text}" for text in self.warnings] + [f"note: {text}" for text in self.notes]
        )


def count_unknowns(problem: Problem) -> int:
    """Return how many coordinates of variables that some factor touches may move."""
    used = {ref.group for factor in problem.factors if len(factor) for _, ref in factor.references()}
    return sum(problem.variables[name].num_free for name in used)


def _by_type(layout: Layout, values: list) -> dict:
    totals: dict = {}
    for factor, value in zip(layout.factors, values, strict=True):
        totals[factor.factor.type_name] = totals.get(factor.factor.type_name, 0) + value
    return totals


def note_costs(
    report: SolveReport, layout: Layout, equations: NormalEquations, at_start: list[float], singular: int
) -> None:
    """Write the costs at the start and at the end by factor type, and what could not be evaluated or determined."""
    report.initial_costs, report.final_costs = _by_type(layout, at_start), _by_type(layout, equations.costs)
    report.num_degenerate = {name: n for name, n in _by_type(layout, equations.num_degenerate).items() if n}
    report.num_underdetermined_landmarks = max(singular - _num_held(layout), 0)


def _num_held(layout: Layout) -> int:
    """Return the number of landmarks that are held, wholly or in part."""
    free = (layout.problem.variables[e.group].free_coordinates() for e in layout.eliminated)
    return sum(int((~one).any(axis=1).sum()) for one in free if one is not None)


def warn_of_oddities(report: SolveReport) -> None:
    """Put into words what may be wrong."""
    for name, count in report.num_degenerate.items():
        report.warnings.append(
            f"Left out: {counted(count, name.replace('_', ' ') + ' factors')} that could not be evaluated "
            "(a point behind its camera, a line through its centre)."
        )
    if report.num_underdetermined_landmarks:
        report.warnings.append(
            f"{counted(report.num_underdetermined_landmarks, 'landmarks')} with an unobservable direction; along it "
            "nothing was moved."
        )
    if report.num_residuals < report.num_unknowns - _GAUGE:
        report.warnings.append(
            f"There are fewer residuals ({report.num_residuals:,}) than unknowns ({report.num_unknowns:,}): the result "
            "is one of many. Hold variables constant, add priors or add observations."
        )
