# SPDX-License-Identifier: BSD-3-Clause
r"""Fit a pose to matches: points and lines together, each weighted by its noise and by that of its landmark.

The landmarks are held. What is not known of them is seen through the derivative of the residual by the landmark,
:math:`J_X`, and is added to the noise of the image,

.. math:: \Sigma = \sigma^2 I + J_X\, \Sigma_X\, J_X^\top ,

which is what eliminating landmarks with such priors would leave, to first order. The noise that the residuals show
multiplies all of it.

Errors of neighbouring matches are seldom independent: they share a surface, an image of the map, a lens. The covariance
of the pose is therefore the larger of the usual inverse :math:`H^{-1}` and the one that adds gradients within cells of
the image before it squares them (clustered sandwich),

.. math:: H^{-1} \Big( \sum_{c} g_c g_c^\top \Big) H^{-1}, \qquad g_c = \sum_{i \in c} J_i^\top W_i r_i .

What is wrong with the map itself, with the poses that its landmarks were found from, is common to all that a cell
shows, and no number of matches averages it out. Where it is known to be :math:`\tau` radians as seen from the camera
(:mod:`groma.localization.errors.map_errors`), the covariance grows by

.. math:: \tau^2 \Big( \sum_c \frac{1}{n_c} \sum_{i \in c} \bar J_i^\top \bar J_i \Big)^{-1} ,

that of a pose from one match a cell, with derivatives :math:`\bar J` in radians.

Reference: K.-Y. Liang, S. Zeger, *Longitudinal data analysis using generalized linear models*, 1986, eq. (7).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from groma._numba import loop
from groma._typing import BoolArray, FloatArray, IntArray
from groma.factors.losses import Cauchy, GemanMcClure
from groma.gates import NORMAL, chi_square_gate
from groma.localization.pose.camera import QueryCamera, seen_from
from groma.localization.pose.free_lens import FreeLens
from groma.localization.pose.gates import REFINEMENT
from groma.localization.pose.matches import Matches, nearest_claims
from groma.localization.pose.one_pose import OnePose
from groma.localization.pose.pose_fit import FINELY, ROUGHLY, fit_pose
from groma.localization.pose.pose_problem import problem_of
from groma.localization.pose.residuals import Residuals, residuals

#: Information of scaled unknowns below which they are not determined.
_SINGULAR = 1e-10


# ---------------------------------------------------------------------------------------------------------- Kernels
@loop
def _weigh(image, record, covariance, rows, out, square):
    """Inverse roots of the noise of the image and of the landmarks together, and squared residuals in its units."""
    size = covariance.shape[1]
    for n in range(image.shape[0]):
        determinant = image[n, 0, 0] * image[n, 1, 1] - image[n, 0, 1] * image[n, 1, 0]
        a, b, c, d = image[n, 1, 1], -image[n, 0, 1], -image[n, 1, 0], image[n, 0, 0]
        uu, uv = (a * a + b * b) / determinant**2, (a * c + b * d) / determinant**2
        vv = (c * c + d * d) / determinant**2
        for i in range(size):
            first, second = 0.0, 0.0
            for j in range(size):
                value = covariance[rows[n], i, j]
                first += value * record[n, 0, j]
                second += value * record[n, 1, j]
            uu += record[n, 0, i] * first
            uv += record[n, 0, i] * second
            vv += record[n, 1, i] * second
        root = np.sqrt(uu)
        rest = np.sqrt(vv - uv * uv / uu)
        out[n, 0, 0], out[n, 0, 1] = 1.0 / root, 0.0
        out[n, 1, 0], out[n, 1, 1] = -uv / (uu * rest), 1.0 / rest
        r, s = record[n, 0, size], record[n, 1, size]
        if r != 0.0 or s != 0.0:  # what cannot be evaluated is zero
            square[rows[n]] = (r / root) ** 2 + (out[n, 1, 0] * r + s / rest) ** 2


# ----------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, eq=False)
class Refined:
    """A pose fitted to what agrees with it."""

    #: (7,) cam_from_world, and the camera: as given, or estimated.
    pose: FloatArray
    camera: QueryCamera
    points: Residuals
    lines: Residuals
    #: Which matches agree; of several that claim the same, the nearest.
    point_inliers: BoolArray
    line_inliers: BoolArray
    #: Noise that the residuals show, in units of what was stated, and the squared residual that agrees.
    sigma0: float
    limit: float
    #: The problem at this pose, and the inverse noise of its factors.
    one: OnePose
    weights: tuple[FloatArray, ...]
    #: What is estimated of the lens.
    lens: FreeLens | None = None

    @property
    def prior(self) -> FloatArray:
        """(6 + k, 6 + k) what is known of the lens before: information."""
        return np.zeros((6, 6)) if self.lens is None else self.lens.prior(self.camera.params)[:-1, :-1]

    def covariance(self, matches: Matches) -> FloatArray:
        """(6, 6) covariance of the left twist; infinite where the matches do not determine the pose."""
        return self.joint_covariance(matches)[:6, :6]

    def joint_covariance(self, matches: Matches) -> FloatArray:
        """(6 + k, 6 + k) covariance of the left twist and of what is estimated of the lens."""
        cell = self.cells(matches)
        noise = self.noise_covariance(cell)
        if matches.shared_error == 0.0 or not np.isfinite(noise).all():
            return noise
        return noise + matches.shared_error**2 * self.shared_covariance(cell, matches.shared_error)

    def shared_covariance(self, cell: IntArray, error: float) -> FloatArray:
        """Covariance of the same if what each cell shows is off by one radian, together; ``error`` is how far it is."""
        chosen = ((self.points, self.point_inliers), (self.lines, self.line_inliers))
        J = np.concatenate([found.by_pose[kept] for found, kept in chosen])
        spread = np.concatenate([found.spread[kept] for found, kept in chosen])
        J = J * np.sqrt(spread / np.bincount(cell)[cell])[:, None, None]
        J = J.reshape(-1, J.shape[2]) / float(self.camera.kind.focal_length(self.camera.params))
        information = J.T @ J + self.prior * error**2
        scale = 1.0 / np.sqrt(np.diag(information))
        return np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)

    def cells(self, matches: Matches) -> IntArray:
        """Number the matches that agree by the cells of the image that they lie in."""
        middle = matches.segments2d.mean(axis=1)[self.line_inliers]
        return cells_of(np.concatenate([matches.points2d[self.point_inliers], middle]), self.camera, REFINEMENT.cells)

    def noise_covariance(self, cell: IntArray) -> FloatArray:
        """Covariance of the same by the noise of image and landmarks alone."""
        chosen = ((self.points, self.point_inliers), (self.lines, self.line_inliers))
        J = np.concatenate([found.by_pose[kept] for found, kept in chosen])
        r = np.concatenate([found.value[kept] for found, kept in chosen])
        scale = np.sqrt((J**2).sum(axis=(0, 1)))
        if not (scale > 0.0).all():
            return np.full((J.shape[2], J.shape[2]), np.inf)
        pull, sigma = _pull(r, J.shape[2])
        white = (J / scale).reshape(-1, len(scale))
        values, vectors = np.linalg.eigh(white.T @ white + sigma**2 * self.prior / np.outer(scale, scale))
        if not values[0] > _SINGULAR:
            return np.full((J.shape[2], J.shape[2]), np.inf)
        root = sigma * vectors / np.sqrt(values) / scale[:, None]
        count, dof = int(cell.max()) + 1, len(scale)
        pulled = (pull[:, :1] * J[:, 0] + pull[:, 1:] * J[:, 1]) @ (root / sigma**2)
        gradient = np.stack([np.bincount(cell, column, count) for column in pulled.T], axis=1)
        if count > dof:
            shared, axes = np.linalg.eigh(gradient.T @ gradient * (count / (count - dof)))
            by_chance = (1.0 + np.sqrt(dof / count)) ** 2  # the largest such eigenvalue of independent errors
            root = root @ axes * np.sqrt(np.where(shared > by_chance, shared, 1.0))
        return root @ root.T


def _pull(residual: FloatArray, unknowns: int) -> tuple[FloatArray, float]:
    r"""Return what each residual (n, 2) pulls under the last loss, and the standard deviation of an observation for an
    estimate by it.

    With the weight w(s) of a squared norm s, and pulls :math:`\psi = w r`, an M-estimate has the covariance of least
    squares with the variance :math:`E[\psi^2] / E[\psi']^2`; pulls are divided by :math:`E[\psi']`, too. To the
    variance that residuals show comes, counted as some more observations, that of normal noise as stated. It is not
    the ratio of averages: with few matches that would be too small.
    """
    scale = last_scale(len(residual))
    c, free = scale**2, max(residual.size - unknowns, 0)
    weight = (1.0 + (residual**2).sum(axis=1, keepdims=True) / c) ** -2
    # A fit makes residuals smaller than the noise; of a few matches so much that a loss would seem stiffer than it is.
    noise = residual * np.sqrt(residual.size / max(free, 1))
    square = (noise**2).sum(axis=1, keepdims=True)
    of_noise = (1.0 + square / c) ** -2
    # Derived from the loss: the derivative of what it pulls with.
    stiffness = of_noise - 4.0 * noise**2 / c * (1.0 + square / c) ** -3
    mean = max(float(stiffness.mean()), float(of_noise.mean()) ** 2)  # of far outliers the former may vanish
    shown = float(((of_noise * noise) ** 2).mean()) / mean**2
    square_of_normal, stiffness_of_normal = _of_normal_noise(scale)
    stated = 2.0 * REFINEMENT.stated_weight
    variance = (free * shown + stated * square_of_normal / stiffness_of_normal**2) / (free + stated)
    mean = (free * mean + stated * stiffness_of_normal) / (free + stated)
    return weight * residual / mean, float(np.sqrt(variance))


@lru_cache(maxsize=256)
def _of_normal_noise(scale: float) -> tuple[float, float]:
    """Mean square of a pull, and mean derivative, of a coordinate of normal noise under a Geman-McClure loss."""
    node, share = np.polynomial.laguerre.laggauss(40)
    square, c = 2.0 * node, scale**2  # chi square of two degrees
    weight = (1.0 + square / c) ** -2
    stiffness = weight - 2.0 * square / c * (1.0 + square / c) ** -3
    return float(share @ (weight**2 * square)) / 2.0, float(share @ stiffness)


def cells_of(pixels: FloatArray, camera: QueryCamera, cells: int) -> IntArray:
    """Number pixels (N, 2) by the cell of the image that they lie in, cells without any left out."""
    side = max(camera.width, camera.height) / cells
    place = np.floor(pixels / side).astype(np.int64)
    place -= place.min(axis=0, initial=0)
    number = place[:, 0] * (place[:, 1].max(initial=0) + 1) + place[:, 1]
    return np.unique(number, return_inverse=True)[1].ravel().astype(np.int64)


def refine(
    camera: QueryCamera,
    matches: Matches,
    start: FloatArray,
    max_error: tuple[float, float],
    lens: FreeLens | None = None,
    gathered: bool = False,
) -> Refined:
    """Fit a pose to what is near it, again to what is near then, until that stays the same; last with a narrow loss.

    Parameters
    ----------
    camera, matches
        The camera, and what may be seen.
    start : (7,)
        cam_from_world.
    max_error
        Matches of points and lines further from where a pose puts them, pixels, say nothing about pose and noise.
    lens
        What is estimated of the camera, too.
    gathered
        The matches were looked for near the start, as far as it may be off: all of them are near at first.
    """
    one, estimated = fit_to_near(camera, matches, start, max_error, lens, gathered)
    return fitted_at(one, estimated, matches, max_error, lens)


def fit_to_near(
    camera: QueryCamera,
    matches: Matches,
    start: FloatArray,
    max_error: tuple[float, float],
    lens: FreeLens | None = None,
    gathered: bool = False,
) -> tuple[OnePose, QueryCamera]:
    """Fit a pose as :func:`refine` does, without asking what agrees with it."""
    one = problem_of(camera, matches, start, lens is not None)
    limits = [
        (error / sigma) ** 2
        for error, sigma in zip(max_error, (matches.point_sigma, matches.segment_sigma), strict=True)
    ]
    near: tuple[BoolArray, BoolArray] | None = None
    for round_ in range(REFINEMENT.rounds + 1):
        weights, squares = weighed(one, matches)
        wide = gathered and round_ == 0
        before, near = near, (wide | (squares[0] <= limits[0]), wide | (squares[1] <= limits[1]))
        last = round_ == REFINEMENT.rounds or (before is not None and all(map(np.array_equal, near, before)))
        loss = GemanMcClure(last_scale(_agreeing(squares))) if last else Cauchy(REFINEMENT.wide_loss)
        moved = fit_pose(one, weights, near, loss, FINELY if last else ROUGHLY, lens)
        estimated = camera if lens is None else _camera_of(moved, camera)
        if estimated is None:
            break
        camera, one = estimated, moved
        if last:
            break
    return one, camera


def _agreeing(squares: tuple[FloatArray, FloatArray]) -> int:
    return int((np.concatenate(squares) <= chi_square_gate(NORMAL.outlier, 2)).sum())


def last_scale(agree: int) -> float:
    """Return the scale of the last loss for so many matches that agree, standard deviations.

    Where there are hardly more than the pose needs, a narrow loss picks those that happen to fit each other.
    """
    return REFINEMENT.last_loss * (1.0 + REFINEMENT.stated_weight / max(2 * agree - 6, 1))


def fitted(
    camera: QueryCamera,
    matches: Matches,
    pose: FloatArray,
    max_error: tuple[float, float],
    lens: FreeLens | None = None,
) -> Refined:
    """Say which matches agree with a pose as it is; parameters as of :func:`refine`."""
    return fitted_at(problem_of(camera, matches, pose, lens is not None), camera, matches, max_error, lens)


def fitted_at(
    one: OnePose, camera: QueryCamera, matches: Matches, max_error: tuple[float, float], lens: FreeLens | None = None
) -> Refined:
    """Return what :func:`fitted` does, where the problem at the pose is known."""
    weights = weighed(one, matches)[0]
    directions = None if lens is None else lens.directions(one.params)
    points = residuals(one, weights, "points", matches.num_points, directions)
    lines = residuals(one, weights, "lines", matches.num_lines, directions)
    sigma0 = _noise((points, lines), matches, max_error)
    limit = chi_square_gate(NORMAL.outlier, 2) * sigma0**2
    near = (points.square <= limit, (lines.square <= limit) & _in_front(camera, matches, one.pose))
    agree = [
        nearest_claims(claim, found.square, inside)
        for claim, found, inside in zip(matches.claims, (points, lines), near, strict=True)
    ]
    return Refined(one.pose, camera, points, lines, agree[0], agree[1], sigma0, limit, one, weights, lens)


def _in_front(camera: QueryCamera, matches: Matches, pose: FloatArray) -> BoolArray:
    """Which lines (M,) are in front of the camera where their segments are.

    The plane of a line and a segment is the same behind the camera, where a mirrored image would be seen.
    """
    if not matches.num_lines:
        return np.zeros(0, bool)
    ends = seen_from(pose, matches.segments3d)
    start, way = ends[:, 0], ends[:, 1] - ends[:, 0]
    ray = camera.kind.unproject(camera.params, np.ascontiguousarray(matches.segments2d.mean(axis=1)))
    along = np.einsum("ni,ni->n", way, ray)
    square = np.einsum("ni,ni->n", way, way)
    # How far along the ray it is nearest to the line; the denominator is not negative.
    return np.einsum("ni,ni->n", start, ray) * square > np.einsum("ni,ni->n", start, way) * along


def weighed(one: OnePose, matches: Matches) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, FloatArray]]:
    """Return the inverse noise (n, 2, 2) of the factors of a problem, which holds that of their landmarks, too, as they
    are seen from where its pose is; and squared residuals (N,) of points and (M,) of lines in its units, infinite where
    a match has no image.
    """
    covariances = {"points": matches.point_covariance, "lines": matches.line_covariance}
    squares = {"points": np.full(matches.num_points, np.inf), "lines": np.full(matches.num_lines, np.inf)}
    weights = []
    for part in one.parts:
        covariance, weight = covariances[part.kind], np.empty((len(part.row), 2, 2))
        record = one.records(part, "landmark")
        _weigh(part.noise, record, covariance, part.row, weight, squares[part.kind])
        weights.append(weight)
    return tuple(weights), (squares["points"], squares["lines"])


def _noise(found: tuple[Residuals, Residuals], matches: Matches, max_error: tuple[float, float]) -> float:
    """Noise that the residuals show beside what was stated, from those that are no outliers for sure.

    The median of what lies below a limit is too small where noise reaches the limit; the limit is wide.
    """
    sigmas = (matches.point_sigma, matches.segment_sigma)
    squares = [
        one.square[one.square <= (limit / sigma) ** 2]
        for one, sigma, limit in zip(found, sigmas, max_error, strict=True)
    ]
    together = np.concatenate(squares)
    if not len(together):
        return 1.0
    free = max(1.0 - 3.0 / len(together), 0.1)  # derived from six of two times so many numbers
    shown = float(np.median(together)) / (chi_square_gate(0.5, 2) * free)
    return float(
        np.sqrt((REFINEMENT.stated_weight + len(together) * shown) / (REFINEMENT.stated_weight + len(together)))
    )


def _camera_of(one: OnePose, camera: QueryCamera) -> QueryCamera | None:
    """The camera that was estimated; None where no lens is like that."""
    focal = one.params[list(camera.kind.focal_indices)]
    if not (np.isfinite(one.params).all() and (focal > 0.0).all()):
        return None
    return QueryCamera(camera.model, one.params, camera.width, camera.height)
