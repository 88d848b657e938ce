# SPDX-License-Identifier: BSD-3-Clause
r"""The residual offset of a rectified pair, estimated from a finished map.

A rectification that is wrong by a fraction of a pixel shifts all disparities alike, and depths by
:math:`\delta z / z = -\delta / d`: a wrong scale, other for near points than for far ones. Motion tells the shape of
the scene without the pair, so near and far points together tell the offset. Here the right camera may turn a little
about the vertical axis, which shifts its columns, against a prior that holds it where the map does not tell.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma.factors.contract import Ref
from groma.factors.losses import Cauchy
from groma.factors.observations.point_reprojection import PointReprojection
from groma.factors.priors.pose_prior import PosePrior
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.tracking.backend.local_adjustment import job_of
from groma.tracking.frame.camera import PINHOLE, TrackCamera, rotation
from groma.tracking.frame.measurements import point_factors
from groma.tracking.map.track_map import TrackMap

#: Standard deviation of the offset before anything is known, pixels.
PRIOR_PX = 0.5
#: Keyframes and measured pairs that an estimate needs.
MIN_KEYFRAMES, MIN_PAIRS = 5, 200
#: Larger offsets are not a matter of fractions of a pixel, and are left alone.
MAX_PX = 1.5


def estimate_offset(track_map: TrackMap, camera: TrackCamera) -> float:
    """Return by how much columns in the right image are too large, pixels; 0 where the map does not tell."""
    living = track_map.living()
    if len(living) < MIN_KEYFRAMES or not camera.baseline > 0:
        return 0.0
    held = np.zeros(len(living), dtype=bool)
    held[0] = True
    job = job_of(track_map, camera, living, held, relations=False, max_iterations=25)
    if job is None:
        return 0.0
    table, pose = job.point_table, job.point_pose
    rows = np.flatnonzero(np.isfinite(table.right))
    if len(rows) < MIN_PAIRS:
        return 0.0
    local = np.searchsorted(job.points, table.index)
    single = replace(table, index=local, right=np.full(len(table), np.nan))
    weight = np.zeros((len(rows), 2, 2))
    weight[:, 0, 0] = 1.0 / table.sigma[rows]
    start = np.array([[0, 0, 0, 1, -camera.baseline, 0, 0.0]])
    none = np.zeros(len(rows), np.int64)
    only_turn = np.array([[True, True, True, True, False, True]])
    right = PointReprojection(
        pose=Ref("poses", pose[rows]), point=Ref("points", local[rows]),
        intrinsics=Ref("intrinsics", none), extrinsics=Ref("right", none),
        camera_model=PINHOLE, pixels=np.column_stack([table.right[rows], table.pixel[rows, 1]]),
        sqrt_information=weight, loss=Cauchy(2.0),
    )  # fmt: skip
    prior = PosePrior(
        pose=Ref("right", none[:1]), cam_from_world=start,
        sqrt_information=np.diag([1.0, 1.0, 1.0, 1.0, camera.fx / PRIOR_PX, 1.0])[None],
    )  # fmt: skip
    variables = {name: job.problem.variables[name] for name in ("poses", "points", "intrinsics")}
    variables["right"] = Variables(POSE_CHARTS["left"], start, only_turn)
    job.problem = Problem(variables, [*point_factors(camera, single, pose, Cauchy(2.0)), right, prior])
    job.solve()
    assert job.solved is not None
    axis = rotation(job.solved.variables["right"].state[0])[:, 2]
    offset = camera.fx * float(axis[0] / axis[2])
    return offset if abs(offset) < MAX_PX else 0.0


def correct_offset(track_map: TrackMap, camera: TrackCamera, offset: float) -> None:
    """Take an offset out of all measured columns, and out of the inverse depths along segments."""
    for keyframe in track_map.living():
        points, lines = keyframe.measured.points, keyframe.measured.lines
        points = replace(points, right=points.right - offset)
        inverse = lines.inverse_depth + offset / (camera.fx * camera.baseline)
        keyframe.measured = replace(keyframe.measured, points=points, lines=replace(lines, inverse_depth=inverse))


__all__ = ["correct_offset", "estimate_offset"]
