# SPDX-License-Identifier: BSD-3-Clause
r"""How well the views that a single camera starts with tell its motion and the depths of its points.

Depths err by the noise of their pixels, and motion and depths together by that noise and by what goes beyond it. What
is followed along the edge of something near, or through a lens that is not quite known, errs alike in a part of the
image. The reduced normal equations are sums over cells of the image, S and g of all and :math:`S_c, g_c` of a cell, and
gradients of cells that err independently tell a covariance of the motion,

.. math:: \Sigma = \sum_c \delta_c \delta_c^\top, \qquad
    \delta_c = -L^{-\top} (I - L^{-1} S_c L^{-\top})^{-1/2} L^{-1} g_c, \qquad S = L L^\top.

The root makes it right on average where few cells tell the motion. Of this and of the covariance at the stated noise,
:math:`S^{-1}`, the larger counts: a handful of cells may agree by chance. Log depths change with the motion; their
median, a change of scale, is taken out, so that the usual depth is the unit of length.

Reference: R. M. Bell, D. F. McCaffrey, *Bias reduction in standard errors for linear regression with multi-stage
samples*, 2002, eq. (7).
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.tracking.frame.camera import TrackCamera, into, rotation
from groma.tracking.frame.rectification import cells_of
from groma.tracking.pose.two_views import LOSS, Candidate


def start_deviation(camera: TrackCamera, candidate: Candidate, pixels: FloatArray, sigma: float) -> float:
    """Return the standard deviation of depths (the median) or of the last step, the larger, as shares; 1 if unknown.

    Parameters
    ----------
    camera, candidate
        The camera, and an adjusted motion, with points that agree with it.
    pixels : (V, N, 2) float64
        Pixels of the points in every view.
    sigma : float
        Their standard deviation, pixels.
    """
    noise, effect, S, g = _reduced(camera, candidate, pixels, sigma)
    cell = np.unique(cells_of(camera, pixels[0]), return_inverse=True)[1].ravel()
    count, agrees, step = int(cell.max()) + 1, candidate.agrees, candidate.poses[-1, 4:]
    if count < 2:
        return 1.0
    parts, pulls = np.zeros((count, *S.shape[1:])), np.zeros((count, g.shape[1]))
    np.add.at(parts, cell, S)
    np.add.at(pulls, cell, g)
    worst = 0.0
    for motion in _changes(parts, pulls - pulls.mean(axis=0)):
        depths = effect[agrees] @ motion.T
        scale = np.median(depths, axis=0)
        depth = np.sqrt(np.median(noise[agrees] + ((depths - scale) ** 2).sum(axis=1)))
        # The chart moves the centre of the camera along the axes of the camera.
        moved = np.linalg.norm(motion[:, -6:-3] - scale[:, None] * step) / np.linalg.norm(step)
        worst = max(worst, float(depth), float(moved))
    return worst


def _changes(parts: FloatArray, pulls: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return changes of the motion (., K) that sum to each covariance, from S (n, K, K) and g (n, K) of the cells."""
    inverse = np.linalg.inv(np.linalg.cholesky(parts.sum(axis=0)))
    values, vectors = np.linalg.eigh(inverse @ parts @ inverse.T)
    rest = np.maximum(1.0 - values, np.finfo(float).eps)
    white = ((pulls @ inverse.T)[:, None] @ vectors)[:, 0] / np.sqrt(rest)
    return inverse, -(vectors @ white[:, :, None])[:, :, 0] @ inverse


def _reduced(
    camera: TrackCamera, candidate: Candidate, pixels: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Variances (N,) of log depths with the motion held, what the motion adds to them (N, K), and what each point adds
    to the reduced normal equations (N, K, K) and to their gradient (N, K) of the K unknowns of the views but the first.

    Coordinates of points count in depths; a prior of one holds those that nothing tells.
    """
    places, count, views = candidate.places, len(candidate.places), len(pixels)
    K = 6 * (views - 1)
    V, W, H = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, K, 3)), np.zeros((count, K, K))
    g_point, g = np.zeros((count, 3)), np.zeros((count, K))
    for view, (pose, seen) in enumerate(zip(candidate.poses, pixels, strict=True)):
        point = into(pose, places)
        residual = (camera.project(point) - seen) / sigma
        front = np.isfinite(residual).all(axis=1)
        point, residual = np.where(front[:, None], point, [0.0, 0.0, 1.0]), np.where(front[:, None], residual, 0.0)
        weight = front * LOSS.evaluate((residual**2).sum(axis=1))[1]
        curvature = weight**2  # of a Cauchy loss on average over the directions of residuals
        J = np.zeros((count, 2, 3))
        J[:, [0, 1], [0, 1]] = np.array([camera.fx, camera.fy]) / (sigma * point[:, 2:])
        J[:, :, 2] = -J[:, [0, 1], [0, 1]] * point[:, :2] / point[:, 2:]
        J_point = J @ rotation(pose) * places[:, 2, None, None]
        V += np.einsum("n,nij,nik->njk", curvature, J_point, J_point)
        g_point += np.einsum("n,nij,ni->nj", weight, J_point, residual)
        if view:
            own = slice(6 * view - 6, 6 * view)
            J_pose = np.concatenate([J, np.cross(point[:, None], J)], axis=2)
            W[:, own] += np.einsum("n,nij,nik->njk", curvature, J_pose, J_point)
            H[:, own, own] += np.einsum("n,nij,nik->njk", curvature, J_pose, J_pose)
            g[:, own] += np.einsum("n,nij,ni->nj", weight, J_pose, residual)
    inverse: FloatArray = np.linalg.inv(V).astype(np.float64)
    back = W @ inverse
    S, pull = H - back @ np.swapaxes(W, 1, 2), g - np.einsum("nij,nj->ni", back, g_point)
    return inverse[:, 2, 2], -back[:, :, 2], S, pull
