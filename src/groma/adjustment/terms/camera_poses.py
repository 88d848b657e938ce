# SPDX-License-Identifier: BSD-3-Clause
r"""Measured places of camera centres, measured poses of cameras with their covariance, and frames known beforehand.

On rigs the pose of the rig is compared, the camera being held where it is on its rig at the start. A small error
:math:`\xi` of the camera's pose is :math:`\mathrm{Ad}(T_{bc})\,\xi` of that of its rig.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.survey_loss import root_information, survey_loss
from groma.factors.contract import Ref
from groma.factors.priors.pose_prior import PosePrior
from groma.factors.priors.position_prior import PositionPrior
from groma.geometry import se3


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


PRIORS = Term("pose priors", ("pose_priors",), (), _priors)
POSITIONS = Term("camera positions", ("camera_positions",), (), _positions)
POSES = Term("camera poses", ("camera_poses",), (), _poses)
