# SPDX-License-Identifier: BSD-3-Clause
"""Relations between landmarks as differences of pixels: no weight between lengths and pixels has to be chosen.

Every image that sees a landmark adds a factor. What lies on a plane is compared with its foot on the plane; a point on
a line is tied to it through what the images saw of the other: the point keeps to the segments of the line, the line to
the pixels of the point. Points and lines stay uncoupled, so both are still eliminated.

Relations with a standard deviation of their own are measured in lengths (:mod:`groma.adjustment.terms.relations`).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from groma._rows import numbered
from groma._typing import FloatArray, IntArray
from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.relations import metric_rows
from groma.cameras import model as camera_model
from groma.factors.contract import Factor, Ref
from groma.factors.relations.direction_pairs import LineDirection
from groma.factors.relations.line_to_pixel import LineToPixel
from groma.factors.relations.on_plane_pixels import PointOnPlanePixels, SegmentOnPlanePixels
from groma.factors.relations.point_to_image_line import PointToImageLine
from groma.geometry import segment2


def _factors(draft: Draft) -> Iterator[Group]:
    """Yield the factors of the relations whose landmarks take part and that are not measured in lengths."""
    present, in_pixels = draft.variables.keys(), draft.options.structure_form == "pixels"
    if in_pixels and {"points", "planes"} <= present:
        yield from _points_on_planes(draft)
    if in_pixels and {"lines", "planes"} <= present:
        yield from _lines_on_planes(draft)
    if {"points", "lines"} <= present:
        yield from _points_on_lines(draft)
    if in_pixels and {"lines", "directions"} <= present and len(pairs := _pairs(draft, "line_along_direction")):
        yield Group(_along_directions(draft, pairs))


def _pairs(draft: Draft, kind: str) -> IntArray:
    """Return the pairs of a relation that are not measured in lengths."""
    pairs = getattr(draft.scene.relations, kind)
    return np.delete(pairs, metric_rows(draft, kind), axis=0)


def _points_on_planes(draft: Draft) -> Iterator[Group]:
    seen = draft.scene.point_observations
    of, plane = _join(seen.point_idx, _pairs(draft, "point_on_plane"), draft.scene.num_points)
    for _, rows, camera in draft.by_camera(seen.image_idx[of]):
        yield Group(
            PointOnPlanePixels(
                point=Ref("points", seen.point_idx[of[rows]]),
                plane=Ref("planes", plane[rows]),
                sqrt_information=1.0 / draft.options.point_sigma_px,
                loss=draft.relation_loss,
                **camera,
            )
        )


def _lines_on_planes(draft: Draft) -> Iterator[Group]:
    seen = draft.scene.line_observations
    of, plane = _join(seen.line_idx, _pairs(draft, "line_on_plane"), draft.scene.num_lines)
    for _, rows, camera in draft.by_camera(seen.image_idx[of]):
        line = seen.line_idx[of[rows]]
        yield Group(
            SegmentOnPlanePixels(
                line=Ref("lines", line),
                plane=Ref("planes", plane[rows]),
                ends=draft.scene.lines.segments[line],
                sqrt_information=1.0 / draft.options.line_sigma_px,
                loss=draft.relation_loss,
                **camera,
            )
        )


def _points_on_lines(draft: Draft) -> Iterator[Group]:
    scene, pairs = draft.scene, _pairs(draft, "point_on_line")
    points, lines = scene.point_observations, scene.line_observations
    of, point = _join(lines.line_idx, pairs[:, ::-1], scene.num_lines)
    image_lines = segment2.to_line(lines.segment[of])
    for name, rows, camera in draft.by_camera(lines.image_idx[of]):
        if not camera_model(name).is_planar:  # the chord of a curve is no image of the line, not even nearly
            continue
        yield Group(
            PointToImageLine(
                point=Ref("points", point[rows]),
                image_lines=image_lines[rows],
                sqrt_information=1.0 / draft.options.line_sigma_px,
                loss=draft.relation_loss,
                **camera,
            )
        )
    of, line = _join(points.point_idx, pairs, scene.num_points)
    for name, rows, camera in draft.by_camera(points.image_idx[of]):
        if camera_model(name).has_pinhole_parameters:
            yield Group(
                LineToPixel(
                    line=Ref("lines", line[rows]),
                    pixels=points.pixel[of[rows]],
                    sqrt_information=1.0 / draft.options.point_sigma_px,
                    loss=draft.relation_loss,
                    **camera,
                )
            )


def _along_directions(draft: Draft, pairs: IntArray) -> Factor:
    """Lines along directions: the angle that the noise of end points allows for the length seen in the images."""
    line, direction = pairs.T
    table = draft.scene.line_observations
    length = segment2.length(table.segment)
    squares = np.bincount(table.line_idx, weights=length**2, minlength=draft.scene.num_lines)
    # the two ends of n segments of length s fix an angle to sigma sqrt(2 / sum of s^2) in the image
    spread: FloatArray = np.sqrt(np.maximum(squares, 1e-12) / 2.0)
    return LineDirection(
        line=Ref("lines", line),
        direction=Ref("directions", direction),
        sqrt_information=spread[line] / draft.options.line_sigma_px,
        loss=draft.relation_loss,
    )


def _join(landmark: IntArray, relation: IntArray, count: int) -> tuple[IntArray, IntArray]:
    """Return (observation, partner) for every observation of a landmark and every relation (landmark, partner)."""
    order = np.argsort(landmark, kind="stable")
    first = np.searchsorted(landmark[order], np.arange(count))
    number = np.bincount(landmark, minlength=count)
    of_relation = relation[:, 0] if len(relation) else np.zeros(0, np.int64)
    owner, within = numbered(number[of_relation])
    observation = order[first[of_relation[owner]] + within] if len(owner) else np.zeros(0, np.int64)
    return observation, (relation[owner, 1] if len(owner) else np.zeros(0, np.int64))


TERM = Term("relations in pixels", ("relations",), (), _factors)
