# SPDX-License-Identifier: BSD-3-Clause
r"""The pose of one frame against a map that is held: points, lines and planes, each weighted by its noise.

A prior from constant velocity holds what the measurements do not determine. Which directions those are is told by the
eigenvectors of their information :math:`H = \sum w J^\top J`, scaled so that 1 means: known to 2 % of the median depth
(translation) or to 1 degree (rotation). A direction below 1 is *weak*.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.adjustment.assemble import assemble
from groma.adjustment.stages import with_loss
from groma.factors.contract import Factor
from groma.factors.losses import Cauchy, GemanMcClure, Loss
from groma.problem.problem import Problem
from groma.scene import PosePriors
from groma.solver.options import SolverOptions
from groma.solver.solve import solve
from groma.tracking.frame.camera import TrackCamera, into
from groma.tracking.frame.measurements import LineMeasurements, Measurements, PlaneMeasurements, PointMeasurements
from groma.tracking.map.landmarks import MapView
from groma.tracking.map.map_scene import TRACKING, SeenLines, SeenPlanes, SeenPoints, map_scene

Table = TypeVar("Table", PointMeasurements, LineMeasurements, PlaneMeasurements)
#: A residual beyond this many standard deviations is an outlier.
GATE = 3.5
#: What counts as a well-known direction: share of the median depth, and radians.
WEAK_SHARE, WEAK_ANGLE = 0.02, math.radians(1.0)
#: Losses, one after the other, under held landmarks.
LOSSES: tuple[Loss, ...] = (Cauchy(1.5), GemanMcClure(3.0))
_ASSEMBLY = replace(TRACKING, refine_landmarks=False, loss=LOSSES[0])
_SOLVER = SolverOptions(
    max_iterations=8, function_tolerance=1e-3, initial_damping=1e-6, threads=1, eliminate=("frames",)
)
#: Types of factors that tell which points, lines and planes agree.
_TELLING = (("point_reprojection", "stereo_point"), ("line_reprojection",), ("plane_observation",))
#: The order in which three arrays are multiplied that numpy finds by itself.
_ORDER = ["einsum_path", (0, 1), (0, 1)]
_NAMES = ("x", "y", "z", "turn about x", "turn about y", "turn about z")


@dataclass(frozen=True)
class PoseEstimate:
    """A pose, what agrees with it, and how well it is known."""

    #: (7,) cam_from_world.
    pose: FloatArray
    #: Which measurements agree.
    points: BoolArray
    lines: BoolArray
    planes: BoolArray
    #: (6, 6) information of the measurements alone on the left twist (rho, omega).
    information: FloatArray
    #: Directions of the camera that only the prior holds, by the axis nearest to each.
    weak: tuple[str, ...]

    @property
    def counts(self) -> dict[str, int]:
        """Number of agreeing points, lines and planes."""
        return {"points": int(self.points.sum()), "lines": int(self.lines.sum()), "planes": int(self.planes.sum())}


def estimate_pose(
    camera: TrackCamera,
    view: MapView,
    measured: Measurements,
    predicted: FloatArray,
    prior_sigma: FloatArray,
    start: FloatArray | None = None,
    losses: Sequence[Loss] = LOSSES,
) -> PoseEstimate:
    """Estimate cam_from_world of one frame.

    Parameters
    ----------
    camera, view, measured
        The camera, the map, and what the frame measures of it (indices are those of the map).
    predicted : (7,)
        Prior pose.
    prior_sigma : (6,)
        Standard deviations of the prior: translation (scene units), rotation (radians).
    start : (7,), optional
        Where to start, if not at the prior.
    losses : sequence of Loss, optional
        Of the measurements, one after the other. From a :func:`rough_pose` the last one will do.
    """
    problem = _problem_of(camera, view, measured, predicted, prior_sigma, start)
    for loss in losses:
        problem = solve(with_loss(problem, loss), _SOLVER).problem
    every = problem.factors[:-1]  # all but the prior
    pose = problem.variables["frames"].state[0]
    kept = [
        _agreeing(problem, [factor for factor in every if factor.type_name in names], len(table))
        for names, table in zip(_TELLING, (measured.points, measured.lines, measured.planes), strict=True)
    ]
    information = pose_information(problem, every)
    depth = _median_depth(view, measured, pose)
    return PoseEstimate(pose, kept[0], kept[1], kept[2], information, weak_directions(information, depth))


def rough_pose(
    camera: TrackCamera,
    view: MapView,
    measured: Measurements,
    predicted: FloatArray,
    prior_sigma: FloatArray,
    start: FloatArray,
) -> FloatArray:
    """Return a pose (7,) by measurements of which some are wrong, from where :func:`estimate_pose` may go on."""
    problem = _problem_of(camera, view, measured, predicted, prior_sigma, start)
    return solve(with_loss(problem, LOSSES[0]), _SOLVER)["frames"][0]


def _problem_of(
    camera: TrackCamera,
    view: MapView,
    measured: Measurements,
    predicted: FloatArray,
    prior_sigma: FloatArray,
    start: FloatArray | None,
) -> Problem:
    tables = (measured.points, measured.lines, measured.planes)
    # Each landmark in question is one of its own, numbered anew.
    image = [np.zeros(len(table), np.int64) for table in tables]
    scene = map_scene(
        camera,
        view,
        (predicted if start is None else start)[None],
        ["frame"],
        SeenPoints(tables[0].index, _renumbered(tables[0]), image[0]),
        SeenLines(tables[1].index, _renumbered(tables[1]), image[1]),
        SeenPlanes(tables[2].index, _renumbered(tables[2]), image[2]),
        pose_priors=PosePriors(np.zeros(1, np.int64), predicted[None], prior_sigma[None]),
    )
    return assemble(scene, _ASSEMBLY).problem


def _renumbered(table: Table) -> Table:
    """Return a table whose rows refer to landmarks 0, 1, ..."""
    return replace(table, index=np.arange(len(table)))


def _whitened(problem: Problem, factor: Factor, wanted: tuple[int, ...], width: int) -> FloatArray:
    """Records (N, m, width) of a factor group, multiplied by its square root information."""
    ambients = tuple(problem.variables[ref.group].ambient() for _, ref in factor.references())
    record = np.zeros((len(factor), factor.residual_size, width))
    factor.linearize(factor.prepare(ambients), 0, len(factor), wanted, record)
    weight = np.asarray(factor.sqrt_information)
    return np.einsum("nij,njk->nik", weight, record) if weight.ndim == 3 else record * weight.reshape(-1, 1, 1)


def _agreeing(problem: Problem, group: list[Factor], count: int) -> BoolArray:
    """Which measurements have no row beyond the gate in the factors that cover all of them."""
    good = np.zeros(count, dtype=bool)
    landmark = ("point", "line", "plane")
    for factor in group:
        if getattr(factor, "extrinsics", None) is not None:  # inverse depths of segments
            continue
        columns = (-1,) * len(factor.references())
        residual = _whitened(problem, factor, columns, 1)[..., 0]
        rows = next(ref.index for slot, ref in factor.references() if slot.name in landmark)
        # A degenerate factor (behind the camera) has a residual of exactly zero in all rows.
        good[rows] = (np.abs(residual) < GATE).all(axis=1) & (residual != 0).any(axis=1)
    return good


def pose_information(problem: Problem, factors: Sequence[Factor]) -> FloatArray:
    """(6, 6) information of factors on pose 0, with weights that fall for large residuals."""
    total = np.zeros((6, 6))
    for factor in factors:
        columns = tuple(0 if slot.name == "pose" else -1 for slot, _ in factor.references())
        record = _whitened(problem, factor, columns, 7)
        weight = 1.0 / (1.0 + (record[..., 6] ** 2).sum(axis=1) / GATE**2) ** 2
        J = record[..., :6]
        total += np.einsum("n,nij,nik->jk", weight, J, J, optimize=_ORDER)
    return total


def weak_directions(information: FloatArray, depth: float) -> tuple[str, ...]:
    """Name the directions of a pose that are known worse than the limits."""
    unit = np.array([WEAK_SHARE * depth] * 3 + [WEAK_ANGLE] * 3)
    values, vectors = np.linalg.eigh(unit[:, None] * information * unit)
    return tuple(_NAMES[int(np.abs(vectors[:, k]).argmax())] for k in range(6) if values[k] < 1.0)


def _median_depth(view: MapView, measured: Measurements, pose: FloatArray) -> float:
    places = [view.points.xyz[measured.points.index], view.lines.segment[measured.lines.index].mean(axis=1)]
    depths = into(pose, np.concatenate(places))[:, 2]
    depths = depths[depths > 0]
    return float(np.median(depths)) if len(depths) else 1.0


__all__ = ["GATE", "LOSSES", "PoseEstimate", "estimate_pose", "pose_information", "rough_pose", "weak_directions"]
