# SPDX-License-Identifier: BSD-3-Clause
"""Control points: their marks in the images, and the coordinates of those that hold the scene.

The marks of check points count, as those of any point: what checks the result are the coordinates. Marks have the loss
of what was measured and not that of matches: under one that lets go of what is far, a wrong distance would take a point
away from all its marks.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.readout import point_refs
from groma.adjustment.terms.survey_loss import root_information, survey_loss
from groma.factors.contract import Ref
from groma.factors.observations.point_reprojection import PointReprojection
from groma.factors.priors.vector_prior import VectorPrior


def _marks(draft: Draft) -> Iterator[Group]:
    table, xyz = draft.scene.marks, draft.scene.control_points.xyz
    for name, rows, camera in draft.by_camera(table.image_idx):
        yield Group(
            PointReprojection(
                point=Ref("control_points", table.point_idx[rows]),
                pixels=table.pixel[rows],
                require_in_front=draft.options.require_in_front,
                sqrt_information=1.0 / table.sigma[rows],
                loss=survey_loss(2),
                **camera,
                **point_refs(draft, name, table.image_idx[rows], xyz[table.point_idx[rows]], table.pixel[rows]),
            )
        )


def _control(draft: Draft) -> Iterator[Group]:
    table = draft.scene.control_points
    held = np.flatnonzero(table.is_control)
    if len(held):
        yield Group(
            VectorPrior(
                variable=Ref("control_points", held),
                measured=table.measured[held],
                sqrt_information=root_information(table.covariance[held]),
                loss=survey_loss(3),
            )
        )


MARKS = Term("marks", ("marks",), ("control_points",), _marks)
CONTROL = Term("control points", ("control_points", "marks"), ("control_points",), _control)
