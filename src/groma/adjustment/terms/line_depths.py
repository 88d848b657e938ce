# SPDX-License-Identifier: BSD-3-Clause
r"""Inverse depths of the ends of observed segments.

As a factor each is the reprojection into a second camera, displaced by the baseline b across the segment (along x or
y, whichever the segment is farther from), where an end at inverse depth w appears at :math:`u - f b w`. A straight line
stays straight in inverse depth, and depth cameras and stereo pairs know it with even noise. The second cameras are a
constant group of poses for each baseline; on rigs they are held where the rig is at the start.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.lines import line_sigma_px
from groma.cameras import model as camera_model
from groma.factors.contract import Factor, Ref
from groma.factors.observations.line_bearing import LineBearing
from groma.factors.observations.line_reprojection import LineReprojection
from groma.geometry import se3
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.problem.variables import Variables


def _factors(draft: Draft) -> Iterator[Group]:
    table, seen = draft.scene.line_depths, draft.scene.line_observations
    for name, members, intrinsics in draft.by_model(seen.image_idx[table.observation_idx]):
        for baseline in np.unique(table.baseline[members]):
            mine = np.flatnonzero(table.baseline[members] == baseline)
            factor = _of_baseline(draft, name, members[mine], Ref(intrinsics.group, intrinsics.index[mine]), baseline)
            yield Group(factor)


def _of_baseline(draft: Draft, name: str, rows: IntArray, intrinsics: Ref, baseline: float) -> Factor:
    table, seen = draft.scene.line_depths, draft.scene.line_observations
    of = table.observation_idx[rows]
    image, ends = seen.image_idx[of], seen.segment[of]
    params, model = draft.params(name, image), camera_model(name)
    way = np.abs(ends[:, 2:] - ends[:, :2])
    flat: BoolArray = np.asarray(way[:, 0] > way[:, 1])  # displaced along y, else along x
    focal = model.focal_length(params)
    if model.is_planar:
        focal = np.where(flat, params[:, model.focal_indices[-1]], params[:, model.focal_indices[0]])
    noise = focal[:, None] * baseline * table.sigma[rows]
    noise = np.sqrt(noise**2 + line_sigma_px(draft)[of, None] ** 2)
    common = {
        "pose": Ref("frames", draft.scene.images.frame_idx[image]),
        "line": Ref("lines", seen.line_idx[of]),
        "extrinsics": _second_cameras(draft, baseline, image, flat),
        "loss": draft.options.loss,
    }
    shift, axis = baseline * table.inverse_depth[rows], np.where(flat, 1, 0)
    if model.has_pinhole_parameters:
        shift = focal[:, None] * baseline * table.inverse_depth[rows]
        every, ends = np.arange(len(rows)), ends.copy()
        ends[every, axis] -= shift[:, 0]
        ends[every, 2 + axis] -= shift[:, 1]
        return LineReprojection(
            intrinsics=intrinsics, camera_model=name, segments=ends, sqrt_information=_diagonal(1.0 / noise), **common
        )
    bearings = [_shifted(model.unproject(params, ends[:, k : k + 2]), axis, shift[:, k // 2]) for k in (0, 2)]
    return LineBearing(
        start_bearings=bearings[0],
        end_bearings=bearings[1],
        sqrt_information=_diagonal(focal[:, None] / noise),
        **common,
    )


def _second_cameras(draft: Draft, baseline: float, image: IntArray, flat: BoolArray) -> Ref:
    """Return the references to cameras displaced along x, or along y where ``flat``; their group is added."""
    group = f"second_cameras/{baseline!r}"
    displaced = np.array([[0, 0, 0, 1, -baseline, 0, 0], [0, 0, 0, 1, 0, -baseline, 0.0]])
    if not draft.has_rigs:
        draft.variables[group] = Variables(POSE_CHARTS["left"], displaced, constant=True)
        return Ref(group, flat.astype(int))
    mounted = draft.scene.sensors.cam_from_rig
    poses = se3.compose(np.tile(displaced, (len(mounted), 1)), np.repeat(mounted, 2, axis=0))
    draft.variables[group] = Variables(POSE_CHARTS["left"], poses, constant=True)
    return Ref(group, 2 * draft.scene.images.sensor_idx[image] + flat)


def _shifted(bearings: FloatArray, axis: IntArray, shift: FloatArray) -> FloatArray:
    """Rays (N, 3), in front, as the displaced camera sees them."""
    rays = bearings / bearings[:, 2:]
    rays[np.arange(len(rays)), axis] -= shift
    return rays


def _diagonal(values: FloatArray) -> FloatArray:
    out = np.zeros((*values.shape, values.shape[1]))
    out[:, np.arange(values.shape[1]), np.arange(values.shape[1])] = values
    return out


TERM = Term("line depths", ("line_depths",), ("lines",), _factors)
