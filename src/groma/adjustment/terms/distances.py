# SPDX-License-Identifier: BSD-3-Clause
"""Measured distances between control points and between camera centres.

On rigs a centre is held where it is on its rig at the start.
"""

from __future__ import annotations

from collections.abc import Iterator

from groma._typing import FloatArray, IntArray
from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.survey_loss import survey_loss
from groma.factors.contract import Ref
from groma.factors.priors.camera_distance import CameraDistance
from groma.factors.priors.point_distance import PointDistance
from groma.geometry import se3


def _between_cameras(draft: Draft) -> Iterator[Group]:
    table, images = draft.scene.camera_distances, draft.scene.images
    yield Group(
        CameraDistance(
            first=Ref("frames", images.frame_idx[table.first_idx]),
            second=Ref("frames", images.frame_idx[table.second_idx]),
            distances=table.distance,
            first_arm=_arms(draft, table.first_idx),
            second_arm=_arms(draft, table.second_idx),
            sqrt_information=1.0 / table.sigma,
            loss=survey_loss(1),
        )
    )


def _arms(draft: Draft, image_idx: IntArray) -> FloatArray:
    """Return the centres (N, 3) of the cameras of images on their rigs."""
    scene = draft.scene
    return se3.inverse(scene.sensors.cam_from_rig[scene.images.sensor_idx[image_idx]])[:, 4:]


def _between_points(draft: Draft) -> Iterator[Group]:
    table = draft.scene.point_distances
    yield Group(
        PointDistance(
            first=Ref("control_points", table.first_idx),
            second=Ref("control_points", table.second_idx),
            distances=table.distance,
            sqrt_information=1.0 / table.sigma,
            loss=survey_loss(1),
        )
    )


BETWEEN_CAMERAS = Term("distances between cameras", ("camera_distances",), (), _between_cameras)
BETWEEN_POINTS = Term(
    "distances between control points", ("point_distances", "marks"), ("control_points",), _between_points
)
__all__ = ["BETWEEN_CAMERAS", "BETWEEN_POINTS"]
