# SPDX-License-Identifier: BSD-3-Clause
r"""Maximum likelihood of 3D lines with known cameras.

The end points' distances in pixels to the projected line are made small by Levenberg-Marquardt
(:mod:`groma.estimators.batch_least_squares`). A line is two points that move across it
(:mod:`groma.estimators.two_point_line`), in a frame whose origin is the start line's point nearest to its cameras and
whose unit is its distance from them.

Observations are ragged and stored by line: those of line i are ``line_pointers[i] : line_pointers[i + 1]``.
"""

from __future__ import annotations

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
from groma.estimators.batch_least_squares import Observations, solve_batch
from groma.estimators.two_point_line import TWO_POINT_LINE
from groma.geometry import line3
from groma.geometry.algebra import apply, norm, ratio, stack, unit, vectors
from groma.geometry.so3 import hat


class _Chart:
    """Lines through points X (L, 2, 3) by direction and foot: a step turns d and moves p along U (L, 2, 3)."""

    def __init__(self, X: FloatArray, U: FloatArray) -> None:
        self.along = unit(X[:, 1] - X[:, 0])
        at = np.einsum("nki,ni->nk", X, self.along)
        self.foot = X[:, 0] - at[:, :1] * self.along
        self._across = U
        places = np.stack([at, np.ones_like(at)], axis=2)
        #: (L, 4, 4) how the two points move across the line in a step: by their places along it, and all alike.
        self.motion = np.einsum("nkp,ij->nkipj", places, np.eye(2)).reshape(len(X), 4, 4)

    def basis(self) -> FloatArray:
        """Derivative (L, 6, 4) of (m; d) by a step."""
        first, second = self._across[:, 0], self._across[:, 1]
        out = np.zeros((len(first), 6, 4))
        out[:, :3, 0], out[:, :3, 1] = np.cross(self.foot, first), np.cross(self.foot, second)
        out[:, :3, 2], out[:, :3, 3] = np.cross(first, self.along), np.cross(second, self.along)
        out[:, 3:, 0], out[:, 3:, 1] = first, second
        return out


#: Why a line has no maximum, the first that applies: too few observations, no finite line, singular, not converged.
_FAILURES = [
    TriangulationStatus.TOO_FEW_VIEWS,
    TriangulationStatus.INVALID,
    TriangulationStatus.DEGENERATE_BASELINE,
    TriangulationStatus.NOT_CONVERGED,
]


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
        Bounds of the observations of each line.
    weights : (M,) float64, optional
        One over the standard deviation of the distances, 1/pixels. Default: one.
    max_iterations : int
        Largest number of steps.
    tolerance : float
        A line has converged when a step lowers its cost by less than this fraction, or none lowers it.
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
    point-line-plane notes, eq. (6); two points across the line take the place of the orthonormal chart, (84), which is
    singular for lines through the origin.
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
    count = sum_by_line(usable.astype(np.float64), pointers)
    enough, valid = count >= 2, line3.is_finite(line)
    start = np.where(valid[:, None], line3.normalize(line), (0.0, 0.0, 0.0, 1.0, 0.0, 0.0))
    origin, scale = _local_frames(start, camera_centers(cameras)[image_idx], pointers)
    owner = np.repeat(np.arange(len(line)), np.diff(pointers))
    local = _cameras_in(origin[owner], scale[owner], cameras[image_idx])

    own = np.column_stack([np.where(usable[:, None], segments, 0.0), 1.0 / np.where(usable, weights, 1.0)])
    active = usable & (valid & enough)[owner]
    begin = start[:, None, 3:] * np.array([-1.0, 1.0])[:, None]
    observations = Observations(local, np.arange(len(segments)), own, pointers, active)
    found = solve_batch(TWO_POINT_LINE, observations, begin, max_iterations, tolerance, floor=0.0)
    chart = _Chart(found.states, found.frames)
    hessian = np.swapaxes(chart.motion, 1, 2) @ found.information @ chart.motion
    moment = np.asarray(np.cross(chart.foot, chart.along), dtype=np.float64)
    refined = to_world(stack(moment, chart.along), scale, origin)
    eigenvalues = np.asarray(np.linalg.eigvalsh(hessian), dtype=np.float64)
    largest = eigenvalues[:, -1]
    determined = np.sqrt(np.clip(ratio(eigenvalues[:, 0], largest, largest > 0.0, 0.0), 0.0, 1.0))
    singular = determined < 1e-7
    known = enough & valid
    covariance = None
    if with_covariance:
        covariance = _covariance(hessian, chart.basis(), scale, origin, known & ~singular)
    return LineTriangulation(
        line=np.where(known[:, None], refined, 0.0),
        sine=np.where(known, determined, 0.0),
        residual=np.sqrt(found.cost / np.maximum(2.0 * count, 1.0)),
        status=np.select([~enough, ~valid, singular, ~found.converged], _FAILURES, TriangulationStatus.OK),
        covariance=covariance,
        iterations=found.steps,
    )


def _local_frames(line: FloatArray, centers: FloatArray, pointers: IntArray) -> tuple[FloatArray, FloatArray]:
    """Origins (L, 3) and units (L,): of each line the point nearest to the middle of its cameras, and its distance."""
    seen = np.where(np.isfinite(centers), centers, 0.0)
    middle = sum_by_line(seen, pointers) / np.maximum(np.diff(pointers), 1)[:, None]
    origin = line3.closest_point(line, middle)
    scale = norm(origin - middle)
    return origin, np.where(scale > 1e-12 * (1.0 + norm(origin)), scale, 1.0)


def _cameras_in(origin: FloatArray, scale: FloatArray, cameras: FloatArray) -> FloatArray:
    """Camera matrices (M, 3, 4) for points in frames X = origin + scale X', their largest entry one."""
    local = np.empty(cameras.shape)
    local[:, :, :3] = cameras[:, :, :3] * scale[:, None, None]
    local[:, :, 3] = apply(cameras[:, :, :3], origin) + cameras[:, :, 3]
    return local / np.maximum(np.abs(local).max(axis=(1, 2), initial=0.0), np.finfo(float).tiny)[:, None, None]


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
