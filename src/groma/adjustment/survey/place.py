# SPDX-License-Identifier: BSD-3-Clause
r"""Where a whole scene fits its measurements best, its inner geometry as it is.

Images do not notice a similarity of the whole scene. Measurements of the ground do, but beside hundreds of thousands of
pixels they weigh little: damped steps creep along these seven directions. Here they are alone:

.. math:: \min_{s, R, t} \sum_i \rho\left(\lVert s R x_i + t - m_i \rVert^2_{\Sigma_i}\right)
          + \sum_j \rho\left((s\,d_j - \tilde d_j)^2 / \sigma_j^2\right)

by reweighted Gauss-Newton steps about the middle of the measured places.
"""

from __future__ import annotations

import math

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.terms.survey_loss import root_information, survey_loss
from groma.geometry import so3
from groma.scene import Scene, Similarity

_STEPS, _TOLERANCE = 50, 1e-6


def settled(scene: Scene) -> Scene:
    """Return a scene with positions or control points where these fit best; what was measured stays.

    The scale stays, too, where depths or stereo pairs tell it; scenes with poses known beforehand stay as they are.
    """
    if not scene.is_surveyed or len(scene.pose_priors):
        return scene
    moved = scene.transformed(_best(scene, with_scale=not scene.is_metric))
    points = moved.control_points.replace(
        measured=scene.control_points.measured, covariance=scene.control_points.covariance
    )
    return moved.replace(
        camera_positions=scene.camera_positions,
        camera_distances=scene.camera_distances,
        control_points=points,
        point_distances=scene.point_distances,
    )


def _best(scene: Scene, with_scale: bool) -> Similarity:
    seen, places, root = _measured_places(scene)
    lengths, distances, weights = _measured_distances(scene)
    middle = places.mean(axis=0)
    scale, rotation, shift = 1.0, np.eye(3), np.zeros(3)
    for _ in range(_STEPS):
        away = scale * ((seen - middle) @ rotation.T)
        residual = np.einsum("nij,nj->ni", root, away + middle + shift - places)
        cross = np.zeros((len(away), 3, 3))
        cross[:, [2, 0, 1], [1, 2, 0]], cross[:, [1, 2, 0], [2, 0, 1]] = away, -away
        J = root @ np.concatenate([np.broadcast_to(np.eye(3), cross.shape), -cross, away[:, :, None]], axis=2)
        weight = survey_loss(3).evaluate(np.einsum("ni,ni->n", residual, residual))[1]
        bars = (scale * lengths - distances) * weights
        bar_weight = survey_loss(1).evaluate(bars**2)[1]
        rows, of_bars = J.reshape(-1, 7), scale * lengths * weights
        weighted = rows * np.repeat(weight, 3)[:, None]
        normal, gradient = weighted.T @ rows, weighted.T @ residual.reshape(-1)
        normal[6, 6] += of_bars @ (bar_weight * of_bars)
        gradient[6] += of_bars @ (bar_weight * bars)
        step, free = np.zeros(7), 7 if with_scale else 6
        size = np.sqrt(np.maximum(np.diag(normal)[:free], 1e-300))
        scaled = normal[:free, :free] / size / size[:, None]
        step[:free] = -np.linalg.pinv(scaled, rcond=1e-13, hermitian=True) @ (gradient[:free] / size) / size
        shift, rotation = shift + step[:3], so3.exp(step[None, 3:6])[0] @ rotation
        scale *= math.exp(min(max(step[6], -1.0), 1.0))
        if np.abs(step[:free] * size).max() <= _TOLERANCE:  # in standard deviations
            break
    return Similarity(scale, rotation, middle + shift - scale * rotation @ middle)


def _measured_places(scene: Scene) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return places (N, 3) in the scene, where they were measured, and square roots (N, 3, 3) of the information."""
    positions, points = scene.camera_positions, scene.control_points
    held = points.is_control
    seen = np.concatenate([scene.cam_centers_in_world[positions.image_idx], points.xyz[held]])
    places = np.concatenate([positions.xyz, points.measured[held]])
    return seen, places, root_information(np.concatenate([positions.covariance, points.covariance[held]]))


def _measured_distances(scene: Scene) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return distances (M,) in the scene, as measured, and their inverse standard deviations."""
    tables = (scene.camera_distances, scene.cam_centers_in_world), (scene.point_distances, scene.control_points.xyz)
    seen = [np.linalg.norm(xyz[table.second_idx] - xyz[table.first_idx], axis=1) for table, xyz in tables]
    measured = [table.distance for table, _ in tables]
    return np.concatenate(seen), np.concatenate(measured), np.concatenate([1.0 / table.sigma for table, _ in tables])


__all__ = ["settled"]
