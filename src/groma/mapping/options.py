# SPDX-License-Identifier: BSD-3-Clause
"""What a map is asked for: the options of :func:`groma.map_images`, and who is told of its progress."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from groma.adjustment.adjust import AdjustOptions
from groma.features.contract import ImageRetrieval, SegmentDetector, SegmentMatcher
from groma.io.colmap.masks import Masks
from groma.io.colmap.rigs import RigDescription
from groma.io.colmap.sfm import PointModelOptions
from groma.mapping.lines.confidence import DEFAULT_CONFIDENCE
from groma.mapping.lines.options import MIN_LENGTH, MapLinesOptions
from groma.mapping.structure.find import StructureOptions

#: Called with the name of a stage, what is done and what there is to do.
StageProgress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class MapOptions:
    """Options of :func:`groma.map_images`."""

    #: Shortest segment that is looked for, pixels; ``lines.min_length`` is that of one that is used.
    min_segment_length: float = MIN_LENGTH
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
    #: Smallest probability that a line is right, for it to stay in the map.
    min_confidence: float = DEFAULT_CONFIDENCE
    #: Look for planes and common directions.
    find_planes: bool = True
    #: Move the poses; without, only landmarks are adjusted.
    refine_poses: bool = True
    #: Estimate focal lengths and distortion too; None: where ``camera_model`` changes the given cameras, and where the
    #: calibration was not given, then at the start and in the last adjustment, with the principal points.
    refine_intrinsics: bool | None = None
    threads: int | None = None
    #: Most steps of each adjustment (cost: time; most end before).
    max_iterations: int = 50
    #: The camera model: where points are reconstructed, of all cameras (None: SIMPLE_RADIAL, or RADIAL where residuals
    #: show a second coefficient of distortion); else the model that the given cameras are changed to (None: they keep
    #: theirs), and what it adds is estimated with the calibration.
    camera_model: str | None = None
    #: Where points are reconstructed: the parameters of the cameras if they are known, seed.
    camera_params: tuple[float, ...] | None = None
    #: Where poses are reconstructed: ``incremental`` or ``global``, pycolmap's mappers.
    mapper: str = "incremental"
    seed: int = 0
    #: Where points are reconstructed: images taken at the same moment by cameras fixed to each other.
    rigs: tuple[RigDescription, ...] = ()
    #: Estimate where cameras sit on their rig.
    refine_rigs: bool = False
    #: What may be used of the photographs, to find points and segments; None: all.
    masks: Masks | None = None
    #: What photographs were read along, ``rows`` or ``columns``; None: taken at once, unless a given model says how.
    rolling_shutter: str | None = None
    #: Leave measurements in that the test for gross errors would take out.
    keep_suspects: bool = False

    def point_model(self, threads: bool = True) -> PointModelOptions:
        """How points are reconstructed, with or without the number of threads, on which no result depends."""
        lens, count = (self.camera_model or "SIMPLE_RADIAL", self.camera_params), self.threads if threads else None
        return PointModelOptions(*lens, self.seed, count, self.mapper, self.rigs, self.refine_rigs, self.masks)

    def adjustment(self, threads: bool = True) -> AdjustOptions:
        """How stages adjust of which the scene alone is wanted: the last one asks what the lenses lack."""
        return AdjustOptions(
            refine_poses=self.refine_poses,
            refine_intrinsics=bool(self.refine_intrinsics),
            refine_rigs=self.refine_rigs,
            max_iterations=self.max_iterations,
            start_tolerance=0.0,
            check_lens=False,
            threads=self.threads if threads else None,
        )
