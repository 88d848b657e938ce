# SPDX-License-Identifier: BSD-3-Clause
"""Points seen in images: reprojection errors in pixels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from groma._counted import counted
from groma._typing import BoolArray
from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.readout import point_refs
from groma.adjustment.terms.right_columns import measured_in_pairs
from groma.cameras import model as camera_model
from groma.factors.contract import Ref
from groma.factors.observations.point_reprojection import PointReprojection
from groma.geometry import se3


def _factors(draft: Draft) -> Iterator[Group]:
    table, options = draft.scene.point_observations, draft.options
    keep = _in_front(draft) & ~measured_in_pairs(draft)
    table = table.take(np.flatnonzero(keep)) if not keep.all() else table
    xyz = draft.scene.points.xyz
    for name, rows, camera in draft.by_camera(table.image_idx):
        yield Group(
            PointReprojection(
                point=Ref("points", table.point_idx[rows]),
                pixels=table.pixel.take(rows, axis=0),
                require_in_front=options.require_in_front,
                sqrt_information=1.0 / (options.point_sigma_px * table.sigma[rows]),
                loss=options.loss,
                **camera,
                **point_refs(draft, name, table.image_idx[rows], xyz[table.point_idx[rows]], table.pixel[rows]),
            ),
            observes="points",
        )


def _in_front(draft: Draft) -> BoolArray:
    """Which observations are of points in front of their camera; all if none are to be dropped."""
    scene, table = draft.scene, draft.scene.point_observations
    if not draft.options.drop_behind:
        return np.ones(len(table), dtype=bool)
    row = se3.to_matrix(scene.cam_from_world)[:, 2].take(table.image_idx, axis=0)
    depth = np.einsum("ni,ni->n", row[:, :3], scene.points.xyz.take(table.point_idx, axis=0)) + row[:, 3]
    sees_behind = np.array([camera_model(name).sees_behind for name in scene.cameras.models])
    keep: BoolArray = (depth > 0) | sees_behind[scene.images.camera_idx][table.image_idx]
    if not keep.all():
        draft.notes.append(f"Left out: {counted(int((~keep).sum()), 'observations')} of points behind their camera.")
    return keep


TERM = Term("point observations", ("point_observations",), ("points",), _factors)
