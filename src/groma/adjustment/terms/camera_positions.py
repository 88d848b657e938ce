# SPDX-License-Identifier: BSD-3-Clause
"""Measured places of camera centres."""

from __future__ import annotations

from collections.abc import Iterator

from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.survey_loss import root_information, survey_loss
from groma.factors.priors.position_prior import PositionPrior


def _factors(draft: Draft) -> Iterator[Group]:
    table = draft.scene.camera_positions
    yield Group(
        PositionPrior(
            cam_center_in_world=table.xyz,
            sqrt_information=root_information(table.covariance),
            loss=survey_loss(3),
            **draft.camera_refs(table.image_idx),
        )
    )


TERM = Term("camera positions", ("camera_positions",), (), _factors)
__all__ = ["TERM"]
