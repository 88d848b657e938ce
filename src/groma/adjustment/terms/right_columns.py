# SPDX-License-Identifier: BSD-3-Clause
r"""Points found in both images of rectified stereo pairs.

The observation in the left image and the column in the right one are one residual of three rows under one loss
(:mod:`groma.factors.observations.stereo_point`), so :mod:`groma.adjustment.terms.points` leaves these observations to
this term. Where the right cameras are not quite rectified (``right_turn``), the column is a measurement of its own: the
reprojection into a right camera that may turn, of which only the row of the column counts. With
:math:`x_n = (u - c_x)/f_x,\ y_n = (v - c_y)/f_y` small angles :math:`\omega` shift it by

.. math:: \delta u = f_x \big( \omega_y (1 + x_n^2) - \omega_x x_n y_n - \omega_z y_n \big),

so that columns tell yaw, :math:`\omega_y`, well and the others hardly; a prior holds them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.assembly_options import RightTurnPrior
from groma.adjustment.terms.contract import Draft, Group, Term
from groma.cameras import model as camera_model
from groma.errors import InputError
from groma.factors.contract import Ref
from groma.factors.observations.point_reprojection import PointReprojection
from groma.factors.observations.stereo_point import StereoPoint
from groma.factors.priors.pose_prior import PosePrior
from groma.geometry import quaternion
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.problem.variables import Variables

#: The group of the right cameras (cam_from_left_camera, one for each baseline) where they may turn.
RIGHT_CAMERAS = "right_cameras"


def measured_in_pairs(draft: Draft) -> BoolArray:
    """Which point observations are part of a residual with their column in the right image."""
    scene = draft.scene
    paired = np.zeros(len(scene.point_observations), dtype=bool)
    if len(scene.right_columns) and draft.options.right_turn is None:
        paired[_usable(draft)[1]] = True
    return paired


def _usable(draft: Draft) -> tuple[IntArray, IntArray]:
    """Rows of the table whose left camera has no distortion, and their observations."""
    scene = draft.scene
    observation = scene.right_columns.observation_idx
    rectified = np.array([camera_model(name).has_pinhole_parameters for name in scene.cameras.models], dtype=bool)
    image = scene.point_observations.image_idx[observation]
    rows = np.flatnonzero(rectified[scene.images.camera_idx[image]])
    return rows, observation[rows]


def _factors(draft: Draft) -> Iterator[Group]:
    scene, options = draft.scene, draft.options
    usable, observation = _usable(draft)
    if len(usable) < len(scene.right_columns):
        draft.notes.append("Left out: columns in right images of cameras with distortion. Rectify the pairs first.")
    if options.right_turn is not None:
        yield from _turned(draft, usable, observation, options.right_turn)
        return
    seen, table = scene.point_observations, scene.right_columns.take(usable)
    for _, rows, camera in draft.by_camera(seen.image_idx[observation]):
        left = observation[rows]
        baseline = table.baseline[rows]
        yield Group(
            StereoPoint(
                point=Ref("points", seen.point_idx[left]),
                pixels=np.column_stack([seen.pixel[left], table.u_right[rows]]),
                baseline=float(baseline[0]) if (baseline == baseline[0]).all() else baseline,
                sqrt_information=_weights(options.point_sigma_px * seen.sigma[left], table.sigma[rows]),
                loss=options.loss,
                **camera,
            ),
            observes="points",
        )


def _weights(left: FloatArray, right: FloatArray) -> FloatArray:
    """Inverse standard deviations (N,) where those of both images are the same, else matrices (N, 3, 3)."""
    if np.array_equal(left, right):
        return 1.0 / left
    out = np.zeros((len(left), 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = 1.0 / left
    out[:, 2, 2] = 1.0 / right
    return out


def _turned(draft: Draft, usable: IntArray, observation: IntArray, prior: RightTurnPrior) -> Iterator[Group]:
    """Columns in right cameras that may turn about their centres, and the prior that holds them."""
    scene, seen = draft.scene, draft.scene.point_observations
    if draft.has_rigs:
        raise InputError("right_turn needs a scene without rigs; its images are those of the left cameras.")
    table = scene.right_columns.take(usable)
    baselines, of = np.unique(table.baseline, return_inverse=True)
    centers = np.column_stack([baselines, np.zeros((len(baselines), 2))])
    turn = quaternion.exp(prior.angles[None])
    start = np.hstack([np.tile(turn, (len(baselines), 1)), -quaternion.rotate(turn, centers)])
    held = np.tile([True, True, True, False, False, False], (len(baselines), 1))
    draft.variables[RIGHT_CAMERAS] = Variables(POSE_CHARTS["left"], start, held)
    for name, rows, intrinsics in draft.by_model(seen.image_idx[observation]):
        left = observation[rows]
        weight = np.zeros((len(rows), 2, 2))
        weight[:, 0, 0] = 1.0 / (draft.options.point_sigma_px * table.sigma[rows])
        yield Group(
            PointReprojection(
                camera_model=name,
                point=Ref("points", seen.point_idx[left]),
                intrinsics=intrinsics,
                pixels=np.column_stack([table.u_right[rows], seen.pixel[left, 1]]),
                sqrt_information=weight,
                loss=draft.options.loss,
                pose=Ref("frames", scene.images.frame_idx[seen.image_idx[left]]),
                extrinsics=Ref(RIGHT_CAMERAS, of[rows]),
            )
        )
    weight = np.zeros((len(baselines), 6, 6))
    weight[:, 3:, 3:] = prior.sqrt_information
    yield Group(
        PosePrior(pose=Ref(RIGHT_CAMERAS, np.arange(len(baselines))), cam_from_world=start, sqrt_information=weight)
    )


TERM = Term("right columns", ("right_columns",), ("points",), _factors)
