# SPDX-License-Identifier: BSD-3-Clause
"""Objects on planes with known coordinates: heights, floors, walls."""

from __future__ import annotations

from collections.abc import Iterator

from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.objects import SLOTS, arms_of, ref_of, rows_by_kind
from groma.adjustment.terms.survey_loss import survey_loss
from groma.factors.priors.on_known_plane import OnKnownPlane


def _factors(draft: Draft) -> Iterator[Group]:
    scene = draft.scene
    for (kind,), rows in rows_by_kind(draft.variables, scene.known_planes.kind):
        table = scene.known_planes.take(rows)
        yield Group(
            OnKnownPlane(
                **{SLOTS[kind]: ref_of(scene, kind, table.idx)},  # type: ignore[arg-type]
                known=table.hesse,
                arm=arms_of(scene, kind, table.idx, table.anchor),
                sqrt_information=1.0 / table.sigma,
                loss=survey_loss(1),
            )
        )


TERM = Term("known planes", ("known_planes",), (), _factors)
__all__ = ["TERM"]
