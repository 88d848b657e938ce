# SPDX-License-Identifier: BSD-3-Clause
"""From photographs to points, lines and planes, jointly adjusted.

Stages, each saved when it is finished, so that an interrupted run goes on where it was:

1. ``model``      points and poses: read, reconstructed from the images, or found at poses without points
                  (``registered``); adjusted with robust losses (``points``);
                  the points' observations found anew by their grey levels, and adjusted again (``measured``);
                  with depth maps brought to their unit, and adjusted with depths (``depths``);
2. ``segments``   line segments in every image, one image at a time;
3. ``lines``      3D lines from the segments;
4. ``joint``      poses, points and lines adjusted together, each point weighted by its own noise, the lines by theirs;
                  then the lines are mapped once more with the better poses, and all this again while that moves
                  the poses by more than the lines allow for;
5. ``structure``  planes, common directions and structural relations, with their deviations;
6. ``adjusted``   everything adjusted together; observations that share errors with many others weigh less.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from groma._log import log_warnings, logged_stages
from groma._typing import FloatArray
from groma._version import __version__
from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.report import AdjustResult
from groma.adjustment.survey.attach import check_survey
from groma.adjustment.survey.given import Survey
from groma.errors import given_or_default
from groma.execution import begin, work_with
from groma.features.close_edges import CloseEdges
from groma.features.contrast import WithContrast
from groma.features.external import ExternalMatches
from groma.features.matches import LineMatches
from groma.features.registry import DETECTORS
from groma.features.segments import Segments
from groma.gates import SURVEYED, gate
from groma.io.depth_maps import DepthMaps
from groma.mapping.carried.measured import (
    carried_depths,
    not_carried,
    ready_to_map,
    with_measured_lines,
    with_measured_planes,
)
from groma.mapping.checkpoint_files import ADJUSTED, LINE_MAP, SCENE, SEGMENTS
from groma.mapping.checkpoints import Stages, digest, digest_files, stage
from groma.mapping.depth.segments import with_line_depths
from groma.mapping.exchange import NeighborChooser, matches_for, neighbors_for, with_parts
from groma.mapping.image_segments import check_masks, detect_segments, given_segments
from groma.mapping.lines.hypotheses.earlier import GATES as EARLIER
from groma.mapping.lines.hypotheses.earlier import EarlierMap
from groma.mapping.lines.in_views import map_lines_in_views
from groma.mapping.lines.line_map import LineMap
from groma.mapping.lines.matches import MatchProvider
from groma.mapping.noise.observations import line_bend, line_end_correlation, moved_px, noise_px, with_point_noise
from groma.mapping.noise.shared import with_shared_noise
from groma.mapping.options import MapOptions, StageProgress
from groma.mapping.photographs import checked_photographs, image_files, image_reader, photographs_left_out
from groma.mapping.point_base import PointBase, find_segment_depths, with_depths, with_measurements
from groma.mapping.read_rows import adjust_read_rows, mapped_as_measured, read_by_rows, taken_at_once
from groma.mapping.refine_points import refine_points
from groma.mapping.result import SCENES_OF_RESULT, MapResult, result_of
from groma.mapping.start import start_of
from groma.mapping.structure.find import LandmarkNoise, detect_structure, landmark_noise
from groma.mapping.structure.flatness import surface_noise_px, with_rough_planes
from groma.scene import Scene, Similarity
from groma.scene.checks import check_scene_given
from groma.scene.local_frame import usual_frame
from groma.solver.linear.blas import one_blas_thread


@dataclass(frozen=True)
class MappingGates:
    """How noise becomes weight, and when lines are mapped again."""

    loss_scale: float = gate(6.0, "sigma", "of the first loss: matches have a narrow core and heavy tails", SURVEYED)
    last_loss_scale: float = gate(
        4.0, "sigma", "scale of the Cauchy loss of the last adjustment, relative to the noise of each point",
        "derived from Student's distribution that fits these residuals best, which bends at 4 to 5",
    )  # fmt: skip
    max_rounds: int = gate(4, "rounds", "of adjusting and mapping lines again", "cost: most maps need one")


GATES = MappingGates()


def map_images(
    images: str | os.PathLike[str],
    work: str | os.PathLike[str],
    model: Scene | None = None,
    options: MapOptions | None = None,
    progress: StageProgress | None = None,
    line_matches: ExternalMatches | None = None,
    survey: Survey | None = None,
    depth: DepthMaps | None = None,
) -> MapResult:
    """Map a folder of photographs: points, lines and planes, adjusted together.

    Parameters
    ----------
    images : path
        Folder of photographs.
    work : path
        Folder for finished stages. A second call with the same images, model and options resumes from them.
    model : Scene, optional
        Poses, cameras and points of the images; reconstructed from the images if not given. Where it has no points,
        they are found, and the poses are measurements whose noise is estimated.
    options : MapOptions, optional
        Lengths, gates and what is estimated.
    progress : callable, optional
        Called with the name of a stage, what is done and what there is to do.
    line_matches : ExternalMatches, optional
        Segments and their matches from elsewhere, by image name; nothing is detected then.
    survey : Survey, optional
        Positions, control points and distances; the map is in their frame and adjusted with them.
    depth : DepthMaps, optional
        Depth maps of the photographs; the map has their unit of length and is adjusted with them.

    Returns
    -------
    MapResult
        The map. If no line was found, ``explanation`` names the stage that lost them.

    Raises
    ------
    InputError
        If images are missing, unreadable, of another size than their camera, or do not overlap.
    OutputError
        If another run works in ``work``, or it cannot be written.
    """
    say, folder = logged_stages("mapping", progress), Path(images)
    options = with_parts(given_or_default(options, MapOptions))
    given, near, options = _in_usual_frame(model, options)
    files = image_files(folder)
    read_by_rows(given or Scene(), options, depth)  # refuses depths beside it before anything is computed
    alone = model is None and line_matches is None and not options.rigs
    key = begin(partial(digest, __version__, digest_files(folder, files), given))
    sizes, copies = checked_photographs(folder, files, given, options.lines.min_images, alone, say)
    masked = check_masks(options.masks, sizes, say)
    if survey:
        check_survey(survey, tuple(sizes), list(sizes.values()))
    with one_blas_thread(), work_with(options.threads), Stages(Path(work), key(), options, say) as stages:
        registered = start_of(folder, list(sizes), given, stages)
        base, segments = _base_of(folder, PointBase(registered.scene, near), line_matches, survey, depth, stages)
        matches = matches_for(options, folder, base.points, segments, line_matches)
        if base.depths is not None and depth is not None:
            segment_depths = stages.run(find_segment_depths, base.points, segments, depth, base.depths)
        else:
            segment_depths = None if read_by_rows(base.start, options) else carried_depths(base.start, segments)
        seen = taken_at_once(base.points, segments)
        neighbors = neighbors_for(options, folder)
        mapped = map_segments(seen.scene, seen.segments, matches, stages, neighbors, segment_depths)
        mapped = with_measured_lines(mapped_as_measured(mapped, seen, stages), base.start)
    left_out = photographs_left_out(folder, files, copies, (given or base.start).images.names, given is not None)
    not_kept = not_carried(model or Scene(), mapped.scene)
    of_depths = base.depths.warnings if base.depths else ()
    result = dataclasses.replace(
        mapped,
        start=base.start,
        num_photographs=len(sizes) if given is None else given.num_images,
        explanation=" ".join([*masked, *registered.notes, mapped.explanation]),
        warnings=(*left_out, *not_kept, *registered.warnings, *of_depths, *mapped.warnings),
        surveyed=base.surveyed,
        depths=base.depths,
    )
    log_warnings("mapping", [sentence for sentence in result.warnings if sentence not in result.report.warnings])
    if base.near is None:
        return result
    scenes = {name: getattr(result, name).transformed(base.near.inverse()) for name in SCENES_OF_RESULT}
    return dataclasses.replace(result, **scenes)


def _in_usual_frame(model: Scene | None, options: MapOptions) -> tuple[Scene | None, Similarity | None, MapOptions]:
    """Return a given model near the origin with the camera model asked for, what brought it there, and the options."""
    if model is None:
        return None, None, options
    check_scene_given(model, "model")
    ready = ready_to_map(model)
    if options.camera_model is not None:
        ready = ready.replace(cameras=ready.cameras.with_model(options.camera_model))
        options = dataclasses.replace(options, refine_intrinsics=options.refine_intrinsics is not False)
    near = usual_frame(ready)
    return ready if near is None else ready.transformed(near), near, options


def _base_of(
    folder: Path,
    base: PointBase,
    line_matches: ExternalMatches | None,
    survey: Survey | None,
    depth: DepthMaps | None,
    stages: Stages[MapOptions],
) -> tuple[PointBase, list[Segments]]:
    """Return adjusted points and poses, with the measurements of other instruments, and the segments of each image.

    Lines of the start have measured depths, which new segments take over: points are adjusted without them.
    """
    options, without_lines = stages.options, base.start.keep(lines=[])
    by_rows, segments = read_by_rows(base.start, options), None
    if by_rows or options.refine_intrinsics or options.refine_points or survey or depth is not None:
        points = stages.run(adjust_read_rows if by_rows else adjust_points, without_lines)
    else:  # the cameras stay as they are, and more is not needed to find segments
        found = (find_segments, folder, without_lines, line_matches)
        aside = (adjust_points, without_lines)
        points, segments = stages.run_beside("adjusting points", aside, *found, given=line_matches)
    if options.refine_points:
        points = stages.run(measure_points, folder, points)
    base = dataclasses.replace(base, points=points)
    if survey:
        base = with_measurements(base, survey, stages)
    if depth is not None:
        base = with_depths(base, depth, stages)
    if segments is None:
        segments = stages.run(find_segments, folder, base.points, line_matches, given=line_matches)
    return base, segments


def map_segments(
    points: Scene,
    segments: list[Segments],
    matches: Mapping[tuple[int, int], LineMatches] | MatchProvider | None,
    stages: Stages[MapOptions],
    neighbors: NeighborChooser | None = None,
    depths: FloatArray | None = None,
) -> MapResult:
    """Map lines and planes from segments and an adjusted model of points: the stages from ``lines`` on.

    No file of an image is read; ``start`` of the result is ``points``. ``depths`` are those of the segments, as
    :func:`~groma.mapping.depth.segments.segment_depths` returns them.
    """
    options, scene = stages.options, with_point_noise(points)
    line_map = stages.run(find_lines, scene, segments, matches, neighbors, None)
    scene = with_line_depths(line_map.add_to(scene, segments), line_map, segments, depths)
    weighted = _weighted(scene, options)
    for turn in range(GATES.max_rounds if options.refine_poses and scene.num_lines else 0):
        before, tag = scene, f"-{turn + 1}" if turn else ""
        joint = stages.run(adjust_jointly, before, weighted, tag=tag)
        # Each point's noise is estimated from the given standard deviations, not from an estimate before.
        given = joint.point_observations.replace(sigma=points.point_observations.sigma)
        joint = with_point_noise(joint.replace(point_observations=given))
        # The lines as mapped are good starts, and only the adjusted ones tell the noise of the segments.
        told = begin(partial(_weighted, joint, options))
        earlier = EarlierMap(before, line_map)
        moved = begin(partial(moved_px, before, joint, EARLIER.moved_share))
        line_map = stages.run(find_lines_again, joint, segments, matches, neighbors, earlier, tag=tag)
        weighted = told()
        scene = with_line_depths(line_map.add_to(joint, segments), line_map, segments, depths)
        if scene.num_lines == 0 or moved() <= options.lines.noise:
            break
    if scene.num_lines:
        factor, scale = 1.0, GATES.last_loss_scale
        if not options.refine_poses:
            factor = min(line_bend(scene, weighted.line_end_correlation) / scale, 1.0)
        weighted = dataclasses.replace(weighted, loss="cauchy", loss_scale=scale, line_loss_factor=factor)
    sigma_px = weighted.point_sigma_px, weighted.line_sigma_px * math.sqrt(1.0 + weighted.line_end_correlation)
    shared = begin(partial(with_shared_noise, scene, *sigma_px))
    if options.find_planes:
        noise = landmark_noise(scene, options.structure)
        scene = stages.run(find_planes, scene, noise)
        flatness = surface_noise_px(scene, options.structure, noise)
        weighted = dataclasses.replace(weighted, structure_sigma_px=flatness)
        if not options.refine_poses:
            scene = with_rough_planes(scene, flatness, options.structure, noise)
    if len(scene.principal_point_priors) and options.refine_intrinsics is None and options.refine_poses:
        weighted = dataclasses.replace(weighted, refine_intrinsics=None)  # of cameras whose calibration was not given
    weights = shared()
    scene = scene.replace(point_observations=weights.point_observations, line_observations=weights.line_observations)
    adjusted = stages.run(adjust_everything, scene, weighted)
    return result_of(
        points, scene, adjusted, weighted, line_map, segments, options.min_confidence, not options.refine_poses
    )


# --------------------------------------------------------------------------------------------------------------- stages
@stage("points", SCENE, lambda options: options.adjustment(threads=False))
def adjust_points(start: Scene, options: MapOptions, say: StageProgress) -> Scene:
    """A model whose poses and points are adjusted with robust losses."""
    return _adjusted(start, options.adjustment(), say, "adjusting points").scene


@stage("measured", SCENE)
def measure_points(folder: Path, points: Scene, options: MapOptions, say: StageProgress) -> Scene:
    """Points measured again in the photographs, and adjusted with the noise they have then."""
    found = refine_points(
        points, image_reader(folder, points.images.names), noise_px(points, "points"), partial(say, "measuring points")
    )
    weighted = dataclasses.replace(options.adjustment(), point_sigma_px=found.sigma_px)
    return _adjusted(found.scene, weighted, say, "adjusting points again").scene


# From here on every stage depends on all options.
@stage("segments", SEGMENTS, lambda options: dataclasses.replace(options, threads=None, min_confidence=0.0))
def find_segments(
    folder: Path, scene: Scene, line_matches: ExternalMatches | None, options: MapOptions, say: StageProgress
) -> list[Segments]:
    """Line segments in every image."""
    if line_matches is not None:
        return given_segments(folder, scene, line_matches, say)
    detector = DETECTORS.make(options.detector, min_length=options.min_segment_length, max_segments=0)
    if not options.refine_poses:
        # Cameras are determined better by places that vary less from view to view, lines by those on the edges.
        detector = CloseEdges(detector)
    return detect_segments(folder, scene, WithContrast(detector), say, options.masks)


def _find_lines(
    scene: Scene,
    segments: list[Segments],
    matches: Mapping[tuple[int, int], LineMatches] | MatchProvider | None,
    neighbors: NeighborChooser | None,
    earlier: EarlierMap | None,
    options: MapOptions,
    say: StageProgress,
) -> LineMap:
    return map_lines_in_views(scene, segments, matches, options.lines, say, neighbors, earlier)


#: 3D lines from the segments; and again, with better poses.
find_lines = stage("lines", LINE_MAP)(_find_lines)
find_lines_again = stage("final-lines", LINE_MAP)(_find_lines)


@stage("joint", SCENE)
def adjust_jointly(scene: Scene, weighted: AdjustOptions, options: MapOptions, say: StageProgress) -> Scene:
    """Poses, points and lines adjusted together, weighted by their noise."""
    return _adjusted(scene, weighted, say, "adjusting points and lines").scene


@stage("structure", SCENE)
def find_planes(scene: Scene, noise: LandmarkNoise, options: MapOptions, say: StageProgress) -> Scene:
    """Planes, common directions and structural relations."""
    return with_measured_planes(detect_structure(scene, options.structure, progress=say, noise=noise), scene)


@stage("adjusted", ADJUSTED)
def adjust_everything(scene: Scene, weighted: AdjustOptions, options: MapOptions, say: StageProgress) -> AdjustResult:
    """Everything adjusted together."""
    return _adjusted(scene, dataclasses.replace(weighted, check_lens=True), say, "adjusting everything")


# -------------------------------------------------------------------------------------------------------------- helpers
def _weighted(scene: Scene, options: MapOptions) -> AdjustOptions:
    """Options that weigh points and lines by the noise they have in a scene."""
    correlation = line_end_correlation(scene)
    return dataclasses.replace(
        options.adjustment(),
        point_sigma_px=noise_px(scene, "points"),
        line_sigma_px=noise_px(scene, "lines", correlation),
        line_end_correlation=correlation,
        loss_scale=GATES.loss_scale,
    )


def _adjusted(scene: Scene, adjust_options: AdjustOptions, say: StageProgress, doing: str) -> AdjustResult:
    say(doing, 0, adjust_options.max_iterations)
    return adjust(scene, adjust_options, lambda event: say(doing, event.iteration, event.max_iterations))
