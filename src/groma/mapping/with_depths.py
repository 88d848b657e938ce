# SPDX-License-Identifier: BSD-3-Clause
"""The stages of a map that depth maps add: depths of points, an adjustment with them, depths of segments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
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
from groma.scene import Scene, Similarity

_Say = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class WithDepths:
    """A map on its way, in the unit of length of depth maps."""

    #: The scene that went in, and the points adjusted with their depths.
    start: Scene
    points: Scene
    #: From the frame of the result to theirs; None: they are the same.
    near: Similarity | None
    measured: MeasuredDepths


def with_depths(
    start: Scene, points: Scene, near: Similarity | None, maps: DepthMaps, stages: Stages[Any]
) -> WithDepths:
    """Bring a model of points to the unit of depth maps, and adjust it with the depths of its points."""
    check_cameras(points)
    files = [file for file in maps.files(points.images.names) if file is not None]
    given = digest(digest_files(maps.folder, files), maps.scale, maps.relative)
    before = near or Similarity()
    known = before.scale if points.has_scale else None
    measured = stages.run(find_depths, points, maps, known, given=given)
    adjusted = stages.run(adjust_with_depths, measured.scene)
    scale = measured.scale
    start = start.transformed(Similarity(scale)) if scale != 1.0 else start
    if maps.relative:  # back to the unit of the model at the end
        after = Similarity(scale * before.scale, before.rotation, scale * before.translation)
    else:
        after = Similarity(1.0 if known is None else before.scale, before.rotation, scale * before.translation)
    same = near is None and not maps.relative
    return WithDepths(start, adjusted, None if same else after, measured)


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
