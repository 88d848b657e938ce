# SPDX-License-Identifier: BSD-3-Clause
"""Photographs that were read row by row, mapped as if they had been taken at once.

Points determine how the cameras moved (:mod:`groma.adjustment.rolling_shutter`). What was seen of points and segments
is then moved to where it would have been seen from the pose of the middle row: points by their own depth, the ends of
segments by that of the points near them. The map is made of that, by stages without a rolling shutter. At the end
points and segments return to where they were measured, and everything is adjusted once more with the motions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from groma._trees import kd_tree
from groma._typing import FloatArray, IntArray
from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.report import AdjustResult
from groma.adjustment.rolling_shutter import AXES, NOT_ROLLING, adjust_rolling_shutter, with_rolling_shutter
from groma.adjustment.terms.readout import motion_of, offsets_of
from groma.cameras import model as camera_model
from groma.errors import InputError
from groma.features.segments import Segments
from groma.gates import gate
from groma.geometry import quaternion
from groma.geometry.algebra import unit
from groma.mapping.checkpoint_files import ADJUSTED, SCENE
from groma.mapping.checkpoints import Stages, stage
from groma.mapping.options import MapOptions
from groma.mapping.result import MapResult
from groma.scene import CameraMotions, Scene


@dataclass(frozen=True)
class ReadRowsGates:
    """How the depth of segments is guessed."""

    neighbors: int = gate(3, "points", "near the end of a segment, whose depth it is given", "convention: a triangle")


GATES = ReadRowsGates()


@dataclass(frozen=True, eq=False)
class TakenAtOnce:
    """A scene and its segments as they would have been seen at once."""

    scene: Scene
    segments: list[Segments]
    #: As they were measured.
    points: Scene
    measured: list[Segments]


def check_read_rows(options: MapOptions) -> None:
    """Refuse what photographs that were read row by row cannot have."""
    if options.rolling_shutter is not None and options.rolling_shutter not in AXES:
        raise InputError(f"A rolling shutter reads along {' or '.join(AXES)}; got {options.rolling_shutter!r}.")
    if options.rolling_shutter is not None and (options.refine_points or options.matcher is not None):
        raise InputError(
            "Points cannot be measured again, nor segments matched by their images, where these were read row by row. "
            "Leave --refine-points and --line-matcher out."
        )


def read_by_rows(scene: Scene, options: MapOptions, depth: object = None) -> bool:
    """Whether photographs have a rolling shutter, by option or by the scene. Refuse depths with it."""
    rolling = options.rolling_shutter is not None or len(scene.camera_motions) > 0
    if rolling and depth is not None:
        raise InputError("Depths do not support a rolling shutter. Leave --depth or --rolling-shutter out.")
    return rolling


@stage("rows", SCENE, lambda options: (options.rolling_shutter, options.adjustment(threads=False)))
def adjust_read_rows(start: Scene, options: MapOptions, say: Callable[[str, int, int], None]) -> Scene:
    """A model whose poses, points and motions during the readout, if there are some, are adjusted robustly."""
    if options.rolling_shutter is not None:
        start = with_rolling_shutter(start, options.rolling_shutter)
    found = adjust_rolling_shutter(
        start,
        options.adjustment(),
        lambda event: say("adjusting points and motions", event.iteration, event.max_iterations),
    )
    return found.result.scene


def taken_at_once(points: Scene, segments: Sequence[Segments]) -> TakenAtOnce:
    """Return points and segments where they would have been seen from the poses of the middle rows.

    Where nothing was read row by row they stay as they are.
    """
    if not len(points.camera_motions):
        return TakenAtOnce(points, list(segments), points, list(segments))
    table = points.point_observations
    poses = points.cam_from_world[table.image_idx]
    inside = quaternion.rotate(poses[:, :4], points.points.xyz[table.point_idx]) + poses[:, 4:]
    moved = _at_rows(points, table.image_idx, inside, table.pixel)
    shift = _project(points, table.image_idx, inside) - _project(points, table.image_idx, moved)
    still = points.replace(
        point_observations=table.replace(pixel=table.pixel + np.where(np.isfinite(shift), shift, 0.0)),
        camera_motions=CameraMotions(),
    )
    distance = np.linalg.norm(moved, axis=1)
    found = [_segments_at_once(points, image, one, distance) for image, one in enumerate(segments)]
    return TakenAtOnce(still, found, points, list(segments))


def as_measured(scene: Scene, at_once: TakenAtOnce) -> Scene:
    """Return a map of what would have been seen at once with the places where it was measured, and the motions."""
    table, before = scene.point_observations, at_once.points.point_observations
    rows = _find(_keys(table.image_idx, table.keypoint_idx), _keys(before.image_idx, before.keypoint_idx))
    lines = scene.line_observations
    images = np.repeat(np.arange(len(at_once.segments)), [len(one) for one in at_once.segments])
    nothing = np.zeros((0, 4))
    once, raw = (np.vstack([nothing, *(one.ends for one in part)]) for part in (at_once.segments, at_once.measured))
    found = _find(_keys(lines.image_idx, *lines.segment.T), _keys(images, *once.T))
    return scene.replace(
        point_observations=table.replace(pixel=before.pixel[rows]),
        line_observations=lines.replace(segment=raw[found]),
        camera_motions=at_once.points.camera_motions,
    )


def mapped_as_measured(result: MapResult, at_once: TakenAtOnce, stages: Stages[MapOptions]) -> MapResult:
    """Return the map adjusted with the measured pixels, and the estimated motions."""
    if not len(at_once.points.camera_motions):
        asked = stages.options.rolling_shutter is not None
        return replace(result, warnings=(*result.warnings, NOT_ROLLING)) if asked else result
    before = as_measured(result.scene, at_once)
    adjusted = stages.run(adjust_as_measured, before, result.adjusted_with)
    result = replace(
        result,
        scene=adjusted.scene,
        start=at_once.points,
        before=before,
        adjusted=adjusted.scene,
        report=adjusted.report,
    )
    motions = result.motions()
    return replace(
        result,
        explanation=" ".join([*motions.sentences(), result.explanation]),
        warnings=(*result.warnings, *motions.warnings()),
    )


# Its initial map lacks the lines that are probably wrong.
@stage("as-measured", ADJUSTED, lambda options: options.min_confidence)
def adjust_as_measured(
    scene: Scene, weighted: AdjustOptions, options: MapOptions, say: Callable[[str, int, int], None]
) -> AdjustResult:
    """Everything adjusted together, with the motions during the readout."""
    told = replace(weighted, refine_poses=options.refine_poses, check_lens=False)
    return adjust(scene, told, lambda event: say("adjusting with motions", event.iteration, event.max_iterations))


# ----------------------------------------------------------------------------------------------------------- helpers
def _at_rows(scene: Scene, image_idx: IntArray, inside: FloatArray, pixels: FloatArray) -> FloatArray:
    """Return points (N, 3) in the frame of the middle row in those of the rows of their pixels."""
    s, motion = offsets_of(scene, image_idx, pixels)[:, None], motion_of(scene, image_idx)
    return quaternion.rotate(quaternion.exp(-s * motion[:, 3:]), inside - s * motion[:, :3])


def _segments_at_once(scene: Scene, image: int, segments: Segments, distance: FloatArray) -> Segments:
    """Return the segments of an image as the camera of its middle row would have seen them."""
    seen = np.flatnonzero(scene.point_observations.image_idx == image)
    ends = np.ascontiguousarray(segments.ends.reshape(-1, 2))
    image_idx = np.full(len(ends), image)
    if not len(ends):
        return segments
    name = scene.cameras.models[scene.images.camera_idx[image]]
    ray = unit(camera_model(name).unproject(_params(scene, image_idx, name), ends))
    s, motion = offsets_of(scene, image_idx, ends)[:, None], motion_of(scene, image_idx)
    nearness = np.zeros(len(ends))
    if len(seen):
        tree = kd_tree(scene.point_observations.pixel[seen])
        _, near = tree.query(ends, k=min(GATES.neighbors, len(seen)))
        nearness = np.mean(1.0 / distance[seen][np.reshape(near, (len(ends), -1))], axis=1)
    turn = quaternion.exp(s * motion[:, 3:])
    inside = quaternion.rotate(turn, ray) + nearness[:, None] * s * motion[:, :3]  # in units of the distance
    moved = _project(scene, image_idx, inside)
    moved = np.where(np.isfinite(moved), moved, ends)
    return replace(segments, ends=moved.reshape(-1, 4))


def _project(scene: Scene, image_idx: IntArray, inside: FloatArray) -> FloatArray:
    pixels = np.full((len(inside), 2), np.nan)
    for model, rows, params in scene.cameras.rows_by_model(scene.images.camera_idx[image_idx]):
        pixels[rows] = model.project(params, np.ascontiguousarray(inside[rows]))
    return pixels


def _params(scene: Scene, image_idx: IntArray, name: str) -> FloatArray:
    return scene.cameras.params[scene.images.camera_idx[image_idx], : camera_model(name).num_parameters]


def _keys(*columns: Any) -> Any:
    """Return rows of numbers as one comparable value each."""
    rows = np.ascontiguousarray(np.column_stack(columns).astype(np.float64))
    return rows.view([("", np.float64)] * rows.shape[1]).ravel()


def _find(wanted: Any, known: Any) -> IntArray:
    """Return the row of ``known`` equal to each of ``wanted``."""
    order = np.argsort(known)
    if not len(wanted):
        return np.zeros(0, np.int64)
    return order[np.searchsorted(known, wanted, sorter=order)]
