# SPDX-License-Identifier: BSD-3-Clause
"""Relations between landmarks as lengths and angles: what lies on what, and what runs along what."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
#: Types of the factors of relations, and the relation of the scene each stands for.
RELATION_FACTORS = {
    "point_on_plane": "point_on_plane",
    "segment_on_plane": "line_on_plane",
    "line_direction": "line_along_direction",
    "point_on_line": "point_on_line",
    "lines_meeting": "lines_meeting",
    **{factor.type_name: kind for kind, factor in ANGLES.items()},
}


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


def _weights(draft: Draft, kind: str, of: str, rows: IntArray) -> FloatArray:
    """Inverse standard deviations of distances: those of the relations, else what the images tell at the landmark."""
    relations = draft.scene.relations
    sigma, landmark = relations.sigma(kind)[rows], getattr(relations, kind)[rows, 0]
    if (sigma > 0.0).all():
        return 1.0 / sigma
    usual = draft.options.structure_sigma_px * lengths_per_pixel(draft.scene, of)[landmark]
    return 1.0 / np.where(sigma > 0.0, sigma, usual)


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
    for kind, make in _MAKERS.items():
        if set(_groups(kind)) <= draft.variables.keys() and len(rows := metric_rows(draft, kind)):
            yield Group(make(draft, rows))


def _points_on_planes(draft: Draft, rows: IntArray) -> Factor:
    point, plane = draft.scene.relations.point_on_plane[rows].T
    weights = _weights(draft, "point_on_plane", "point", rows)
    return PointOnPlane(
        point=Ref("points", point), plane=Ref("planes", plane), sqrt_information=weights, loss=draft.relation_loss
    )


def _points_on_lines(draft: Draft, rows: IntArray) -> Factor:
    point, line = draft.scene.relations.point_on_line[rows].T
    weights = _weights(draft, "point_on_line", "point", rows)
    return PointOnLine(
        point=Ref("points", point), line=Ref("lines", line), sqrt_information=weights, loss=draft.relation_loss
    )


def _lines_meeting(draft: Draft, rows: IntArray) -> Factor:
    first, second = draft.scene.relations.lines_meeting[rows].T
    weights = _weights(draft, "lines_meeting", "line", rows)
    return LinesMeeting(
        first=Ref("lines", first), second=Ref("lines", second), sqrt_information=weights, loss=draft.relation_loss
    )


def _lines_on_planes(draft: Draft, rows: IntArray) -> Factor:
    line, plane = draft.scene.relations.line_on_plane[rows].T
    return SegmentOnPlane(
        line=Ref("lines", line),
        plane=Ref("planes", plane),
        ends=draft.scene.lines.segments[line],
        sqrt_information=_weights(draft, "line_on_plane", "line", rows),
        loss=draft.relation_loss,
    )


def _lines_along_directions(draft: Draft, rows: IntArray) -> Factor:
    """Lines along directions; the noise of the ends of a line is that of its angle at half its length."""
    relations, ends = draft.scene.relations, draft.scene.lines.segments
    line, direction = relations.line_along_direction[rows].T
    half = np.maximum(0.5 * np.linalg.norm(ends[line, 1] - ends[line, 0], axis=1), 1e-12)
    angle = relations.sigma("line_along_direction")[rows]
    weights = _weights(draft, "line_along_direction", "line", rows)
    return LineDirection(
        line=Ref("lines", line),
        direction=Ref("directions", direction),
        sqrt_information=np.where(angle > 0.0, weights, weights * half),
        loss=draft.relation_loss,
    )


def _angles(kind: str) -> Callable[[Draft, IntArray], Factor]:
    def make(draft: Draft, rows: IntArray) -> Factor:
        pairs, sigma = getattr(draft.scene.relations, kind)[rows], draft.scene.relations.sigma(kind)[rows]
        sigma = np.where(sigma > 0.0, sigma, draft.options.plane_angle_sigma)
        sides = zip(("first", "second"), _groups(kind), pairs.T, strict=True)
        refs: dict[str, Any] = {side: Ref(group, index) for side, group, index in sides}
        return ANGLES[kind](**refs, sqrt_information=1.0 / sigma, loss=draft.relation_loss)

    return make


def _groups(kind: str) -> tuple[str, str]:
    """Groups of landmarks that a relation is between."""
    return next(item.metadata["refers"] for item in fields(Relations) if item.name == kind)


_MAKERS: dict[str, Callable[[Draft, IntArray], Factor]] = {
    "point_on_plane": _points_on_planes,
    "point_on_line": _points_on_lines,
    "lines_meeting": _lines_meeting,
    "line_on_plane": _lines_on_planes,
    "line_along_direction": _lines_along_directions,
    **{kind: _angles(kind) for kind in ANGLES},
}
TERM = Term("relations", ("relations",), (), _factors, is_relation=True)
