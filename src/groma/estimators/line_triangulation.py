# SPDX-License-Identifier: BSD-3-Clause
r"""3D lines from their segments in two or more calibrated images.

A segment with image line l fixes the plane :math:`\pi = P^\top l` through the camera centre; the line is where the
planes of its views meet. Three closed forms, each over many lines at once:

:func:`triangulate_two_planes`
    the meet of two planes. The sine of the angle between them is the quality: a direction error is about the noise of
    the plane normals divided by it. Near zero the line lies in an epipolar plane, and two views cannot see it.
:func:`triangulate_planes`
    n planes. Rows :math:`\omega_i \pi_i^\top/\|n_i\|` make a matrix A; its two largest right singular vectors are two
    planes, its two smallest two points of the same line.
:func:`triangulate_plucker`
    n planes, linear in the Plücker vector: every plane holds the line, :math:`L\,\pi_i = 0`, three rows each. The last
    singular vector is then moved to the closest valid line.

:func:`triangulate_lines` follows the second by :func:`groma.estimators.line_refinement.refine_lines` and checks that
the lines lie in front of the cameras.

Linear estimates depend on origin and unit of length. Both are chosen per line: the origin is the mean of the camera
centres, the unit the distance of the line from there, found in a first pass whose unit is the spread of the centres.

Observations are ragged and stored by line: those of line i are ``line_pointers[i] : line_pointers[i + 1]``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError, ShapeError
from groma.estimators import trimming
from groma.estimators._line_observations import (
    LineTriangulation,
    TriangulationStatus,
    camera_centers,
    checked_observations,
    checked_pointers,
    sum_by_line,
    to_world,
)
from groma.estimators.line_refinement import refine_lines
from groma.gates import gate
from groma.geometry import line3, projection, segment2
from groma.geometry.algebra import dot, norm, ratio, stack, vectors
from groma.geometry.so3 import hat

__all__ = [
    "LineTriangulation",
    "TriangulationGates",
    "TriangulationStatus",
    "triangulate_lines",
    "triangulate_planes",
    "triangulate_plucker",
    "triangulate_two_planes",
]


@dataclass(frozen=True)
class TriangulationGates:
    """Lines from planes."""

    min_sine: float = gate(0.05, "1", "of the angle of two planes", "derived from noise: 20 times as large")


#: The defaults.
TRIANGULATION = TriangulationGates()


# ------------------------------------------------------------------------------------------------------------ Two views
def triangulate_two_planes(
    first: FloatArray, second: FloatArray, min_sine: float = TRIANGULATION.min_sine
) -> LineTriangulation:
    """Lines in which two planes meet, with the quality of the intersection.

    Parameters
    ----------
    first, second : (L, 4) float64
        Planes back-projected from two views, of any scale.
    min_sine : float
        Sine of the angle between the planes below which the baseline counts as degenerate; 0.05 is 3 degrees.

    Returns
    -------
    LineTriangulation
        Lines, sines, residuals (zero: two planes always agree) and status.

    References
    ----------
    Plücker notes, eq. (33).
    """
    planes = np.stack([vectors(first, 4, "first"), vectors(second, 4, "second")], axis=-2)
    length = norm(planes[..., :3])
    usable: BoolArray = np.all(np.isfinite(planes).all(axis=-1) & (length > 0.0), axis=-1)
    planes = ratio(planes, length[..., None], usable[..., None, None], 0.0)
    line = line3.from_planes(planes[..., 0, :], planes[..., 1, :])
    sine = np.minimum(norm(line[..., 3:]), 1.0)
    finite = usable & line3.is_finite(line)
    status = np.select(
        [~usable, sine < min_sine, ~finite],
        [TriangulationStatus.INVALID, TriangulationStatus.DEGENERATE_BASELINE, TriangulationStatus.INVALID],
        TriangulationStatus.OK,
    )
    line = np.where(finite[..., None], line3.normalize(line), 0.0)
    return LineTriangulation(line, np.where(usable, sine, 0.0), np.zeros(sine.shape), status)


# ----------------------------------------------------------------------------------------------------- Linear, n views
@dataclass(frozen=True)
class _Bundle:
    """Checked planes with unit normals, moved and scaled per line."""

    planes: FloatArray
    weights: FloatArray
    pointers: IntArray
    owner: IntArray
    count: IntArray
    center: FloatArray
    unit: FloatArray


def _bundle(planes: FloatArray, pointers: IntArray, centers: FloatArray, weights: FloatArray | None) -> _Bundle:
    planes, centers = vectors(planes, 4, "planes"), vectors(centers, 3, "centers")
    if planes.ndim != 2 or centers.shape != (len(planes), 3):
        raise ShapeError(
            f"planes and centers must have shapes (M, 4) and (M, 3); got {planes.shape} and {centers.shape}. Pass one "
            "plane and one camera centre per observation."
        )
    pointers = checked_pointers(pointers, len(planes))
    weights = np.ones(len(planes)) if weights is None else np.asarray(weights, dtype=np.float64)
    if weights.shape != (len(planes),):
        raise ShapeError(f"weights must have shape ({len(planes)},); got {weights.shape}. Pass one per observation.")
    length = norm(planes[:, :3])
    usable = np.isfinite(planes).all(axis=1) & (length > 0.0) & np.isfinite(centers).all(axis=1)
    usable &= np.isfinite(weights) & (weights > 0.0)
    owner = np.repeat(np.arange(len(pointers) - 1), np.diff(pointers))
    centers = np.where(usable[:, None], centers, 0.0)
    count = sum_by_line(usable.astype(np.float64), pointers).astype(np.int64)
    center = sum_by_line(centers, pointers) / np.maximum(count, 1)[:, None]
    spread = np.where(usable, dot(centers - center[owner], centers - center[owner]), 0.0)
    scale = np.sqrt(sum_by_line(spread, pointers) / np.maximum(count, 1))
    planes = ratio(planes, length[:, None], usable[:, None], 0.0)
    planes = stack(planes[:, :3], planes[:, 3:] + dot(planes[:, :3], center[owner])[:, None])
    weights = np.where(usable, weights, 0.0)
    return _Bundle(planes, weights, pointers, owner, count, center, np.where(scale > 0.0, scale, 1.0))


def _rows(bundle: _Bundle, scale: FloatArray) -> FloatArray:
    """Weighted planes (M, 4) in the unit of length ``scale`` (L,)."""
    scaled = stack(bundle.planes[:, :3], bundle.planes[:, 3:] / scale[bundle.owner][:, None])
    return bundle.weights[:, None] * scaled


def _line_of_planes(bundle: _Bundle, scale: FloatArray, pair: str) -> FloatArray:
    rows = _rows(bundle, scale)
    _, basis = np.linalg.eigh(sum_by_line(rows[:, :, None] * rows[:, None, :], bundle.pointers))
    if pair == "planes":
        return line3.from_planes(basis[..., 3], basis[..., 2])
    return line3.from_homogeneous_points(basis[..., 0], basis[..., 1])


def _line_of_incidence(bundle: _Bundle, scale: FloatArray) -> FloatArray:
    rows = _rows(bundle, scale)
    blocks = np.zeros((len(rows), 4, 6))
    blocks[:, :3, :3] = -hat(rows[:, :3])
    blocks[:, :3, 3:] = rows[:, 3, None, None] * np.eye(3)
    blocks[:, 3, 3:] = -rows[:, :3]
    _, basis = np.linalg.eigh(sum_by_line(np.swapaxes(blocks, 1, 2) @ blocks, bundle.pointers))
    return line3.closest_line(basis[..., 0])


def _linear(bundle: _Bundle, pair: str, min_sine: float) -> LineTriangulation:
    estimate = _line_of_incidence if pair == "incidence" else lambda b, s: _line_of_planes(b, s, pair)
    line = line3.normalize(estimate(bundle, bundle.unit))
    scale = bundle.unit * np.where(line3.is_finite(line), norm(line[:, :3]), 1.0)
    scale = np.where(scale > 1e-3 * bundle.unit, scale, bundle.unit)
    line = line3.normalize(estimate(bundle, scale))
    enough, finite = bundle.count >= 2, line3.is_finite(line)
    scatter = bundle.planes[:, :3, None] * bundle.planes[:, None, :3]  # without weights: a question of geometry only
    values = np.linalg.eigvalsh(sum_by_line(scatter, bundle.pointers)) / np.maximum(bundle.count, 1)[:, None]
    total = np.maximum(sum_by_line(bundle.weights**2, bundle.pointers), np.finfo(float).tiny)
    sine = 2.0 * np.sqrt(np.clip(values[:, 1] * values[:, 2], 0.0, 0.25))  # derived from eigenvalues that sum to 1
    local = np.where(finite[:, None], line, 0.0)
    foot = np.cross(local[:, 3:], local[:, :3])
    off = dot(bundle.planes[:, :3], foot[bundle.owner]) + bundle.planes[:, 3] / scale[bundle.owner]
    residual = np.sqrt(sum_by_line(bundle.weights**2 * off**2, bundle.pointers) / total)
    status = np.select(
        [~enough, sine < min_sine, ~finite],
        [TriangulationStatus.TOO_FEW_VIEWS, TriangulationStatus.DEGENERATE_BASELINE, TriangulationStatus.INVALID],
        TriangulationStatus.OK,
    )
    known = (enough & finite)[:, None]
    world = np.where(known, to_world(local, scale, bundle.center), 0.0)
    return LineTriangulation(world, np.where(enough, sine, 0.0), residual, status)


def triangulate_planes(
    planes: FloatArray,
    line_pointers: IntArray,
    centers: FloatArray,
    weights: FloatArray | None = None,
    pair: str = "planes",
    min_sine: float = TRIANGULATION.min_sine,
) -> LineTriangulation:
    r"""Lines from n planes each, by the singular vectors of the stacked planes.

    Parameters
    ----------
    planes : (M, 4) float64
        Back-projected planes, one per observation, of any scale. Rows that are zero or not finite are ignored.
    line_pointers : (L + 1,) int
        Bounds of the observations of each line.
    centers : (M, 3) float64
        Camera centres, for the choice of origin and unit.
    weights : (M,) float64, optional
        Weights of the rows, for example segment lengths. Default: one.
    pair : str
        ``"planes"``: the meet of the two largest singular vectors; ``"points"``: the join of the two smallest. The four
        are orthogonal, so both are the same line.
    min_sine : float
        Quality below which the status is DEGENERATE_BASELINE.

    Returns
    -------
    LineTriangulation
        The quality is :math:`2\sqrt{\lambda_1\lambda_2}` of the two largest eigenvalues of the mean of the normals'
        outer products, without weights: for two planes it is the sine of their angle.

    Notes
    -----
    The singular vectors are eigenvectors of the 4x4 Gram matrices, so that lines with any number of views are one
    batch. Eigenvectors then carry an error of about 1e-16 over the squared sine, far below any noise.
    """
    if pair not in ("planes", "points"):
        raise InputError(f"pair must be 'planes' or 'points'; got {pair!r}. Both give the same line.")
    return _linear(_bundle(planes, line_pointers, centers, weights), pair, min_sine)


def triangulate_plucker(
    planes: FloatArray,
    line_pointers: IntArray,
    centers: FloatArray,
    weights: FloatArray | None = None,
    min_sine: float = TRIANGULATION.min_sine,
) -> LineTriangulation:
    r"""Lines from n planes each, linear in the Plücker vector, then moved to the closest valid line.

    The rows are :math:`L\,\pi_i = [\,-[n_i]_\times m + w_i d,\; -n_i^\top d\,] = 0`. Parameters and returns as for
    :func:`triangulate_planes`.

    References
    ----------
    A. Bartoli, P. Sturm, *Structure-from-motion using lines*, CVIU 100, 2005. Deviation: they stack
    :math:`[l_i]_\times \mathcal{P}_i L`, which is :math:`P_i L \pi_i` and loses the component along the viewing
    centre: two views then leave a pencil of solutions. :math:`L\,\pi_i = 0` determines the line from two views.
    """
    return _linear(_bundle(planes, line_pointers, centers, weights), "incidence", min_sine)


# ------------------------------------------------------------------------------------------------------------ The chain
def triangulate_lines(
    cameras: FloatArray,
    image_idx: IntArray,
    segments: FloatArray,
    line_pointers: IntArray,
    weights: FloatArray | None = None,
    min_sine: float = TRIANGULATION.min_sine,
    with_covariance: bool = False,
) -> LineTriangulation:
    """Lines from image segments: linear estimate, maximum likelihood, check that they lie in front of the cameras.

    Parameters
    ----------
    cameras, image_idx, segments, line_pointers, weights, with_covariance
        As for :func:`refine_lines`. The linear estimate weighs each plane by the length of its segment.
    min_sine : float
        Quality of the linear estimate below which the status is DEGENERATE_BASELINE.

    Returns
    -------
    LineTriangulation
        ``sine`` is the quality of the linear estimate, ``residual`` the one in pixels of the refinement. A line is in
        front of a camera if both trimmed end points are.
    """
    cameras, image_idx, segments, pointers = checked_observations(cameras, image_idx, segments, line_pointers)
    finite: BoolArray = np.asarray(np.isfinite(segments).all(axis=1))
    measured = np.where(finite[:, None], segments, 0.0)
    planes = projection.back_project_lines(cameras[image_idx], segment2.to_line(measured))
    linear = triangulate_planes(
        planes, pointers, camera_centers(cameras)[image_idx], segment2.length(measured), min_sine=min_sine
    )
    refined = refine_lines(
        linear.line, cameras, image_idx, segments, pointers, weights, with_covariance=with_covariance
    )
    owner = np.repeat(np.arange(len(linear.line)), np.diff(pointers))
    trimmed = trimming.trim_segments(cameras[image_idx], refined.line[owner], measured)
    in_front = finite & (trimmed.status == trimming.TrimStatus.OK).all(axis=1)
    views = sum_by_line(in_front.astype(np.float64), pointers)
    status = np.where(linear.status == TriangulationStatus.OK, refined.status, linear.status)
    status = np.where((status == TriangulationStatus.OK) & (views < 2), TriangulationStatus.BEHIND_CAMERA, status)
    return LineTriangulation(
        refined.line, linear.sine, refined.residual, status, refined.covariance, refined.iterations
    )
