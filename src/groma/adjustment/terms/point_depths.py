# SPDX-License-Identifier: BSD-3-Clause
"""Depths of points, as depth cameras measure them."""

from __future__ import annotations

from collections.abc import Iterator

from groma.adjustment.terms.contract import Draft, Group, Term
from groma.factors.contract import Ref
from groma.factors.observations.point_depth import PointDepth


def _factors(draft: Draft) -> Iterator[Group]:
    table = draft.scene.point_depths
    yield Group(
        PointDepth(
            point=Ref("points", table.point_idx),
            depths=table.depth,
            sqrt_information=1.0 / table.sigma,
            loss=draft.options.loss,
            **draft.camera_refs(table.image_idx),
        )
    )


TERM = Term("point depths", ("point_depths",), ("points",), _factors)
