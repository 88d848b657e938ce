# SPDX-License-Identifier: BSD-3-Clause
r"""Measured poses of cameras with their covariance.

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
from groma.geometry import se3


def _factors(draft: Draft) -> Iterator[Group]:
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


TERM = Term("camera poses", ("camera_poses",), (), _factors)
__all__ = ["TERM"]
