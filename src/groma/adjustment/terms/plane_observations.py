# SPDX-License-Identifier: BSD-3-Clause
r"""Planes measured in the camera, compared in one of two ways.

``normal_offset``: two angles of the normal and the offset, in the camera where they were measured
(:mod:`groma.factors.observations.plane_observation`).

``quaternion``: planes as unit quaternions in the world (:mod:`groma.factors.observations.plane_quaternion`). Its
residual depends on the origin and the unit of length; so that the noise stays that of the measurement, it is
multiplied by the inverse of the matrix G that takes small errors of the measured angles and offset into it, at the
start. With the measured plane in the world :math:`y = T^\top(\tilde n, \tilde w)` and the map Q(y) of that file,

.. math:: G = Q(y)\, T^\top \begin{bmatrix} B & 0 \\ 0 & 1 \end{bmatrix} .
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.terms.contract import Draft, Group, Term
from groma.factors.contract import Ref
from groma.factors.observations.plane_observation import PlaneObservation
from groma.factors.observations.plane_quaternion import PlaneQuaternion
from groma.geometry import se3


def _factors(draft: Draft) -> Iterator[Group]:
    table = draft.scene.plane_observations
    factor = PlaneObservation(
        plane=Ref("planes", table.plane_idx),
        planes_in_cam=table.plane_in_cam,
        sqrt_information=table.sqrt_information,
        loss=draft.options.loss,
        **draft.camera_refs(table.image_idx),
    )
    if draft.options.plane_residual == "quaternion":
        poses = draft.scene.cam_from_world[table.image_idx]
        factor = PlaneQuaternion(
            plane=factor.plane,
            planes_in_cam=table.plane_in_cam,
            sqrt_information=table.sqrt_information @ np.linalg.inv(_residual_of_errors(poses, factor)),
            loss=draft.options.loss,
            **draft.camera_refs(table.image_idx),
        )
    yield Group(factor)


def _residual_of_errors(poses: FloatArray, measured: PlaneObservation) -> FloatArray:
    """The matrices G (N, 3, 3)."""
    count = len(measured)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3] = se3.to_matrix(poses)[:, :3]
    back = np.swapaxes(T, 1, 2)
    y = np.einsum("nij,nj->ni", back, measured.planes_in_cam)
    Q = np.zeros((count, 3, 4))
    Q[:, :, :3] = y[:, 3, None, None] * np.eye(3) + np.swapaxes(np.cross(y[:, None, :3], np.eye(3)[None]), 1, 2)
    Q[:, :, 3] = -y[:, :3]
    errors = np.zeros((count, 4, 3))
    errors[:, :3, :2], errors[:, 3, 2] = measured.basis, 1.0
    return (2.0 / np.einsum("ni,ni->n", y, y))[:, None, None] * Q @ back @ errors


TERM = Term("plane observations", ("plane_observations",), ("planes",), _factors)
