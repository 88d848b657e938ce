# SPDX-License-Identifier: BSD-3-Clause
"""Structural relations between landmarks, as lengths and angles."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.terms.contract import Draft, Group, Term
from groma.cameras import model as camera_model
from groma.factors.contract import Factor, Ref
from groma.factors.relations.direction_pairs import (
    DirectionPair,
    LineDirection,
    OrthogonalDirections,
    OrthogonalPlanes,
    ParallelDirections,
    ParallelPlanes,
    PlaneParallelToDirection,
    PlanePerpendicularToDirection,
)
from groma.factors.relations.line_on_plane import SegmentOnPlane
from groma.factors.relations.lines_meeting import LinesMeeting
from groma.factors.relations.point_on_line import PointOnLine
from groma.factors.relations.point_on_plane import PointOnPlane
from groma.geometry import quaternion
from groma.scene import Relations, Scene

#: Angles between planes and directions, and the types of their factors.
ANGLES: dict[str, type[DirectionPair]] = {
    "parallel_planes": ParallelPlanes,
    "perpendicular_planes": OrthogonalPlanes,
    "parallel_directions": ParallelDirections,
    "perpendicular_directions": OrthogonalDirections,
    "plane_across_direction": PlanePerpendicularToDirection,
    "plane_along_direction": PlaneParallelToDirection,
}
_TYPES: dict[str, type[Factor]] = {
    "point_on_plane": PointOnPlane,
    "point_on_line": PointOnLine,
    "lines_meeting": LinesMeeting,
    "line_on_plane": SegmentOnPlane,
    "line_along_direction": LineDirection,
    **ANGLES,
}
#: Types of the factors of relations, and the relation of the scene each stands for.
RELATION_FACTORS = {factor.type_name: kind for kind, factor in _TYPES.items()}
#: How parallel or perpendicular planes and directions without a standard deviation of their own are, radians
#: (convention: 0.7 degrees).
_ANGLE_SIGMA = math.radians(0.7)


def lengths_per_pixel(scene: Scene, kind: str) -> FloatArray:
    r"""Return the length that a pixel spans at the distance of each landmark, the mean over its images, scene units.

    .. math:: \frac{1}{n} \sum_i |X - C_i| / f_i

    Landmarks that no image sees get the median over all observations.

    Parameters
    ----------
    scene : Scene
        Cameras and landmarks.
    kind : "point" or "line"
        Of which landmarks; lines count at the middle of their segments.

    Returns
    -------
    (P,) or (L,) float64
    """
    if kind == "point":
        image_idx, index, places = (
            scene.point_observations.image_idx, scene.point_observations.point_idx, scene.points.xyz,
        )  # fmt: skip
    else:
        image_idx, index, places = (
            scene.line_observations.image_idx, scene.line_observations.line_idx, scene.lines.segments.mean(axis=1),
        )  # fmt: skip
    focal_of = np.array(
        [
            float(camera_model(name).focal_length(scene.cameras.params_of(c)))
            for c, name in enumerate(scene.cameras.models)
        ]
    )
    away = scene.cam_centers_in_world.take(image_idx, axis=0) - places.take(index, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):  # a focal length of zero is refused where a problem is made
        length = np.sqrt(np.einsum("ni,ni->n", away, away)) / focal_of[scene.images.camera_idx][image_idx]
    count = np.bincount(index, minlength=len(places))
    mean = np.bincount(index, weights=length, minlength=len(places)) / np.maximum(count, 1)
    fallback = float(np.median(length)) if len(length) else 1.0
    return np.where(count > 0, mean, fallback)


def _weights(draft: Draft, kind: str, rows: IntArray) -> FloatArray:
    """Inverse standard deviations: those of the relations, else of angles by options and of lengths by images."""
    relations, segments = draft.scene.relations, draft.scene.lines.segments
    sigma, landmark = relations.sigma(kind)[rows], getattr(relations, kind)[rows, 0]
    if kind in ANGLES:
        return 1.0 / np.where(sigma > 0.0, sigma, _ANGLE_SIGMA)
    if (sigma > 0.0).all():
        return 1.0 / sigma
    of = "point" if kind.startswith("point") else "line"
    usual = draft.options.structure_sigma_px * lengths_per_pixel(draft.scene, of)[landmark]
    weights = 1.0 / np.where(sigma > 0.0, sigma, usual)
    if kind == "line_along_direction":  # the noise of the ends of a line is that of its angle at half its length
        half = np.maximum(0.5 * np.linalg.norm(segments[landmark, 1] - segments[landmark, 0], axis=1), 1e-12)
        weights = np.where(sigma > 0.0, weights, weights * half)
    return weights


def metric_rows(draft: Draft, kind: str) -> IntArray:
    """Return the relations of a kind that are measured in lengths: all, or those with a standard deviation."""
    count = len(getattr(draft.scene.relations, kind))
    if kind == "point_on_line" and draft.scene.num_lines > draft.options.max_coupled_lines:
        return np.zeros(0, np.int64)
    if kind == "lines_meeting":
        return np.arange(count if draft.options.meeting_lines else 0)
    if draft.options.structure_form == "metric" or kind in ANGLES:
        return np.arange(count)
    return np.flatnonzero(draft.scene.relations.sigma(kind) > 0.0)


def _factors(draft: Draft) -> Iterator[Group]:
    """Yield the factors of the relations whose landmarks take part."""
    for kind, factor in _TYPES.items():
        groups = _groups(kind)
        if not (set(groups) <= draft.variables.keys() and len(rows := metric_rows(draft, kind))):
            continue
        pairs = getattr(draft.scene.relations, kind)[rows]
        columns: dict[str, Any] = {
            slot.name: Ref(group, index) for slot, group, index in zip(factor.slots[:2], groups, pairs.T, strict=True)
        }
        if kind == "line_on_plane":
            columns |= _ends(draft, pairs[:, 0])
        yield Group(factor(**columns, sqrt_information=_weights(draft, kind, rows), loss=draft.relation_loss))


def _ends(draft: Draft, lines: IntArray) -> dict[str, Any]:
    """Return the ends of segments: where the whole scene may move, in the frame of a camera that moves with it."""
    scene, ends, options = draft.scene, draft.scene.lines.segments[lines], draft.options
    moves = options.refine_poses and options.held_frames is None
    if not (moves and (options.gauge == "free" or scene.is_tied)):
        return {"ends": ends}
    table, frame = scene.line_observations, np.zeros(scene.num_lines, np.int64)
    frame[table.line_idx] = scene.images.frame_idx[table.image_idx]  # any that sees the line
    poses = scene.frames.rig_from_world[frame[lines]]
    turned = quaternion.rotate(np.repeat(poses[:, :4], 2, axis=0), ends.reshape(-1, 3)).reshape(ends.shape)
    return {"frame": Ref("frames", frame[lines]), "ends": turned + poses[:, None, 4:]}


def _groups(kind: str) -> tuple[str, str]:
    """Groups of landmarks that a relation is between."""
    return next(item.metadata["refers"] for item in fields(Relations) if item.name == kind)


TERM = Term("relations", ("relations",), (), _factors)
