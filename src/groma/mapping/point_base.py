# SPDX-License-Identifier: BSD-3-Clause
"""What lines are mapped on: adjusted points and poses, with measurements of other instruments and depth maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from groma._typing import FloatArray
from groma.adjustment.adjust import adjust
from groma.adjustment.report import Progress
from groma.adjustment.survey.attach import Survey, Surveyed, with_survey
from groma.adjustment.survey.gross_errors import without_gross_errors
from groma.features.segments import Segments
from groma.io.depth_maps import DepthMaps
from groma.mapping.checkpoint_files import ARRAY, DEPTHS, SCENE
from groma.mapping.checkpoints import Stages, digest, digest_files, stage
from groma.mapping.depth.points import MeasuredDepths, check_cameras, measure_depths
from groma.mapping.depth.segments import segment_depths
from groma.mapping.noise.observations import noise_px
from groma.mapping.noise.weighted import weighted
from groma.scene import Scene, Similarity
from groma.scene.local_frame import usual_frame
from groma.scene.survey import with_rejected

_Say = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class PointBase:
    """Poses and points of a map on its way, near the origin and in a usual unit."""

    #: The scene that went in.
    start: Scene
    #: From the frame of the result to this one; None: they are the same.
    near: Similarity | None = None
    #: The scene with adjusted points and poses, and with measurements; empty before the first adjustment.
    points: Scene = field(default_factory=Scene)
    #: How it got into the frame of measurements, and to the unit of depth maps, where there are any.
    surveyed: Surveyed | None = None
    depths: MeasuredDepths | None = None


def with_measurements(base: PointBase, survey: Survey, stages: Stages[Any]) -> PointBase:
    """Bring the points of a map into the frame of measurements, and adjust them with these."""
    surveyed = with_survey(base.points, survey)
    near = usual_frame(surveyed.scene)
    start, points = base.start.transformed(surveyed.similarity), surveyed.scene
    if near is not None:
        start, points = start.transformed(near), points.transformed(near)
    return replace(
        base, start=start, near=near, points=stages.run(adjust_with_survey, points, given=points), surveyed=surveyed
    )


@stage("surveyed", SCENE, lambda options: options.keep_suspects)
def adjust_with_survey(points: Scene, options: Any, say: _Say) -> Scene:
    """Points and poses adjusted with measurements of other instruments, weighted by their noise."""

    def tell(event: Progress) -> None:
        say("adjusting with measurements", event.iteration, event.max_iterations)

    told = weighted(points, options.adjustment())
    if options.keep_suspects:
        return adjust(with_rejected(points, ()), told, tell).scene
    return without_gross_errors(adjust(points, told, tell), lambda scene: adjust(scene, told, tell))[0].scene


def with_depths(base: PointBase, maps: DepthMaps, stages: Stages[Any]) -> PointBase:
    """Bring a model of points to the unit of depth maps, and adjust it with the depths of its points."""
    check_cameras(base.points)
    files = [file for file in maps.files(base.points.images.names) if file is not None]
    given = digest(digest_files(maps.folder, files), maps.scale, maps.relative)
    before = base.near or Similarity()
    known = before.scale if base.points.has_scale else None
    measured = stages.run(find_depths, base.points, maps, known, given=given)
    adjusted = stages.run(adjust_with_depths, measured.scene)
    scale, near = measured.scale, None
    start = base.start.transformed(Similarity(scale)) if scale != 1.0 else base.start
    if maps.relative:  # back to the unit of the model at the end
        near = Similarity(scale * before.scale, before.rotation, scale * before.translation)
    elif base.near is not None:
        near = Similarity(1.0 if known is None else before.scale, before.rotation, scale * before.translation)
    return replace(base, start=start, near=near, points=adjusted, depths=measured)


@stage("depths", DEPTHS)
def find_depths(points: Scene, maps: DepthMaps, known: float | None, options: Any, say: _Say) -> MeasuredDepths:
    """Depths of points."""
    return measure_depths(points, maps, known, partial(say, "reading depths of points"))


@stage("points-with-depths", SCENE)
def adjust_with_depths(points: Scene, options: Any, say: _Say) -> Scene:
    """Points and poses adjusted with the depths of points."""
    told = replace(options.adjustment(), point_sigma_px=noise_px(points, "points"))

    def tell(event: Progress) -> None:
        say("adjusting with depths", event.iteration, event.max_iterations)

    return adjust(points, told, tell).scene


@stage("segment-depths", ARRAY)
def find_segment_depths(
    scene: Scene, segments: list[Segments], maps: DepthMaps, measured: MeasuredDepths, options: Any, say: _Say
) -> FloatArray:
    """Depths of segments."""
    return segment_depths(scene, segments, maps, measured, partial(say, "reading depths of segments"))
