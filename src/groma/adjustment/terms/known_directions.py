# SPDX-License-Identifier: BSD-3-Clause
"""Directions known in the world: gravity in cameras, landmarks that are vertical."""

from __future__ import annotations

from collections.abc import Iterator

from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.objects import SLOTS, ref_of, rows_by_kind
from groma.adjustment.terms.survey_loss import survey_loss
from groma.factors.priors.known_direction import CameraDirection, KnownDirection
from groma.scene.survey import Kind


def _factors(draft: Draft) -> Iterator[Group]:
    scene = draft.scene
    for (kind,), rows in rows_by_kind(draft.variables, scene.known_directions.kind):
        table = scene.known_directions.take(rows)
        noise = {"sqrt_information": 1.0 / table.sigma, "loss": survey_loss(2)}
        if kind == Kind.IMAGE:
            refs = draft.camera_refs(table.idx)
            yield Group(CameraDirection(in_world=table.vector, in_camera=table.in_camera, **refs, **noise))  # type: ignore[arg-type]
        else:
            refs = {SLOTS[kind]: ref_of(scene, kind, table.idx)}
            yield Group(KnownDirection(known=table.vector, **refs, **noise))  # type: ignore[arg-type]


TERM = Term("known directions", ("known_directions",), (), _factors)
__all__ = ["TERM"]
