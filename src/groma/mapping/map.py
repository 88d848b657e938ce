# SPDX-License-Identifier: BSD-3-Clause
"""From photographs to points, lines and planes, jointly adjusted.

Stages, each saved when it is finished, so that an interrupted run goes on where it was:

1. ``model``      points and poses: read, or reconstructed from the images; adjusted with robust losses (``points``);
                  the points' observations placed anew by their grey levels, and adjusted again (``measured``);
2. ``segments``   line segments in every image, one image at a time;
3. ``lines``      3D lines from the segments;
4. ``joint``      poses, points and lines adjusted together, each point weighted by its own noise, the lines by theirs;
                  then the lines are mapped once more with the better poses, and all this again while that moves
                  the poses by more than the lines allow for;
5. ``structure``  planes, common directions, and what lies on what, and how closely;
6. ``adjusted``   everything adjusted together; observations that share errors with many others weigh less.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from groma._version import __version__
from groma.adjustment.adjust import AdjustOptions, adjust
from groma.errors import InputError
from groma.features.contract import ImageRetrieval, SegmentDetector, SegmentMatcher
from groma.features.external import ExternalMatches
from groma.features.matches import LineMatches
from groma.features.registry import DETECTORS
from groma.features.segments import Segments
from groma.io.colmap.sfm import PointModelOptions, reconstruct_points
from groma.mapping.checkpoints import Stages, digest, digest_files
from groma.mapping.exchange import NeighborChooser, matches_for, neighbors_for, with_parts
from groma.mapping.image_segments import detect_segments, given_segments
from groma.mapping.lines.build import MapLinesOptions, MatchProvider, explain, map_lines
from groma.mapping.noise.observations import line_end_correlation, moved_px, noise_px, with_point_noise
from groma.mapping.noise.shared import with_shared_noise
from groma.mapping.photographs import check_images, check_names, image_files, read_gray
from groma.mapping.refine_points import PointRefinementOptions, refine_points
from groma.mapping.result import MapResult
from groma.mapping.structure.find import StructureOptions, find_structure
from groma.mapping.structure.flatness import surface_noise_px
from groma.mapping.unused import without_unused
from groma.scene import Scene
from groma.scene.local_frame import local_frame

#: Scale of the first loss in standard deviations of the estimated noise. Matches of SIFT have a narrow core and heavy
#: tails that are still right.
LOSS_SIGMAS = 6.0
#: Scale of the Cauchy loss of the last adjustment, which starts close. Relative to the noise of their own point,
#: residuals are nearly Gaussian; the distribution of Student that fits them best bends at 4 to 5.
LAST_LOSS_SIGMAS = 4.0
#: Poses move too much for the lines that were mapped with them if this share of the points moves in the images by more
#: than :attr:`MapLinesOptions.noise`. The lines are then mapped again, at most so many times in all after the first.
MOVED_SHARE, MAX_ROUNDS = 0.1, 4

#: Called with the name of a stage, what is done and what there is to do.
StageProgress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class MapOptions:
    """Options of :func:`map_images`."""

    #: Shortest segment, pixels.
    min_segment_length: float = 12.0
    #: What finds the segments: an object, or a name of :data:`groma.features.registry.DETECTORS`.
    detector: str | SegmentDetector = "lsd"
    #: What matches them, likewise; None: the geometry of the poses alone.
    matcher: str | SegmentMatcher | None = None
    #: What tells which images to compare where they share too few points, likewise; None: nothing does.
    retrieval: str | ImageRetrieval | None = None
    #: Place the observations of points anew by the grey levels around them: three times less noise, which pays where
    #: the calibration is as good.
    refine_points: bool = False
    lines: MapLinesOptions = field(default_factory=MapLinesOptions)
    structure: StructureOptions = field(default_factory=StructureOptions)
    #: Look for planes and common directions.
    find_planes: bool = True
    #: Move the poses; without, only landmarks are adjusted.
    refine_poses: bool = True
    #: Estimate focal lengths and distortion too.
    refine_intrinsics: bool = False
    threads: int | None = None
    #: How points are reconstructed where there is no model: camera model, its parameters if they are known, seed.
    camera_model: str = "SIMPLE_RADIAL"
    camera_params: tuple[float, ...] | None = None
    seed: int = 0


def map_images(
    images: str | os.PathLike[str],
    work: str | os.PathLike[str],
    model: Scene | None = None,
    options: MapOptions | None = None,
    progress: StageProgress | None = None,
    line_matches: ExternalMatches | None = None,
) -> MapResult:
    """Map a folder of photographs: points, lines and planes, adjusted together.

    Parameters
    ----------
    images : path
        Folder of photographs.
    work : path
        Folder for finished stages. A second call with the same images, model and options goes on from them.
    model : Scene, optional
        Poses, cameras and points of the images; reconstructed from the images if not given.
    options : MapOptions, optional
        Lengths, gates and what is estimated.
    progress : callable, optional
        Called with the name of a stage, what is done and what there is to do.
    line_matches : ExternalMatches, optional
        Segments and their matches from elsewhere, by image name; nothing is detected then.

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
    options = with_parts(options or MapOptions())
    say = progress or (lambda stage, done, total: None)
    folder = Path(images)
    files = image_files(folder)
    names = [path.relative_to(folder).as_posix() for path in files]
    found = PointModelOptions(options.camera_model, options.camera_params, options.seed, options.threads)
    if model is not None:  # of a finished map: its lines and planes are found anew
        model = model.points_only()
    near = None if model is None else local_frame(model)
    if model is not None and near is not None:
        model = model.transformed(near)
    _check_number(folder, names, model, options.lines.min_images)
    check_images(folder, names, model, say)
    key = digest(__version__, digest_files(folder, files), model)
    with Stages(Path(work), key) as store:
        start = store.scene(
            "model",
            lambda: reconstruct_points(folder, store.place("sfm"), names, found, say) if model is None else model,
            dataclasses.replace(found, threads=None),
        )
        result = _mapped(folder, names, start, store, options, say, line_matches, model is not None)
    if near is None:
        return result
    scene, start, before = (part.transformed(near.inverse()) for part in (result.scene, result.start, result.before))
    return dataclasses.replace(result, scene=scene, start=start, before=before)


def _mapped(
    folder: Path,
    names: list[str],
    start: Scene,
    store: Stages,
    options: MapOptions,
    say: StageProgress,
    line_matches: ExternalMatches | None,
    model_given: bool,
) -> MapResult:
    points = adjust_points(start, options, store, say)
    if options.refine_points:
        raw = points
        points = store.scene("measured", lambda: _measured(folder, raw, options, say), options.refine_points)
    given = None if line_matches is None else digest(line_matches)
    # From here on every stage depends on all options.
    segments = store.segments(
        "segments",
        lambda: _segments(folder, points, options, say, line_matches),
        dataclasses.replace(options, threads=None),
        given,
    )
    matches = matches_for(options, folder, points, segments, line_matches)
    result = map_segments(points, segments, matches, options, store, say, neighbors_for(options, folder))
    say("done", 1, 1)
    left_out = _not_in_model(names, start, given=model_given)
    return dataclasses.replace(result, start=start, warnings=(*left_out, *result.warnings))


def adjust_points(start: Scene, options: MapOptions, store: Stages, say: StageProgress) -> Scene:
    """Return a model whose poses and points are adjusted with robust losses: stage ``points``."""
    return store.scene(
        "points",
        lambda: _adjusted(start, _robust(options), options, say, "adjusting points").scene,
        options.refine_poses,
        options.refine_intrinsics,
    )


def map_segments(
    points: Scene,
    segments: list[Segments],
    matches: Mapping[tuple[int, int], LineMatches] | MatchProvider | None,
    options: MapOptions,
    store: Stages,
    say: StageProgress,
    neighbors: NeighborChooser | None = None,
) -> MapResult:
    """Map lines and planes from segments and an adjusted model of points: the stages from ``lines`` on.

    No file of an image is read; ``start`` of the result is ``points``.
    """
    robust = _robust(options)
    # Each point's noise is estimated from the given standard deviations, not from an estimate before.
    given_sigma = points.point_observations.sigma
    noisy = with_point_noise(points)
    line_map = store.line_map("lines", lambda: map_lines(noisy, segments, matches, options.lines, say, neighbors))
    lined = line_map.add_to(noisy, segments)
    weighted = _weighted(robust, lined)
    for turn in range(MAX_ROUNDS if options.refine_poses and lined.num_lines else 0):
        tag, first = f"-{turn + 1}" if turn else "", lined
        joint = store.scene(f"joint{tag}", partial(_jointly, first, weighted, options, say))
        table = joint.point_observations
        joint = with_point_noise(joint.replace(point_observations=table.replace(sigma=given_sigma)))
        # The lines as mapped are good starts, and only the adjusted ones tell the noise of the segments.
        weighted = _weighted(robust, joint)
        line_map = store.line_map(
            f"final-lines{tag}", partial(map_lines, joint, segments, matches, options.lines, say, neighbors)
        )
        lined = line_map.add_to(joint, segments)
        if lined.num_lines == 0 or moved_px(first, joint, MOVED_SHARE) <= options.lines.noise:
            break
    if lined.num_lines:
        weighted = dataclasses.replace(weighted, loss="cauchy", loss_scale=LAST_LOSS_SIGMAS)
    if options.find_planes:
        flat = lined
        lined = store.scene("structure", lambda: find_structure(flat, options.structure, progress=say))
        weighted = dataclasses.replace(weighted, structure_sigma_px=surface_noise_px(lined, options.structure))
    independent = math.sqrt(1.0 + weighted.line_end_correlation)
    lined = with_shared_noise(lined, weighted.point_sigma_px, weighted.line_sigma_px * independent)
    result = store.adjusted("adjusted", lambda: _adjusted(lined, weighted, options, say, "adjusting everything"))
    scene, before = without_unused(result.scene, lined)
    missing = [] if lined.num_lines else ["No line was mapped; see what became of the segments."]
    return MapResult(
        scene=scene,
        start=points,
        before=before,
        report=result.report,
        adjusted_with=weighted,
        sigma_px={"points": weighted.point_sigma_px, "lines": weighted.line_sigma_px},
        explanation=explain(line_map),
        outcomes={outcome.name.lower(): count for outcome, count in line_map.outcome_counts().items()},
        warnings=(*missing, *result.report.warnings),
    )


# ---------------------------------------------------------------------------------------------------------- stages


def _check_number(folder: Path, names: list[str], model: Scene | None, fewest: int) -> None:
    if model is None:
        if len(names) < 3:
            raise InputError(
                f"{folder} holds {len(names)} {'image' if len(names) == 1 else 'images'}; a map needs at least 3 that "
                "overlap. Take more."
            )
        return
    if model.num_images < max(2, fewest):
        raise InputError(
            f"The model has {model.num_images} {'image' if model.num_images == 1 else 'images'} with a pose; a map "
            f"needs at least {max(2, fewest)} that overlap. Pass a model with more, or none to have it made."
        )
    if len(model.point_observations.image_idx) == 0:
        raise InputError(
            "The model has no points that its images observe; they tell which images see the same, and hold the poses. "
            "Pass a model with points, or none to have it made."
        )
    check_names(folder, names, model)


def _not_in_model(names: list[str], start: Scene, given: bool) -> list[str]:
    left = sorted(set(names) - set(start.images.names))
    if not left:
        return []
    more = "" if len(left) <= 3 else f" and {len(left) - 3} more"
    remedy = "" if given else " They share too few points with the others: take images between them, or pass a --model."
    which = f"{', '.join(left[:3])}{more}"
    have = "has no pose in the model and was" if len(left) == 1 else "have no pose in the model and were"
    return [f"{len(left)} of {len(names)} images {have} not used: {which}.{remedy}"]


def _segments(
    folder: Path, scene: Scene, options: MapOptions, say: StageProgress, line_matches: ExternalMatches | None
) -> list[Segments]:
    if line_matches is not None:
        return given_segments(folder, scene, line_matches, say)
    detector = DETECTORS.make(options.detector, min_length=options.min_segment_length, max_segments=0)
    return detect_segments(folder, scene, detector, say)


def _measured(folder: Path, points: Scene, options: MapOptions, say: StageProgress) -> Scene:
    """Points measured again in the photographs, and adjusted with the noise they have then."""
    found = refine_points(
        points,
        lambda image: read_gray(folder / points.images.names[image]),
        noise_px(points, "points"),
        PointRefinementOptions(threads=options.threads),
        lambda done, total: say("measuring points", done, total),
    )
    weighted = dataclasses.replace(_robust(options), point_sigma_px=found.sigma_px)
    return _adjusted(found.scene, weighted, options, say, "adjusting points again").scene


def _robust(options: MapOptions) -> AdjustOptions:
    return AdjustOptions(refine_intrinsics=options.refine_intrinsics, threads=options.threads)


def _weighted(robust: AdjustOptions, scene: Scene) -> AdjustOptions:
    """Options that weigh points and lines by the noise they have in a scene."""
    correlation = line_end_correlation(scene)
    return dataclasses.replace(
        robust,
        point_sigma_px=noise_px(scene, "points"),
        line_sigma_px=noise_px(scene, "lines", correlation),
        line_end_correlation=correlation,
        loss_scale=LOSS_SIGMAS,
    )


def _jointly(scene: Scene, weighted: AdjustOptions, options: MapOptions, say: StageProgress) -> Scene:
    return _adjusted(scene, weighted, options, say, "adjusting points and lines").scene


def _adjusted(scene: Scene, adjust_options: AdjustOptions, options: MapOptions, say: StageProgress, stage: str):
    held = dataclasses.replace(adjust_options, refine_poses=options.refine_poses)
    say(stage, 0, held.max_iterations)
    return adjust(scene, held, lambda event: say(stage, event.iteration, event.max_iterations))
