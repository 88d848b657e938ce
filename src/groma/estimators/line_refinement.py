# SPDX-License-Identifier: BSD-3-Clause
r"""Maximum likelihood of 3D lines with known cameras.

The end points' distances in pixels to the projected line are made small by Levenberg-Marquardt in the Cartesian chart:
a unit direction d and the point p closest to the origin, four parameters per line, regular for every finite line. All
lines are iterated together; each has its own damping and stops on its own.

Observations are ragged and stored by line: those of line i are ``line_pointers[i] : line_pointers[i + 1]``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import ShapeError
from groma.estimators._line_observations import (
    LineTriangulation,
    TriangulationStatus,
    camera_centers,
    checked_observations,
    sum_by_line,
    to_world,
)
from groma.geometry import line3, projection
from groma.geometry.algebra import apply, norm, perpendicular, ratio, stack, unit, vectors
from groma.geometry.so3 import hat


def _residuals(
    matrix: FloatArray, line: FloatArray, ends: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Weighted distances (M, 2) of the end points (M, 2, 3) and their derivatives (M, 2, 6) by the line."""
    image_line = apply(matrix, line)
    squared = image_line[:, 0] ** 2 + image_line[:, 1] ** 2
    seen = squared > 0.0
    inverse = ratio(weights, np.sqrt(squared), seen, 0.0)
    product = np.einsum("mej,mj->me", ends, image_line)
    flat = image_line * (1.0, 1.0, 0.0)
    slope = ends - ratio(product, squared[:, None], seen[:, None], 0.0)[:, :, None] * flat[:, None, :]
    return product * inverse[:, None], (slope * inverse[:, None, None]) @ matrix


def _retract(along: FloatArray, foot: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    first, second = perpendicular(along)
    turned = unit(along + step[:, :1] * first + step[:, 1:2] * second)
    moment = np.cross(foot + step[:, 2:3] * first + step[:, 3:] * second, turned)
    return turned, np.cross(turned, moment)


def _basis(along: FloatArray, foot: FloatArray) -> FloatArray:
    """Derivative (L, 6, 4) of (m; d) by the step of :func:`_retract`."""
    first, second = perpendicular(along)
    out = np.zeros((len(along), 6, 4))
    out[:, :3, 0], out[:, :3, 1] = np.cross(foot, first), np.cross(foot, second)
    out[:, :3, 2], out[:, :3, 3] = np.cross(first, along), np.cross(second, along)
    out[:, 3:, 0], out[:, 3:, 1] = first, second
    return out


@dataclass(frozen=True)
class _Views:
    """Observations in local frames: line projection matrices, end points, weights, stored by line."""

    matrix: FloatArray
    ends: FloatArray
    weights: FloatArray
    pointers: IntArray

    def evaluate(
        self, rows: IntArray, along: FloatArray, foot: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost, normal matrix and gradient of the lines ``rows`` only, so that finished ones cost nothing."""
        counts = np.diff(self.pointers)[rows]
        pointers = np.concatenate([[0], np.cumsum(counts)])
        take = np.arange(pointers[-1]) + np.repeat(self.pointers[rows] - pointers[:-1], counts)
        owner = np.repeat(np.arange(len(rows)), counts)
        line = stack(np.cross(foot, along), along)
        residual, slope = _residuals(self.matrix[take], line[owner], self.ends[take], self.weights[take])
        jacobian = slope @ _basis(along, foot)[owner]
        hessian = sum_by_line(np.swapaxes(jacobian, 1, 2) @ jacobian, pointers)
        gradient = sum_by_line(np.einsum("mea,me->ma", jacobian, residual), pointers)
        return sum_by_line((residual * residual).sum(axis=1), pointers), hessian, gradient


@dataclass(frozen=True)
class _State:
    """Lines in the Cartesian chart, with their cost and normal matrix."""

    along: FloatArray
    foot: FloatArray
    cost: FloatArray
    hessian: FloatArray
    converged: BoolArray
    iterations: IntArray


def _iterate(views: _Views, along: FloatArray, active: BoolArray, max_iterations: int, tolerance: float) -> _State:
    """Levenberg-Marquardt on all active lines at once, from lines through their local origins."""
    count = len(along)
    along, foot, active = along.copy(), np.zeros((count, 3)), active.copy()
    damping, iterations = np.full(count, 1e-4), np.zeros(count, dtype=np.int64)
    converged = np.zeros(count, dtype=bool)
    cost, hessian, gradient = views.evaluate(np.arange(count), along, foot)
    diagonal = np.eye(4, dtype=bool)
    for _ in range(max_iterations):
        rows = np.flatnonzero(active)
        if not len(rows):
            break
        damped = hessian[rows]
        entries = damped[:, diagonal]
        size = entries.max(axis=1)
        floor = 1e-6 * np.where(size > 0.0, size, 1.0)
        damped[:, diagonal] += damping[rows, None] * np.maximum(entries, floor[:, None])
        step = -np.asarray(np.linalg.solve(damped, gradient[rows][..., None])[..., 0], dtype=np.float64)
        trial_along, trial_foot = _retract(along[rows], foot[rows], step)
        trial_cost, trial_hessian, trial_gradient = views.evaluate(rows, trial_along, trial_foot)
        better = trial_cost <= cost[rows]
        done = (norm(step) <= tolerance) | (better & (cost[rows] - trial_cost <= tolerance * cost[rows]))
        iterations[rows] += 1
        damping[rows] = np.clip(np.where(better, 0.1, 10.0) * damping[rows], 1e-9, 1e12)
        accepted = rows[better]
        along[accepted], foot[accepted] = trial_along[better], trial_foot[better]
        cost[accepted], hessian[accepted] = trial_cost[better], trial_hessian[better]
        gradient[accepted] = trial_gradient[better]
        converged[rows] = done
        active[rows] = ~done
    return _State(along, foot, cost, hessian, converged, iterations)


def refine_lines(
    line: FloatArray,
    cameras: FloatArray,
    image_idx: IntArray,
    segments: FloatArray,
    line_pointers: IntArray,
    weights: FloatArray | None = None,
    max_iterations: int = 30,
    tolerance: float = 1e-10,
    with_covariance: bool = False,
) -> LineTriangulation:
    r"""Maximum likelihood lines: least squares of the end points' distances to the projected line.

    .. math:: r = \frac{1}{\sqrt{l_1^2 + l_2^2}} \begin{bmatrix} x_s^\top l \\ x_e^\top l \end{bmatrix}, \qquad
              l = \mathcal{P} L

    All lines are iterated together; each has its own damping and stops on its own. A step in the Cartesian chart is
    :math:`d' = \mathrm{unit}(d + \alpha_1 b_1 + \alpha_2 b_2)`, :math:`p' = p + \beta_1 b_1 + \beta_2 b_2`, in a frame
    whose origin is the start line's point nearest to its cameras and whose unit is its distance from them.

    Parameters
    ----------
    line : (L, 6) float64
        Start values, world frame. Lines that are no finite line are left alone: INVALID.
    cameras : (C, 3, 4) float64
        Camera matrices.
    image_idx : (M,) int
        Camera of each observation.
    segments : (M, 4) float64
        Measured segments [x1, y1, x2, y2], pixels, undistorted. Rows that are not finite are ignored.
    line_pointers : (L + 1,) int
        Where each line's observations begin and end.
    weights : (M,) float64, optional
        One over the standard deviation of the distances, 1/pixels. Default: one.
    max_iterations : int
        Largest number of steps.
    tolerance : float
        A line has converged when a step changes it by less than this, relative to its distance from the cameras, or
        lowers its cost by less than this fraction.
    with_covariance : bool
        Whether to return the covariance of (m, d), unit d.

    Returns
    -------
    LineTriangulation
        ``sine`` is the square root of the ratio of smallest to largest eigenvalue of the normal matrix, a measure of
        how well the line is determined. ``residual`` is the root mean square distance, weighted.

    References
    ----------
    Plücker notes, eq. (68), (73)-(82). Deviations: (81) is used with l1² + l2² in the inner denominators, as in the
    point-line-plane notes, eq. (6); the chart is Cartesian in place of the orthonormal one, (84), which is singular for
    lines through the origin.
    """
    cameras, image_idx, segments, pointers = checked_observations(cameras, image_idx, segments, line_pointers)
    line = vectors(line, 6, "line")
    if line.shape != (len(pointers) - 1, 6):
        raise ShapeError(f"line must have shape ({len(pointers) - 1}, 6), one row per pointer pair; got {line.shape}.")
    weights = np.ones(len(segments)) if weights is None else np.asarray(weights, dtype=np.float64)
    if weights.shape != (len(segments),):
        raise ShapeError(f"weights must have shape ({len(segments)},); got {weights.shape}. Pass one per observation.")
    usable = np.asarray(np.isfinite(segments).all(axis=1) & np.isfinite(weights) & (weights > 0.0))
    weights = np.where(usable, weights, 0.0)
    ends = np.ones((len(segments), 2, 3))
    ends[:, :, :2] = np.where(usable[:, None], segments, 0.0).reshape(-1, 2, 2)
    owner = np.repeat(np.arange(len(line)), np.diff(pointers))
    count = sum_by_line(usable.astype(np.float64), pointers)

    valid = line3.is_finite(line)
    start = np.where(valid[:, None], line3.normalize(line), (0.0, 0.0, 0.0, 1.0, 0.0, 0.0))
    centers = camera_centers(cameras)[image_idx]
    middle = (
        sum_by_line(np.where(np.isfinite(centers), centers, 0.0), pointers) / np.maximum(np.diff(pointers), 1)[:, None]
    )
    origin = line3.closest_point(start, middle)
    scale = norm(origin - middle)
    scale = np.where(scale > 1e-12 * (1.0 + norm(origin)), scale, 1.0)

    # line projection matrices for lines in the local frame X = origin + scale * X'
    local = np.empty((len(segments), 3, 4))
    local[:, :, :3] = cameras[image_idx, :, :3] * scale[owner][:, None, None]
    local[:, :, 3] = apply(cameras[image_idx, :, :3], origin[owner]) + cameras[image_idx, :, 3]
    matrix = projection.line_projection_matrix(local)
    matrix /= np.maximum(np.abs(matrix).max(axis=(1, 2), initial=0.0), np.finfo(float).tiny)[:, None, None]

    along = start[:, 3:]
    active = valid & (count >= 2)
    state = _iterate(_Views(matrix, ends, weights, pointers), along, active, max_iterations, tolerance)
    along, foot, hessian = state.along, state.foot, state.hessian
    refined = to_world(stack(np.cross(foot, along), along), scale, origin)
    eigenvalues = np.asarray(np.linalg.eigvalsh(hessian), dtype=np.float64)
    largest = eigenvalues[:, -1]
    determined = np.sqrt(np.clip(ratio(eigenvalues[:, 0], largest, largest > 0.0, 0.0), 0.0, 1.0))
    enough = count >= 2
    singular = determined < 1e-7
    status = np.select(
        [~enough, ~valid, singular, ~state.converged],
        [
            TriangulationStatus.TOO_FEW_VIEWS,
            TriangulationStatus.INVALID,
            TriangulationStatus.DEGENERATE_BASELINE,
            TriangulationStatus.NOT_CONVERGED,
        ],
        TriangulationStatus.OK,
    )
    known = enough & valid
    covariance = None
    if with_covariance:
        covariance = _covariance(hessian, _basis(along, foot), scale, origin, known & ~singular)
    return LineTriangulation(
        line=np.where(known[:, None], refined, 0.0),
        sine=np.where(known, determined, 0.0),
        residual=np.sqrt(state.cost / np.maximum(2.0 * count, 1.0)),
        status=status,
        covariance=covariance,
        iterations=state.iterations,
    )


def _covariance(
    hessian: FloatArray, basis: FloatArray, scale: FloatArray, origin: FloatArray, determined: BoolArray
) -> FloatArray:
    """Covariance (L, 6, 6) of the world line; infinite on the diagonal where the line is not determined."""
    inverse = np.linalg.inv(np.where(determined[:, None, None], hessian, np.eye(4)))
    motion = np.zeros((len(scale), 6, 6))
    motion[:, :3, :3] = scale[:, None, None] * np.eye(3)
    motion[:, :3, 3:] = hat(origin)
    motion[:, 3:, 3:] = np.eye(3)
    columns = motion @ basis
    covariance = columns @ inverse @ np.swapaxes(columns, 1, 2)
    return np.where(determined[:, None, None], covariance, np.where(np.eye(6, dtype=bool), np.inf, 0.0))
