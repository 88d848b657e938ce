# SPDX-License-Identifier: BSD-3-Clause
"""Known planes and directions: heights, floors, walls; gravity in cameras, landmarks that are vertical."""

from __future__ import annotations

from collections.abc import Iterator

from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.objects import SLOTS, arms_of, ref_of, rows_by_kind
from groma.adjustment.terms.survey_loss import survey_loss
from groma.factors.priors.known_direction import CameraDirection, KnownDirection
from groma.factors.priors.on_known_plane import OnKnownPlane
from groma.scene.survey import Kind


def _directions(draft: Draft) -> Iterator[Group]:
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


def _planes(draft: Draft) -> Iterator[Group]:
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


PLANES = Term("known planes", ("known_planes",), (), _planes)
DIRECTIONS = Term("known directions", ("known_directions",), (), _directions)
