# SPDX-License-Identifier: BSD-3-Clause
r"""Lens distortion that the cameras do not model, recognised in the residuals of points.

In comes an adjusted problem; out comes what is missing, or nothing. Two tests, the second where the first finds some:

* Is there anything? The components of the residuals along the radius, averaged over rings of equal area around each
  principal point, are normal with variance :math:`\sigma^2 / n` if there is nothing but noise, so that

  .. math:: \sum_{\text{rings}} n \bar r^2 / \sigma^2 \sim \chi^2 .

  Poses and points have taken up most of a distortion, but not all, whatever its form.
* Does a lens explain it, and does it matter? The distortion of a wider camera model is freed, and a few steps are taken
  from where the adjustment ended: the score test of these parameters, followed to where they lead. What they explain is
  the share of the variance of the residuals that disappears, by the medians, which outliers do not move.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.fit import noise_of
from groma.adjustment.pixel_residuals import squared_length
from groma.adjustment.terms.principal_points import is_prior
from groma.cameras import CameraModel, in_model
from groma.cameras import model as camera_model
from groma.execution import begin
from groma.factors.contract import Factor, Ref
from groma.factors.observations.point_reprojection import PointReprojection
from groma.gates import NORMAL, chi_square_gate, gate
from groma.geometry.manifold import Euclidean
from groma.problem.problem import Problem
from groma.problem.residuals import Residuals, residuals_of
from groma.problem.variables import Variables
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

#: The model that a camera may lack, by the model that it has.
WIDER: dict[str, str] = dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), "OPENCV")


@dataclass(frozen=True)
class LensGates:
    """When residuals show another lens, rig or calibration."""

    false_alarm: float = gate(1e-6, "probability", "of rings of residuals that are noise", "convention: five sigma")
    share: float = gate(0.1, "share", "of the residuals' variance that calls for a warning", "convention: a tenth")
    rings: int = gate(16, "rings", "of equal area around the principal point", "convention: as many as a histogram has")
    max_observations: int = gate(200_000, "observations", "that judge a lens or a rig", "cost: more tell no more")
    rig_iterations: int = gate(10, "steps", "with free cameras", "cost: most need three")
    max_leverage: float = gate(0.9, "share", "of an error that cameras follow", "derived from errors ten times larger")
    share_outside: float = gate(
        0.5, "share", "of a camera's observations outside its image",
        "derived from pixels spread evenly: of images twice as wide and high three quarters are outside; models that "
        "were undistorted and cropped keep a few there",
    )  # fmt: skip
    max_iterations: int = gate(4, "steps", "with free distortion", "cost: the first brings most")


LENS = LensGates()


@dataclass(frozen=True)
class Lens:
    """What a wider camera model would bring."""

    #: The models of the cameras, and the wider ones.
    models: tuple[str, ...]
    wider: tuple[str, ...]
    #: Median residuals of points as they are, and with the wider model, pixels.
    before_px: float
    after_px: float

    @property
    def sentence(self) -> str:
        """What to do about it."""
        others = sorted({*self.wider} - {*self.models})
        remedy = f"--camera-model {others[0]}" if others else "--refine-intrinsics"
        return (
            f"The residuals show lens distortion that the cameras ({', '.join(self.models)}) do not have: with it the "
            f"median residual of points would fall from {self.before_px:.2f} to {self.after_px:.2f} px. Repeat with "
            f"{remedy}, or undistort the photographs."
        )


def unmodelled_distortion(
    problem: Problem,
    threads: int | None = None,
    gates: LensGates = LENS,
    wider: Mapping[str, str] = WIDER,
    residuals: Residuals | None = None,
) -> Lens | None:
    """Return the distortion that the cameras of an adjusted problem lack; None where there is none.

    Parameters
    ----------
    problem : Problem
        At its minimum.
    threads : int, optional
        For the few steps of the second test.
    gates : LensGates
        What counts.
    wider : mapping
        The model that a camera may lack, by the model that it has.
    residuals : Residuals, optional
        Those of the problem, where they are needed elsewhere too.
    """
    groups = {f.intrinsics.group: f.camera for f in problem.factors if isinstance(f, PointReprojection) and len(f)}
    groups = {
        name: camera_model(wider[model.name])
        for name, model in groups.items()
        if model.name in wider and (wider[model.name] != model.name or problem.variables[name].is_constant)
    }
    seen = [f for f in problem.factors if isinstance(f, PointReprojection) and f.intrinsics.group in groups]
    residuals = residuals or Residuals(problem)
    if not any(radial_field(f, problem, residuals.of(f), gates) for f in seen):
        return None
    options = SolverOptions(max_iterations=gates.max_iterations, threads=threads)
    begun = of_points(problem, gates.max_observations)
    if begun.num_residuals < problem.num_residuals:  # a part of the measurements finds another minimum
        begun = solve(begun, options).problem
    freed = solve(_with_free_lens(begun, groups), options).problem
    before, after = (median_px([f for f in p.factors if isinstance(f, PointReprojection)], p) for p in (begun, freed))
    if not before > 0.0 or 1.0 - (after / before) ** 2 < gates.share:
        return None
    models = sorted({factor.camera.name for factor in seen})
    return Lens(tuple(models), tuple(sorted({model.name for model in groups.values()})), before, after)


def begin_lens_test(problem: Problem, threads: int | None, residuals: Residuals) -> Callable[[], Lens | None]:
    """Start :func:`unmodelled_distortion` in the background; return a function that waits for its result."""
    return begin(partial(unmodelled_distortion, problem, threads, residuals=residuals))


def radial_field(
    factor: PointReprojection, problem: Problem, residual: FloatArray | None = None, gates: LensGates = LENS
) -> bool:
    """Whether the ``residual`` of points along the radius is not that of noise alone; see the formula above."""
    model, params = factor.camera, problem.variables[factor.intrinsics.group].state
    residual = residuals_of(factor, problem.variables) if residual is None else residual
    center = (
        params[:, list(model.principal_point_indices)] if model.principal_point_indices else np.zeros((len(params), 2))
    )
    square = squared_length(residual)
    limit = chi_square_gate(NORMAL.outlier, 2) * noise_of(square) ** 2
    used = np.flatnonzero((square < limit) & (square > 0.0))
    if not len(used):
        return False
    camera = factor.intrinsics.index.take(used)
    away = factor.pixels.take(used, axis=0) - center.take(camera, axis=0)
    radius, (x, y) = np.sqrt(squared_length(away)), residual.take(used, axis=0).T
    along = (x * away[:, 0] + y * away[:, 1]) / np.maximum(radius, 1e-12)
    ring = _rings(camera, radius, len(params), gates.rings)
    number, total = np.bincount(ring), np.bincount(ring, weights=along)
    seen = number > 0
    statistic = float(np.sum(total[seen] ** 2 / number[seen]) / (along @ along / len(along)))
    return statistic > chi_square_gate(gates.false_alarm, int(seen.sum()))


def _rings(camera: IntArray, radius: FloatArray, cameras: int, rings: int) -> IntArray:
    """Number of the ring of equal area of each observation, counted on from camera to camera."""
    largest = np.zeros(cameras)
    np.maximum.at(largest, camera, radius)
    share = radius / np.maximum(largest, 1e-12).take(camera)
    return camera.astype(np.int64) * rings + np.minimum((share * share * rings).astype(np.int64), rings - 1)


def of_points(problem: Problem, most: int) -> Problem:
    """Return the problem without what refers to lines, planes and directions, and with as many points as are enough."""
    kinds = {name: group.manifold.kind for name, group in problem.variables.items()}
    kept = [
        factor for factor in problem.factors
        if not any(kinds[ref.group] in ("line", "plane", "direction") for _, ref in factor.references())
    ]  # fmt: skip
    stride = -(-sum(map(len, kept)) // most)
    if stride > 1:
        for number, factor in enumerate(kept):
            for _, ref in factor.references():
                if kinds[ref.group] == "point":
                    kept[number] = factor.take(np.flatnonzero(ref.index % stride == 0))
    return Problem(problem.variables, kept)


def _with_free_lens(problem: Problem, groups: dict[str, CameraModel]) -> Problem:
    """Return the problem with cameras in wider models, of which the distortion may move besides what moves already."""
    variables = dict(problem.variables)
    for factor in problem.factors:
        if isinstance(factor, PointReprojection) and (name := factor.intrinsics.group) in groups:
            wider, old = groups[name], problem.variables[name]
            state = np.array([in_model(row, factor.camera, wider) for row in old.state])
            free, constant = old.free_coordinates(), np.ones(state.shape, bool)
            constant[:, list(wider.extra_indices)] = False
            if free is None or free[:, list(factor.camera.focal_indices)].any():
                constant[:, list(wider.focal_indices)] = False
            variables[_wide(name)] = Variables(Euclidean(wider.num_parameters, "intrinsics"), state, constant)
    # Principal points are held.
    return Problem(variables, [_in_wider_model(factor, groups) for factor in problem.factors if not is_prior(factor)])


def _in_wider_model(factor: Factor, groups: dict[str, CameraModel]) -> Factor:
    if not isinstance(factor, PointReprojection) or factor.intrinsics.group not in groups:
        return factor
    intrinsics = Ref(_wide(factor.intrinsics.group), factor.intrinsics.index)
    return replace(factor, intrinsics=intrinsics, camera_model=groups[factor.intrinsics.group])


def _wide(group: str) -> str:
    return f"{group}, free lens"


def median_px(factors: list[PointReprojection], problem: Problem) -> float:
    """Return the median reprojection error of points, pixels."""
    squares = [squared_length(residuals_of(factor, problem.variables)) for factor in factors]
    return float(np.sqrt(np.median(np.concatenate(squares))))
