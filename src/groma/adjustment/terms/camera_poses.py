# SPDX-License-Identifier: BSD-3-Clause
r"""Measured places of camera centres, measured poses of cameras with their covariance, and frames known beforehand.

On rigs the pose of the rig is compared, the camera being held where it is on its rig at the start. A small error
:math:`\xi` of the camera's pose is :math:`\mathrm{Ad}(T_{bc})\,\xi` of that of its rig.

**Held scale.** Relations between landmarks are lengths, so a smaller scene fits them better: the sum of squares of N of
them falls with the square of the scale s. Poses, positions, control points and distances that are known pull it back.
With places :math:`x_i` of the information :math:`W_i` about their weighted mean, they tell of its logarithm

.. math:: I = \sum_i (x_i - \bar x)^\top W_i (x_i - \bar x) + \sum_j (d_j / \sigma_j)^2, \qquad s = \frac{I}{I + N} .

Where that is too far from 1, the distance between two frames is held at what it is at the start, with as much
information as brings it near 1. Relations then say nothing of the scale, as in a scene without such measurements
(:func:`~groma.adjustment.assemble.first_camera_gauge`); where others than poses tell it, the whole scene gets it from
them before and after (:func:`~groma.adjustment.survey.best_fit.best_fitted`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.survey_loss import root_information, survey_loss
from groma.factors.contract import Factor, Ref
from groma.factors.losses import Trivial
from groma.factors.priors.distance import Distance
from groma.factors.priors.pose_prior import PosePrior
from groma.factors.priors.position_prior import PositionPrior
from groma.gates import gate
from groma.geometry import se3
from groma.problem.problem import Problem
from groma.scene import Scene


@dataclass(frozen=True)
class HeldScaleGates:
    """When the scale is held, and how firmly."""

    max_shrinkage: float = gate(0.001, "1", "by which relations may shrink a scene", "convention: a millimetre a metre")


#: The defaults.
GATES = HeldScaleGates()


def _poses(draft: Draft) -> Iterator[Group]:
    table, images = draft.scene.camera_poses, draft.scene.images
    rig_from_cam = se3.inverse(draft.scene.sensors.cam_from_rig[images.sensor_idx[table.image_idx]])
    turned = se3.adjoint(rig_from_cam)
    yield Group(
        PosePrior(
            pose=Ref("frames", images.frame_idx[table.image_idx]),
            cam_from_world=se3.compose(rig_from_cam, table.cam_from_world),
            sqrt_information=root_information(turned @ table.covariance @ np.swapaxes(turned, 1, 2)),
            loss=survey_loss(6),
        )
    )


def _positions(draft: Draft) -> Iterator[Group]:
    table = draft.scene.camera_positions
    yield Group(
        PositionPrior(
            cam_center_in_world=table.xyz,
            sqrt_information=root_information(table.covariance),
            loss=survey_loss(3),
            **draft.camera_refs(table.image_idx),
        )
    )


def _priors(draft: Draft) -> Iterator[Group]:
    table = draft.scene.pose_priors
    yield Group(
        PosePrior(
            pose=Ref("frames", table.frame_idx),
            cam_from_world=table.rig_from_world,
            sqrt_information=(1.0 / table.sigma)[:, :, None] * np.eye(6),
        )
    )


def _held_scale(draft: Draft) -> Iterator[Group]:
    scene, options = draft.scene, draft.options
    told = len(scene.pose_priors) > 0 or scene.has_scale
    if scene.is_metric or not (told and options.planes and options.refine_poses and options.structure_form == "metric"):
        return
    information = _information_on_scale(scene)
    num_lengths = lengths_on_planes(scene) if options.num_lengths is None else options.num_lengths
    centers = se3.inverse(scene.frames.rig_from_world)[:, 4:]
    apart = np.linalg.norm(centers - centers[0], axis=1)
    if num_lengths <= GATES.max_shrinkage * information or apart.max() == 0.0:
        return
    if scene.has_scale and information > 0.0:
        draft.notes.append(
            f"Measurements determine the scale to {100.0 * information**-0.5:.2g} % (standard deviation). Relations "
            "with planes would shrink the scene against them: the scale was held in the adjustment."
        )
    far = apart.argmax(keepdims=True)
    yield Group(
        Distance(
            first_camera=Ref("frames", np.zeros(1, dtype=np.intp)),
            second_camera=Ref("frames", far),
            distances=apart[far],
            first_arm=np.zeros((1, 3)),
            second_arm=np.zeros((1, 3)),
            sqrt_information=(num_lengths / GATES.max_shrinkage) ** 0.5 / apart[far],
        )
    )


def lengths_on_planes(scene: Scene) -> int:
    """Return how many lengths relations with planes compare with zero."""
    return len(scene.relations.point_on_plane) + 2 * len(scene.relations.line_on_plane)


def held_scale(problem: Problem) -> Factor | None:
    """Return the factor that holds the scale of a problem; measured distances have a robust loss."""
    held = (one for one in problem.factors if isinstance(one, Distance) and isinstance(one.loss, Trivial))
    return next(held, None)


def _information_on_scale(scene: Scene) -> float:
    """Return the information of measurements other than relations on the logarithm of the scale."""
    frames, table = scene.frames.rig_from_world, scene.pose_priors
    positions, poses, points = scene.camera_positions, scene.camera_poses, scene.control_points
    centers, control = scene.cam_centers_in_world, points.is_control
    priors = np.eye(3) * table.sigma[:, None, :3] ** 2
    found = [
        (se3.inverse(frames)[table.frame_idx, 4:], _in_world(priors, frames[table.frame_idx])),
        (centers[positions.image_idx], positions.covariance),
        (centers[poses.image_idx], _in_world(poses.covariance[:, :3, :3], scene.cam_from_world[poses.image_idx])),
        (points.xyz[control], points.covariance[control]),
    ]
    places, covariances = (np.concatenate(part) for part in zip(*found, strict=True))
    lengths = float(np.sum((scene.distances.distance / scene.distances.sigma) ** 2))
    if len(places) == 0:
        return lengths
    weights = np.linalg.inv(covariances)
    mean = np.linalg.solve(weights.sum(axis=0), np.einsum("nij,nj->i", weights, places))
    return lengths + float(np.einsum("ni,nij,nj->", places - mean, weights, places - mean))


def _in_world(covariance: FloatArray, cam_from_world: FloatArray) -> FloatArray:
    """Return covariances (N, 3, 3) along the axes of cameras along those of the world."""
    R = se3.to_matrix(cam_from_world)[:, :3, :3]
    return np.swapaxes(R, 1, 2) @ covariance @ R


PRIORS = Term("pose priors", ("pose_priors",), (), _priors)
POSITIONS = Term("camera positions", ("camera_positions",), (), _positions)
POSES = Term("camera poses", ("camera_poses",), (), _poses)
HELD_SCALE = Term("held scale", ("relations",), (), _held_scale)
