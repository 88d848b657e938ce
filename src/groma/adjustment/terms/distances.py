# SPDX-License-Identifier: BSD-3-Clause
"""Measured distances between cameras, control points, lines and planes.

On rigs a centre is held where it is on its rig at the start.
"""

from __future__ import annotations

from collections.abc import Iterator

from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.objects import SLOTS, arms_of, ref_of, rows_by_kind
from groma.adjustment.terms.survey_loss import survey_loss
from groma.factors.priors.distance import Distance


def _factors(draft: Draft) -> Iterator[Group]:
    scene = draft.scene
    for (first, second), rows in rows_by_kind(draft.variables, scene.distances.first_kind, scene.distances.second_kind):
        table = scene.distances.take(rows)
        refs = {
            f"first_{SLOTS[first]}": ref_of(scene, first, table.first_idx),
            f"second_{SLOTS[second]}": ref_of(scene, second, table.second_idx),
        }
        yield Group(
            Distance(
                **refs,
                distances=table.distance,
                first_arm=arms_of(scene, first, table.first_idx, table.anchor),
                is_shortest=table.is_shortest,
                second_arm=arms_of(scene, second, table.second_idx, table.anchor),
                sqrt_information=1.0 / table.sigma,
                loss=survey_loss(1),
            )
        )


TERM = Term("distances", ("distances",), (), _factors)
