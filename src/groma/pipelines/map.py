# SPDX-License-Identifier: BSD-3-Clause
"""From photographs to points, lines and planes, jointly adjusted.

Stages, each saved when it is finished, so that an interrupted run goes on where it was:

1. ``model``      points and poses: read, or reconstructed from the images; adjusted with robust losses;
2. ``segments``   line segments in every image, one image at a time;
3. ``lines``      3D lines from the segments;
4. ``joint``      poses, points and lines adjusted together, each weighted by its own noise; then the lines are mapped
                  once more with the better poses;
5. ``structure``  planes, common directions, and what lies on what;
6. ``adjusted``   everything adjusted together.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from groma.errors import InputError
from groma.frontend.lsd import LsdDetector
from groma.frontend.segments import Segments
from groma.io.colmap_sfm import reconstruct_points
from groma.pipelines._assemble import AssemblyOptions, assemble
from groma.pipelines._photographs import check_images, image_files, read_gray
from groma.pipelines._stages import Stages, fingerprint
from groma.pipelines.adjust import AdjustOptions, AdjustReport, adjust, squared_residuals_px
from groma.pipelines.find_structure import StructureOptions, find_structure
from groma.pipelines.map_lines import LineMap, MapLinesOptions, explain, map_lines
from groma.scene import Scene

#: Residuals smaller than this are not believed when noise is estimated, pixels.
MIN_SIGMA_PX = 0.1

#: Called with the name of a stage, what is done and what there is to do.
StageProgress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class MapOptions:
    """Options of :func:`map_images`."""

    #: Shortest segment, pixels.
    min_segment_length: float = 12.0
    lines: MapLinesOptions = field(default_factory=MapLinesOptions)
    structure: StructureOptions = field(default_factory=StructureOptions)
    #: Look for planes and common directions.
    find_planes: bool = True
    #: Move the poses; without, only landmarks are adjusted.
    refine_poses: bool = True
    #: Estimate focal lengths and distortion too.
    refine_intrinsics: bool = False
    threads: int | None = None
    #: Seed of the point reconstruction, where there is no model.
    seed: int = 0


@dataclass(frozen=True)
class MapResult:
    """The map and how it came about."""

    #: Points, lines, planes, poses.
    scene: Scene
    #: The scene that went in: the given model, or the reconstruction of the points.
    start: Scene
    #: The map before its last joint adjustment, with the same landmarks as ``scene``.
    before: Scene
    #: Report of the last joint adjustment.
    report: AdjustReport
    #: Estimated standard deviations, pixels: of points, and of segment end points.
    sigma_px: dict[str, float]
    #: What became of the segments, in words.
    explanation: str
    #: Number of segments with each fate, by name.
    fates: dict[str, int]
    #: Sentences for the user.
    warnings: tuple[str, ...]


def map_images(
    images: str | os.PathLike[str],
    work: str | os.PathLike[str],
    model: Scene | None = None,
    options: MapOptions | None = None,
    progress: StageProgress | None = None,
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

    Returns
    -------
    MapResult
        The map. If no line was found, ``explanation`` names the stage that lost them.

    Raises
    ------
    InputError
        If images are missing, unreadable, of another size than their camera, or do not overlap.
    """
    options = options or MapOptions()
    say = progress or (lambda stage, done, total: None)
    folder = Path(images)
    files = image_files(folder)
    store = Stages(Path(work), fingerprint(files, model, options))
    warnings: list[str] = []

    start = store.scene("model", lambda: _point_model(folder, files, model, store, options, say))
    check_images(folder, start)
    robust = AdjustOptions(refine_intrinsics=options.refine_intrinsics, threads=options.threads)
    points = store.scene("points", lambda: _adjusted(start, robust, options, say, "adjusting points").scene)
    segments = store.segments(lambda: _detect(folder, points, options, say))
    lined, line_map = _with_lines(points, segments, options, say)
    sigma = {"points": _sigma(lined, "points"), "lines": _sigma(lined, "lines")}
    weighted = dataclasses.replace(robust, point_sigma_px=sigma["points"], line_sigma_px=sigma["lines"])
    if options.refine_poses and lined.num_lines:
        joint = store.scene(
            "joint", lambda: _adjusted(lined, weighted, options, say, "adjusting points and lines").scene
        )
        lined, line_map = _with_lines(joint, segments, options, say)
    if options.find_planes:
        say("finding planes and directions", 0, 1)
        lined = find_structure(lined, options.structure)
    result = _adjusted(lined, weighted, options, say, "adjusting everything")
    say("done", 1, 1)
    if lined.num_lines == 0:
        warnings.append("No line was mapped. " + explain(line_map))
    return MapResult(
        scene=result.scene,
        start=start,
        before=lined,
        report=result.report,
        sigma_px=sigma,
        explanation=explain(line_map),
        fates={fate.name.lower(): count for fate, count in line_map.fate_counts().items()},
        warnings=(*warnings, *result.report.warnings),
    )


# ---------------------------------------------------------------------------------------------------------- stages


def _point_model(folder, files, model: Scene | None, store: Stages, options: MapOptions, say: StageProgress) -> Scene:
    if model is not None:
        names = {path.relative_to(folder).as_posix() for path in files}
        missing = [name for name in model.images.names if name not in names]
        if missing:
            raise InputError(
                f"{len(missing)} of the {model.num_images} images of the model are not in {folder}, for example "
                f"{missing[0]!r}. Pass the folder the model was made from; names must match."
            )
        if model.num_images < 2:
            raise InputError(f"The model has {model.num_images} image(s); lines need at least 2, better 3.")
        return model
    if len(files) < 3:
        raise InputError(f"{folder} holds {len(files)} image(s); a map needs at least 3 that overlap.")
    return reconstruct_points(folder, store.folder / "sfm", lambda sentence: say(sentence, 0, 1), options.seed)


def _adjusted(scene: Scene, adjust_options: AdjustOptions, options: MapOptions, say: StageProgress, stage: str):
    held = dataclasses.replace(adjust_options, refine_poses=options.refine_poses)
    return adjust(scene, held, lambda event: say(stage, event.iteration, event.max_iterations))


def _detect(folder: Path, scene: Scene, options: MapOptions, say: StageProgress) -> list[Segments]:
    detector = LsdDetector(min_length=options.min_segment_length)
    found = []
    for i, name in enumerate(scene.images.names):
        say("finding segments", i, scene.num_images)
        found.append(detector.detect(read_gray(folder / name)))
    return found


def _with_lines(
    scene: Scene, segments: list[Segments], options: MapOptions, say: StageProgress
) -> tuple[Scene, LineMap]:
    line_map = map_lines(scene, segments, options=options.lines, progress=say)
    return line_map.add_to(scene, segments), line_map


def _sigma(scene: Scene, kind: str) -> float:
    """Robust standard deviation of the residuals of one kind of landmark, pixels.

    The median of the squared norm of two Gaussian coordinates is 1.386 variances; fitted landmarks take their share.
    """
    problem = assemble(scene, AssemblyOptions(planes=False)).problem
    squares = squared_residuals_px(problem).get(kind)
    if squares is None or len(squares) < 10:
        return 1.0
    unknowns = 3 * scene.num_points if kind == "points" else 4 * scene.num_lines
    share = 1.0 - min(unknowns / (2 * len(squares)), 0.8)
    return max(float(np.sqrt(np.median(squares) / 1.386 / share)), MIN_SIGMA_PX)
