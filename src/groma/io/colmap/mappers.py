# SPDX-License-Identifier: BSD-3-Clause
"""From matches to cameras and points, by pycolmap's mappers.

The incremental mapper begins with two images whose rays meet under a wide angle and frees the focal length at once.
Where that places few images, as in a walk down a street, everything is tried once more with the focal length of EXIF
held, with narrow angles and motions straight ahead allowed; the focal length is then estimated at the end, when all
images hold it. Of two models the one with more images counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from groma.gates import gate

if TYPE_CHECKING:
    from groma.io.colmap.sfm import PointModelOptions


@dataclass(frozen=True)
class MapperGates:
    """How the first images are chosen, and when it is tried otherwise."""

    first_angles: tuple[float, ...] = gate(
        (16.0, 4.0),
        "deg",
        "between the rays of the first two images, tried in turn",
        "convention: COLMAP, a quarter of it",
    )
    few: float = gate(0.8, "share", "of images placed, below which another way is tried", "convention: four in five")
    narrow: float = gate(2.0, "deg", "the same angle of the second attempt", "chosen on opensfm_lund")
    narrow_points: float = gate(0.5, "deg", "least angle of a point then", "chosen on opensfm_lund")
    first_matches: int = gate(40, "matches", "of the first two images then", "chosen on opensfm_lund")
    matches: int = gate(15, "matches", "of every other image then", "convention: COLMAP's of a pair")


GATES = MapperGates()


@dataclass(frozen=True)
class Task:
    """What a mapper works on."""

    pycolmap: Any
    database: Path
    images: Path
    work: Path
    #: Number of images.
    count: int
    options: PointModelOptions

    @property
    def calibrated(self) -> bool:
        """Whether the calibration is known and stays."""
        return self.options.is_calibrated


Say = Callable[[str, int, int], None]


def map_incrementally(task: Task, say: Say) -> list[Any]:
    """Return the models that the incremental mapper makes."""
    models: list[Any] = []
    for angle in GATES.first_angles:
        models = models or _incremental(task, _options(task, angle, task.calibrated), say)
    if _most(models) >= GATES.few * task.count:
        return models
    options = _options(task, GATES.narrow, True)
    options.mapper.init_max_forward_motion = 1.0
    options.mapper.init_min_num_inliers = GATES.first_matches
    options.mapper.abs_pose_min_num_inliers = GATES.matches
    options.mapper.filter_min_tri_angle = options.triangulation.min_angle = GATES.narrow_points
    others = _incremental(task, options, say)
    if _most(others) <= _most(models):
        return models
    for model in others if not task.calibrated else []:
        _free_calibration(task.pycolmap, model)
    return others


def map_globally(task: Task, say: Say) -> list[Any]:
    """Return the models that the global mapper makes."""
    pycolmap, options = task.pycolmap, task.pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = task.options.seed
    options.mapper.refine_sensor_from_rig = task.options.refine_rigs
    adjusting = options.mapper.bundle_adjustment
    adjusting.refine_focal_length = adjusting.refine_extra_params = not task.calibrated
    say("placing cameras", 0, task.count)
    found = pycolmap.global_mapping(task.database, task.images, task.work / "models", options=options)
    return [found[number] for number in sorted(found)]


#: Mappers by name.
MAPPERS: dict[str, Callable[[Task, Say], list[Any]]] = {"incremental": map_incrementally, "global": map_globally}


def _free_calibration(pycolmap: Any, model: Any) -> None:
    """Adjust a model with its focal lengths and distortion; pycolmap's function for that writes to the terminal."""
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.print_summary = options.refine_sensor_from_rig = False
    options.ceres.solver_options.num_threads = 1
    for number, image in model.images.items():
        if image.has_pose:
            config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _most(models: list[Any]) -> int:
    return max((model.num_reg_images() for model in models), default=0)


def _options(task: Task, angle: float, held: bool) -> Any:
    options = task.pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1  # with more, sums depend on which thread is first, and so do the points kept
    for part in (options, options.mapper, options.triangulation):
        part.random_seed = task.options.seed
    options.mapper.init_min_tri_angle = angle
    options.ba_refine_sensor_from_rig = task.options.refine_rigs
    if held:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    return options


def _incremental(task: Task, options: Any, say: Say) -> list[Any]:
    placed = [0]

    def one_more(number: int) -> None:
        placed[0] += number
        say("placing cameras", min(placed[0], task.count), task.count)

    say("placing cameras", 0, task.count)
    found = task.pycolmap.incremental_mapping(
        task.database,
        task.images,
        task.work / "models",
        options=options,
        initial_image_pair_callback=lambda: one_more(2),
        next_image_callback=lambda: one_more(1),
    )
    return [found[number] for number in sorted(found)]
