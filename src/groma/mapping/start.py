# SPDX-License-Identifier: BSD-3-Clause
"""The first stage of a map: poses and points, given, reconstructed from photographs, or found at given poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from groma.io.colmap.sfm import reconstruct_points
from groma.mapping.checkpoint_files import PLACED, SCENE
from groma.mapping.checkpoints import Stages, stage
from groma.mapping.posed.place import place_photographs
from groma.mapping.posed.placed import PlacedPhotographs
from groma.scene import Scene

if TYPE_CHECKING:
    from groma.mapping.map import MapOptions, StageProgress


def start_of(folder: Path, names: list[str], model: Scene | None, stages: Stages[MapOptions]) -> PlacedPhotographs:
    """Return poses and points of photographs, from what is known about them.

    Parameters
    ----------
    folder : Path
        The photographs.
    names : list of str
        Their names in it.
    model : Scene or None
        None: nothing is known. A model without points gives poses alone.
    stages : Stages
        Keeps the result.
    """
    if model is not None and not model.num_point_observations:
        return stages.run(place_at_poses, folder, model, stages.place)
    return PlacedPhotographs(stages.run(find_start, folder, names, model, stages.place))


@stage("model", SCENE, lambda options: options.point_model(threads=False))
def find_start(
    folder: Path,
    names: list[str],
    model: Scene | None,
    place: Callable[[str], Path],
    options: MapOptions,
    say: StageProgress,
) -> Scene:
    """Poses and points: the given ones, or reconstructed from the images."""
    return reconstruct_points(folder, place("sfm"), names, options.point_model(), say) if model is None else model


@stage("placed", PLACED, lambda o: (o.point_model(threads=False), o.refine_poses, o.refine_intrinsics))
def place_at_poses(
    folder: Path, given: Scene, place: Callable[[str], Path], options: MapOptions, say: StageProgress
) -> PlacedPhotographs:
    """Points at given poses, and what these are worth."""
    refine = (options.refine_poses, bool(options.refine_intrinsics))
    return place_photographs(folder, place("sfm"), given, options.point_model(), *refine, say)
