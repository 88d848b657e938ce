# SPDX-License-Identifier: BSD-3-Clause
r"""A plane through uncertain points: weighted least squares, with covariance.

The distance :math:`h = n^\top p + w` of a point with covariance :math:`\Sigma` from a plane that it lies on is normal
with variance :math:`s^2 = n^\top \Sigma\, n`. The fit makes :math:`\sum h^2/s^2` small. With unit vectors b1, b2
across n and the weighted centroid c, a plane moves by two tilts and an offset,

.. math:: h \leftarrow h + \alpha_1 b_1^\top (p - c) + \alpha_2 b_2^\top (p - c) + \beta,

whose information matrix gives the covariance of (n, w). :mod:`groma.estimators.plane_search` finds the points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError, ShapeError
from groma.estimators._plane_loops import fit_loop
from groma.estimators._plane_options import PLANE_SEARCH
from groma.geometry.algebra import perpendicular, vectors

#: Root of the information about what points do not determine; the square of its inverse is still finite.
_UNKNOWN = 1e-140


@dataclass(frozen=True)
class PlaneFit:
    """A plane fitted to points."""

    #: (4,) unit normal and offset.
    plane: FloatArray
    #: (4, 4) covariance of (n, w), rank 3.
    covariance: FloatArray
    #: Sum of squared whitened distances over its degrees of freedom; about 1 where the covariances are right.
    reduced_chi_square: float


def fit_plane(
    points: FloatArray,
    covariances: FloatArray,
    weights: FloatArray | None = None,
    iterations: int = PLANE_SEARCH.fit_rounds,
) -> PlaneFit:
    r"""Fit one plane to points by weighted least squares.

    .. math:: \min \sum_i \omega_i \frac{(n^\top p_i + w)^2}{n^\top \Sigma_i\, n}

    Parameters
    ----------
    points : (N, 3) float64
        At least three points, scene units.
    covariances : (N, 3, 3) float64
        Their covariances.
    weights : (N,) float64, optional
        Further weights; zero leaves a point out.
    iterations : int
        Rounds in which the variances are taken from the last normal.

    Returns
    -------
    PlaneFit
        The plane; points on one line leave one tilt open, points at one place both: their covariance is very large.

    Raises
    ------
    ShapeError, InputError
        If shapes do not fit, there are fewer than three points, or one has no variance.
    """
    points = vectors(points, 3, "points")
    covariances = np.asarray(covariances, dtype=np.float64)
    if points.ndim != 2 or covariances.shape != (len(points), 3, 3):
        raise ShapeError(
            f"points and covariances must have shapes (N, 3) and (N, 3, 3); got {points.shape}, {covariances.shape}."
        )
    weights = np.ones(len(points)) if weights is None else np.asarray(weights, dtype=np.float64)
    if (weights > 0).sum() < 3:
        raise InputError(f"A plane needs at least 3 points of positive weight; got {int((weights > 0).sum())}.")
    if not (spread := np.einsum("nii->n", covariances)[weights > 0]).min() > 0.0:
        raise InputError(
            f"Covariances of points must have a positive trace; got {spread.min()}. Say how uncertain they are."
        )
    packed = np.ascontiguousarray(covariances[:, *np.triu_indices(3)])
    plane, center, precision = np.empty(4), np.empty(3), np.empty(len(points))
    fit_loop(
        np.ascontiguousarray(points), packed, np.arange(len(points)), weights, iterations, plane, center, precision
    )
    return fit_with_covariance(plane, center, points, precision, weights)


def fit_with_covariance(
    plane: FloatArray, center: FloatArray, points: FloatArray, precision: FloatArray, weights: FloatArray
) -> PlaneFit:
    """Return a plane of least squares through points (N, 3) with its covariance.

    ``center`` is their mean by ``precision`` (N,), the ``weights`` (N,) over the variances across the plane.
    """
    normal, away = plane[:3], points - center
    slope, motion = plane_motions(plane, center, points)
    information = (precision[:, None] * slope).T @ slope
    size = np.maximum(np.sqrt(np.diag(information)), _UNKNOWN)
    correlation = information / np.outer(size, size) + 1e-12 * np.eye(3)
    inner = np.linalg.inv(correlation) / np.outer(size, size)
    count = int((weights > 0).sum())
    chi = float((precision * (away @ normal) ** 2).sum()) / max(count - 3, 1)
    return PlaneFit(plane, motion @ inner @ motion.T, chi)


def plane_motions(plane: FloatArray, center: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How distances of points (N, 3) from a plane change with its two tilts around ``center`` and its offset (N, 3).

    And how (n, w) do (4, 3): n moves along the axes of the tilts, and w keeps the plane through the center.
    """
    basis = np.stack(perpendicular(plane[:3]))
    motion = np.zeros((4, 3))
    motion[:3, :2], motion[3, :2], motion[3, 2] = basis.T, -basis @ center, 1.0
    return np.column_stack([(points - center) @ basis.T, np.ones(len(points))]), motion


def tilt_sigma(covariance: FloatArray) -> FloatArray:
    """Largest standard deviations (...) of the normals, radians, of planes with covariances (..., 4, 4)."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[..., :3, :3])[..., -1], 0.0))


__all__ = ["PlaneFit", "fit_plane", "tilt_sigma"]
