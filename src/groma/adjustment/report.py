# SPDX-License-Identifier: BSD-3-Clause
"""What comes out of an adjustment: the scene, and a report in its terms, as text and as plain numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any

from groma._counted import counted
from groma.gates import gate
from groma.problem.problem import Problem
from groma.scene import Scene
from groma.solver.report import SolveReport
from groma.solver.termination import Termination

if TYPE_CHECKING:
    from groma.adjustment.contributions import Contribution
    from groma.adjustment.uncertainty import SceneUncertainty
    from groma.solver.observability.diagnosis import Diagnosis


@dataclass(frozen=True)
class CreepingGates:
    """When an adjustment crept along what the data do not determine."""

    steps: int = gate(10, "steps", "accepted before", "convention: more than an adjustment needs")
    fall: float = gate(0.2, "share", "by which the last one lowered the cost, at most", "convention: no convergence")


#: The defaults.
CREEPING = CreepingGates()
#: Entries of the report of the solver that are part of this one.
_OF_SOLVE = (
    *("num_residuals", "num_unknowns", "initial_cost", "final_cost", "initial_costs", "final_costs"),
    *("reduced_chi_square", "iterations", "converged", "linear_solver", "threads", "num_degenerate"),
    "num_underdetermined_landmarks",
)


@dataclass(frozen=True)
class Progress:
    """What a progress callback gets after every step."""

    #: Steps tried so far, and the most there may be.
    iteration: int
    max_iterations: int
    #: The cost after this step.
    cost: float


@dataclass(frozen=True)
class AdjustReport:
    """Outcome of :func:`adjust` in the terms of the scene; as a string, its main figures."""

    #: What took part.
    num_images: int
    num_points: int
    num_lines: int
    num_planes: int
    num_observations: int
    #: Root mean square residual by kind of landmark, pixels: {kind: {before, after}}, without the loss.
    rmse_px: dict[str, dict[str, float]]
    #: What ends within the noise that the residuals show, by kind of landmark: limit_px, and share and rmse_px, each
    #: {before, after}; see :func:`groma.adjustment.fit.inliers`. The headline: an rms of all is one of outliers.
    inliers: dict[str, dict[str, Any]]
    #: The noise that the observations show, in units of that stated, by the median; None without observations.
    sigma0: float | None
    #: How the solver got there.
    solve: SolveReport
    #: Sentences for the user.
    warnings: tuple[str, ...]
    #: One entry per loss that was solved with, in order: loss, initial_cost, first_step. Costs of different stages
    #: cannot be compared.
    stages: tuple[dict[str, Any], ...] = ()
    #: Relations between landmarks by kind: how many held, and how many the loss gave up, which the scene then drops.
    relations: dict[str, dict[str, int]] = field(default_factory=dict)
    #: Other measurements than points and segments in images, by kind: depths, columns in right images and so on.
    num_measurements: dict[str, int] = field(default_factory=dict)

    def __str__(self) -> str:
        counts = {"images": self.num_images, "points": self.num_points, "lines": self.num_lines}
        counts |= {"planes": self.num_planes, "observations": self.num_observations}
        counts |= self.num_measurements
        rows = [", ".join(counted(number, kind) for kind, number in counts.items() if number)]
        rows += [
            f"{kind}: {told['rmse_px']['before']:.3f} px -> {told['rmse_px']['after']:.3f} px "
            f"(rms of the inliers, {100 * told['share']['after']:.1f} %)"
            for kind, told in self.inliers.items()
        ]
        return "\n".join([*rows, str(self.solve), *(f"warning: {sentence}" for sentence in self.warnings)])

    @property
    def termination(self) -> Termination:
        """Why the solve stopped."""
        return self.solve.termination

    @property
    def history(self) -> list[dict[str, Any]]:
        """One entry per step tried: iteration, stage, cost, accepted, damping, step_norm, seconds and more."""
        firsts = [stage["first_step"] for stage in self.stages]
        return [
            {**asdict(record), "stage": sum(first <= record.iteration for first in firsts)}
            for record in self.solve.history
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain numbers and words, for JSON."""
        own = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in ("solve", "warnings")}
        solve = {name: getattr(self.solve, name) for name in _OF_SOLVE}
        return own | solve | {
            "termination": self.termination.key,
            "termination_sentence": self.termination.sentence,
            "seconds": dict(self.solve.seconds),
            "stages": list(self.stages),
            "history": self.history,
        }  # fmt: skip


@dataclass(frozen=True)
class AdjustResult:
    """The adjusted scene and the report."""

    scene: Scene
    report: AdjustReport
    #: The problem at its solution, for covariances and diagnosis; None in a result read from a file.
    problem: Problem | None = None

    def diagnose(self) -> Diagnosis:
        """Say in words what the observations determine, at the noise and with the loss of the adjustment."""
        from groma.adjustment.diagnosis import diagnose_scene

        return diagnose_scene(self.scene, problem=self.problem)

    def uncertainty(self, gauge: str = "auto", sigma0: float = 1.0) -> SceneUncertainty:
        """Return the covariances of the scene: :func:`groma.uncertainty` of the problem that was solved."""
        from groma.adjustment.uncertainty import uncertainty

        return uncertainty(self.scene, gauge=gauge, sigma0=sigma0, problem=self.problem)

    def pose_uncertainty(self) -> dict[str, Any] | None:
        """Return how well the cameras are known, at the noise that the observations show."""
        from groma.adjustment.uncertainty import pose_uncertainty

        return None if self.problem is None else pose_uncertainty(self.scene, self.problem, self.report.sigma0 or 1.0)

    def summary(self, diagnosis: Diagnosis | None = None, contributions: Sequence[Contribution] = ()) -> dict[str, Any]:
        """Return all numbers as plain values, as ``groma adjust --json`` writes them.

        Parameters
        ----------
        diagnosis : Diagnosis, optional
            What the data determine: :meth:`diagnose`. With it, the uncertainty of the cameras is included.
        contributions : sequence of Contribution
            The same adjustment with fewer kinds of landmarks: :func:`groma.contributions`.
        """
        numbers = self.report.to_dict()
        if contributions:
            numbers["contributions"] = [entry.to_dict() for entry in contributions]
        numbers["diagnosis"] = None if diagnosis is None else diagnosis.to_dict()
        numbers["pose_uncertainty"] = None if diagnosis is None else self.pose_uncertainty()
        numbers["warnings"] = [*self.report.warnings, *why_steps_ran_out(numbers)]
        return numbers


def not_converged(solve: SolveReport) -> list[str]:
    """Return a sentence for an adjustment that did not converge; none where only the start was to be evaluated."""
    if solve.converged or (solve.termination is Termination.MAX_ITERATIONS and solve.iterations == 0):
        return []
    return [f"Not converged after {counted(solve.iterations, 'steps')}. {solve.termination.sentence}"]


def why_steps_ran_out(numbers: Mapping[str, Any]) -> list[str]:
    """Return a sentence for an adjustment that crept along unobservable directions of the cameras to its last step.

    Along an unobservable direction the cost is nearly flat and bent, so steps follow it for long; neither more of them
    nor a robust loss would make a result that can be relied on.
    """
    diagnosis = numbers.get("diagnosis")
    if numbers["termination"] != "max_iterations" or diagnosis is None or not diagnosis["num_unobservable_directions"]:
        return []
    costs = [step["cost"] for step in numbers["history"] if step["accepted"]]
    if len(costs) < CREEPING.steps or costs[-1] < (1.0 - CREEPING.fall) * costs[-2]:
        return []
    return [
        "The steps ran out where cameras or calibrations are unobservable: along these the cost falls slowly, and "
        "wherever more steps end is one result of many. Hold them, or add data."
    ]
