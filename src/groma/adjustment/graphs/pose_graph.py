# SPDX-License-Identifier: BSD-3-Clause
r"""Adjustment of a pose graph: poses that agree best with the motions measured between them.

With the measured :math:`Z_{ij}` (``first_from_second``) and poses :math:`X` (``world_from_body``) it minimises

.. math:: \tfrac12 \sum_{ij} \rho\big(\lVert \mathrm{Log}(Z_{ij}^{-1} X_i^{-1} X_j) \rVert^2_{\Sigma_{ij}^{-1}}\big) .

Place recognition errs now and then, and one wrong motion between distant poses bends the whole graph. A robust loss
lets go of it, if the poses at the start are about right. The start is the poses of the graph or, where that costs less,
what follows from the motions alone: put one after the other (:meth:`groma.scene.pose_graph.PoseGraph.chained`), or all
together in linear systems (:mod:`groma.adjustment.graphs.linear_start`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from groma._counted import counted, first_of
from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.graphs.linear_start import linear_start
from groma.adjustment.report import Progress, not_converged
from groma.errors import InputError, check_kind, given_or_default
from groma.factors.contract import Ref
from groma.factors.losses import Loss, Trivial
from groma.factors.losses import loss as make_loss
from groma.factors.priors.pose_between import PoseBetween
from groma.gates import NORMAL, chi_square_gate
from groma.geometry import se3
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.problem.problem import Problem
from groma.problem.residuals import squared_norms
from groma.problem.variables import Variables
from groma.scene.pose_graph import Motions, PoseGraph
from groma.solver.options import SolverOptions
from groma.solver.report import Iteration, SolveReport
from groma.solver.solve import solve

#: Default scale of a robust loss, in standard deviations: the length that the error of a
#: right motion (six numbers) exceeds once in a hundred (derived from the chi-square distribution of six).
LOSS_SCALE = 4.1
#: Increments (rho, omega) of cam_from_world that leave the plane z = 0.
_OUT_OF_PLANE = np.array([False, False, True, True, True, False])


@dataclass(frozen=True)
class PoseGraphOptions:
    """Options of :func:`adjust_pose_graph`."""

    #: ``none``, ``huber``, ``soft_l1``, ``cauchy``, ``tukey``, ``geman_mcclure``, ``barron`` or ``truncated``.
    loss: str = "none"
    #: Residual at which the loss stops being quadratic, in standard deviations; None: 4.1.
    loss_scale: float | None = None
    #: No robust loss for edges between consecutive ids: odometry has small errors everywhere, place recognition has
    #: rare large ones.
    trust_odometry: bool = True
    #: Maximum number of steps (cost: time; most solves end before).
    max_iterations: int = 100
    #: ``auto``, ``dense``, ``sparse``, ``pcg``, or a solver that was registered.
    linear_solver: str = "auto"
    #: Threads; None takes one for small graphs and all cores for large ones.
    threads: int | None = None


@dataclass(frozen=True)
class PoseGraphResult:
    """The adjusted pose graph and the report."""

    graph: PoseGraph
    report: SolveReport
    #: (E,) squared error of every motion in variances, without the loss, before and after.
    chi_square_before: FloatArray
    chi_square: FloatArray
    #: Motions beyond the scale of the loss after the adjustment; none for plain least squares.
    outliers: IntArray
    #: Whether it began from poses that follow from the motions alone, which cost less than those that were given.
    from_motions: bool = False

    @property
    def num_parts(self) -> int:
        """Number of connected parts of the graph."""
        return int(self.graph.parts().max()) + 1

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences for the user."""
        said = [*not_converged(self.report), *self.report.warnings, *self._contradictions()]
        if self.num_parts > 1:
            said.append(f"The graph falls into {self.num_parts} parts; each keeps the frame of its held or first pose.")
        return tuple(said)

    @property
    def noise(self) -> float:
        """Noise of the motions that are no outliers, in units of what they state; NaN where all are needed."""
        held = np.bincount(self.graph.parts(), self.graph.poses.held)
        free = len(self.graph.poses) - int(np.maximum(held, 1.0).sum())
        kept = np.delete(np.arange(len(self.chi_square)), self.outliers)
        measured = int(np.linalg.matrix_rank(self.graph.motions.information[kept], hermitian=True).sum())
        redundancy = measured - (3 if self.graph.planar else 6) * free
        return float(np.sqrt(self.chi_square[kept].sum() / redundancy)) if redundancy > 0 else math.nan

    def _contradictions(self) -> list[str]:
        """Say which motions err by more than the noise that they state explains in a graph of so many."""
        motions, ids = self.graph.motions, self.graph.poses.ids
        limit = chi_square_gate(NORMAL.false_alarm / len(motions), 3 if self.graph.planar else 6)
        wrong = np.setdiff1d(np.flatnonzero(self.chi_square > limit), self.outliers)
        if not self.report.converged or not len(wrong):
            return []
        worst = wrong[np.argsort(-self.chi_square[wrong], kind="stable")]
        named = [f"{ids[motions.first_idx[k]]}-{ids[motions.second_idx[k]]} ({self.chi_square[k]:.3g})" for k in worst]
        return [
            f"{len(wrong):,} of {counted(len(motions), 'motions')} contradict the others by more than their stated "
            f"noise explains (chi-square beyond {limit:.3g}): {first_of(named, 3)}. If single ones are "
            "wrong, use --loss geman_mcclure; if most are, the file states too little noise."
        ]

    def summary(self) -> dict[str, Any]:
        """Return all numbers as plain values, as ``groma adjust --json`` writes them."""
        report, graph = self.report, self.graph
        ids, motions = graph.poses.ids, graph.motions
        return {
            "num_poses": len(graph.poses),
            "num_motions": len(motions),
            "num_parts": self.num_parts,
            "planar": graph.planar,
            "initial_cost": report.initial_cost,
            "final_cost": report.final_cost,
            "from_motions": self.from_motions,
            "iterations": report.iterations,
            "termination": report.termination.key,
            "converged": report.converged,
            "linear_solver": report.linear_solver,
            "seconds": dict(report.seconds),
            "noise": self.noise if math.isfinite(self.noise) else None,
            "chi_square": {"before": float(self.chi_square_before.sum()), "after": float(self.chi_square.sum())},
            "outlier_motions": [
                [int(ids[motions.first_idx[row]]), int(ids[motions.second_idx[row]])] for row in self.outliers
            ],
            "warnings": list(self.warnings),
        }


def adjust_pose_graph(
    graph: PoseGraph, options: PoseGraphOptions | None = None, progress: Callable[[Progress], bool | None] | None = None
) -> PoseGraphResult:
    """Adjust the poses of a graph; in each connected component without a held pose, the first one is held.

    Parameters
    ----------
    graph : PoseGraph
        Poses and motions; not changed.
    options : PoseGraphOptions, optional
        How.
    progress : callable, optional
        Called after each step; return False to stop.

    Raises
    ------
    InputError
        If the graph has no motions.
    """
    check_kind(graph, PoseGraph, "graph", "Read one with groma.io.read_g2o(path).")
    options = given_or_default(options, PoseGraphOptions)
    if not len(graph.motions):
        poses = counted(len(graph.poses), "poses")
        raise InputError(f"The graph has {poses} and no motions between them; nothing to adjust.")
    given = pose_graph_problem(graph, options)
    problem = _cheaper_start(graph, given)
    settings = SolverOptions(
        max_iterations=options.max_iterations,
        linear_solver=options.linear_solver,
        threads=options.threads,
        function_tolerance=1e-8,
    )

    def show(step: Iteration) -> bool | None:
        return progress(Progress(step.iteration, options.max_iterations, step.cost)) if progress is not None else None

    solution = solve(problem, settings, show)
    before, after = (_chi_squares(graph, options, at) for at in (given, solution.problem))
    robust = problem.factors[1]
    beyond = after > getattr(robust.loss, "scale", np.inf) ** 2
    beyond[_rows(graph, options)[0]] = False
    poses = graph.poses.replace(world_from_body=se3.inverse(solution["poses"]))
    return PoseGraphResult(
        graph=graph.replace(poses=poses),
        report=solution.report,
        chi_square_before=before,
        chi_square=after,
        outliers=np.flatnonzero(beyond),
        from_motions=problem is not given,
    )


def pose_graph_problem(graph: PoseGraph, options: PoseGraphOptions | None = None) -> Problem:
    """Return the problem of a graph: ``poses`` (body_from_world), motions without, and motions with a loss."""
    options = given_or_default(options, PoseGraphOptions)
    part, held = graph.parts(), graph.poses.held
    has_held = np.zeros(part.max(initial=-1) + 1, dtype=bool)
    has_held[part[held]] = True
    _, first = np.unique(part, return_index=True)
    held = held.copy()
    held[first[~has_held]] = True
    constant = held[:, None] | (_OUT_OF_PLANE & graph.planar)
    robust = make_loss(options.loss, LOSS_SCALE if options.loss_scale is None else options.loss_scale)
    trusted, doubted = _rows(graph, options)
    return motion_problem(
        se3.inverse(graph.poses.world_from_body), constant, graph.motions, [(trusted, Trivial()), (doubted, robust)]
    )


def motion_problem(
    body_from_world: FloatArray, constant: BoolArray, motions: Motions, losses: Sequence[tuple[IntArray, Loss]]
) -> Problem:
    """Return the problem of poses with motions measured between them.

    Parameters
    ----------
    body_from_world : (N, 7)
        The poses: the variables ``poses``.
    constant : (N,) or (N, 6) bool
        Which of them, or of their coordinates, are held.
    motions : Motions
        What was measured.
    losses : sequence of (rows, loss)
        The loss of some motions each: one group of factors.
    """
    every = motion_factors(motions, "poses")
    factors = [replace(every.take(rows), loss=loss) for rows, loss in losses]
    return Problem({"poses": Variables(POSE_CHARTS["left"], body_from_world, constant)}, factors)


def motion_factors(motions: Motions, group: str) -> PoseBetween:
    """Return the factors of motions between poses (body_from_world) of a group of variables, without a loss."""
    return PoseBetween(
        first=Ref(group, motions.first_idx),
        second=Ref(group, motions.second_idx),
        first_from_second=motions.first_from_second,
        sqrt_information=_roots(motions.information),
    )


def _cheaper_start(graph: PoseGraph, problem: Problem) -> Problem:
    """Return the problem of a graph, or the same at poses that follow from its motions where these cost less.

    Poses that already agree with the motions within the noise stated for these are taken as they are: the squared error
    expected at the minimum is the number of residuals beyond that of the unknowns. Poses that are held keep their
    place; with others than the first of each part, which is where a chain begins, there is no chain.
    """
    held: BoolArray = np.asarray(np.all(problem.variables["poses"].constant, axis=1))
    is_first = np.zeros(len(graph.poses), dtype=bool)
    is_first[np.unique(graph.parts(), return_index=True)[1]] = True
    size = 3 if graph.planar else 6
    if _squared_error(problem) <= size * (len(graph.motions) - len(graph.poses) + int(held.sum())):
        return problem
    chain = None if (graph.poses.held & ~is_first).any() else graph.chained()
    others = [start.poses.world_from_body for start in (chain, linear_start(graph, held)) if start is not None]
    starts = [problem, *(problem.with_states({"poses": se3.inverse(poses)}) for poses in others)]
    return min(starts, key=_squared_error)


def _squared_error(problem: Problem) -> float:
    return sum(float(f.loss.evaluate(squared_norms(f, problem.variables))[0].sum()) for f in problem.factors)


def _rows(graph: PoseGraph, options: PoseGraphOptions) -> tuple[IntArray, IntArray]:
    """Return the motions without and with a loss: the two groups of factors, in their order."""
    trusted = graph.odometry() & options.trust_odometry
    return np.flatnonzero(trusted), np.flatnonzero(~trusted)


def _chi_squares(graph: PoseGraph, options: PoseGraphOptions, problem: Problem) -> FloatArray:
    """Return the squared error (E,) of every motion, in variances."""
    result = np.zeros(len(graph.motions))
    for rows, factor in zip(_rows(graph, options), problem.factors, strict=True):
        result[rows] = squared_norms(factor, problem.variables)
    return result


def _roots(information: FloatArray) -> FloatArray:
    """Return R (E, 6, 6) with R^T R the information, which may be semidefinite."""
    values, vectors = np.linalg.eigh(information)
    return np.sqrt(np.maximum(values, 0.0))[:, :, None] * vectors.transpose(0, 2, 1)
