# SPDX-License-Identifier: BSD-3-Clause
r"""Measured places of camera centres, measured poses of cameras with their covariance, and frames known beforehand.

On rigs the pose of the rig is compared, the camera being held where it is on its rig at the start. A small error
:math:`\xi` of the camera's pose is :math:`\mathrm{Ad}(T_{bc})\,\xi` of that of its rig.

**Held scale.** Relations between landmarks are lengths, so a smaller scene fits them better: the sum of squares of N of
them falls with the square of the scale s. Poses known beforehand, with the information
:math:`I = \sum |c_i - \bar c|^2 / \sigma_i^2` on the logarithm of the scale, pull it back to about

.. math:: s = \frac{I}{I + N} .

Where that is too far from 1, the distance between two frames is held at what it is at the start, with as much
information as brings it near 1. Relations then say nothing of the scale, as in a scene without such poses
(:func:`~groma.adjustment.assemble.first_camera_gauge`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.survey_loss import root_information, survey_loss
from groma.factors.contract import Ref
from groma.factors.priors.distance import Distance
from groma.factors.priors.pose_prior import PosePrior
from groma.factors.priors.position_prior import PositionPrior
from groma.gates import gate
from groma.geometry import se3


@dataclass(frozen=True)
class HeldScaleGates:
    """When the scale is held, and how firmly."""

    max_shrinkage: float = gate(
        0.001, "1", "by which relations may shrink a scene", "convention: a millimetre of a metre"
    )


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
    scene, options, priors = draft.scene, draft.options, draft.scene.pose_priors
    if scene.has_scale or not (options.planes and options.refine_poses and options.structure_form == "metric"):
        return
    centers = se3.inverse(scene.frames.rig_from_world)[:, 4:]
    away = centers[priors.frame_idx] - centers[priors.frame_idx].mean(axis=0)
    information = float(np.sum((away / priors.sigma[:, :3]) ** 2))
    num_lengths = len(scene.relations.point_on_plane) + 2 * len(scene.relations.line_on_plane)
    apart = np.linalg.norm(centers - centers[0], axis=1)
    if num_lengths > GATES.max_shrinkage * information and apart.max() > 0.0:
        far = apart.argmax(keepdims=True)
        yield Group(
            Distance(
                first_camera=Ref("frames", np.zeros(1, dtype=np.intp)),
                second_camera=Ref("frames", far),
                distances=apart[far],
                first_arm=np.zeros((1, 3)),
                second_arm=np.zeros((1, 3)),
                sqrt_information=np.sqrt(num_lengths / GATES.max_shrinkage) / apart[far],
            )
        )


PRIORS = Term("pose priors", ("pose_priors",), (), _priors)
POSITIONS = Term("camera positions", ("camera_positions",), (), _positions)
POSES = Term("camera poses", ("camera_poses",), (), _poses)
HELD_SCALE = Term("held scale", ("pose_priors", "relations"), (), _held_scale)
