# SPDX-License-Identifier: BSD-3-Clause
"""The stages of a map that depth maps add: depths of points, an adjustment with them, depths of segments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from groma._typing import FloatArray
from groma.adjustment.adjust import adjust
from groma.adjustment.report import Progress
from groma.features.segments import Segments
from groma.io.depth_maps import DepthMaps
from groma.mapping.checkpoint_files import ARRAY, DEPTHS, SCENE
from groma.mapping.checkpoints import Stages, digest, digest_files, stage
from groma.mapping.depth.points import MeasuredDepths, check_cameras, measure_depths
from groma.mapping.depth.segments import segment_depths
from groma.mapping.noise.observations import noise_px
from groma.mapping.point_base import PointBase
from groma.scene import Scene, Similarity

_Say = Callable[[str, int, int], None]


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
