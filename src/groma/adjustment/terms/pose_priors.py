# SPDX-License-Identifier: BSD-3-Clause
"""Poses of frames known beforehand."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from groma.adjustment.terms.contract import Draft, Group, Term
from groma.factors.contract import Ref
from groma.factors.priors.pose_prior import PosePrior


def _factors(draft: Draft) -> Iterator[Group]:
    table = draft.scene.pose_priors
    yield Group(
        PosePrior(
            pose=Ref("frames", table.frame_idx),
            cam_from_world=table.rig_from_world,
            sqrt_information=(1.0 / table.sigma)[:, :, None] * np.eye(6),
        )
    )


TERM = Term("pose priors", ("pose_priors",), (), _factors)
