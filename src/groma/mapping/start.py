# SPDX-License-Identifier: BSD-3-Clause
"""The first stage of a map: poses and points, given, reconstructed from photographs, or found at given poses.

Where nothing is known of the cameras, their distortion is estimated with one coefficient first, which is what few
photographs determine; where the residuals show that the lens needs a second one, it gets it. Their principal points are
near the middle of the image, and estimated with that (:mod:`groma.adjustment.terms.principal_points`).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.misfit.lens import unmodelled_distortion
from groma.adjustment.terms.principal_points import near_the_middle
from groma.io.colmap.sfm import reconstruct_points
from groma.mapping.checkpoint_files import REGISTERED, SCENE
from groma.mapping.checkpoints import Stages, stage
from groma.mapping.options import MapOptions, StageProgress
from groma.mapping.posed.register import register_photographs
from groma.mapping.posed.registered import RegisteredPhotographs
from groma.mapping.shown import check_points_shown
from groma.scene import Scene

#: Models with one and with two coefficients of radial distortion.
SIMPLE_LENS, WIDER_LENS = "SIMPLE_RADIAL", "RADIAL"
LENS_NOTE = f"The lens needs two coefficients of distortion ({WIDER_LENS}): one left more in the residuals than noise."


def start_of(folder: Path, names: list[str], model: Scene | None, stages: Stages[MapOptions]) -> RegisteredPhotographs:
    """Return poses and points of photographs, from the given data.

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
        return stages.run(register_at_poses, folder, model, stages.folder_of)
    scene = stages.run(find_start, folder, names, model, stages.folder_of)
    widened = model is None and _is_unknown(stages.options) and WIDER_LENS in scene.cameras.models
    return RegisteredPhotographs(scene, (LENS_NOTE,) if widened else ())


@stage("model", SCENE, lambda o: (o.point_model(threads=False), o.refine_intrinsics, o.max_iterations))
def find_start(
    folder: Path,
    names: list[str],
    model: Scene | None,
    folder_of: Callable[[str], Path],
    options: MapOptions,
    say: StageProgress,
) -> Scene:
    """Poses and points: the given ones, or reconstructed from the images."""
    if model is not None:
        check_points_shown(model, [folder / name for name in model.images.names])
        return model
    found = reconstruct_points(folder, folder_of("sfm"), names, options.point_model(), say)
    if options.point_model().is_partly_calibrated:
        return found
    if options.refine_intrinsics is not False:
        found = near_the_middle(found)
    return with_fitting_lens(found, options)


def with_fitting_lens(scene: Scene, options: MapOptions) -> Scene:
    """Return a reconstruction with the principal points that suit it, if anything is known of these; and with a second
    coefficient of radial distortion where no model was asked for and the residuals show that it lacks.
    """
    kept = options.refine_intrinsics is False
    alone = AdjustOptions(
        lines=False,
        planes=False,
        refine_intrinsics=True,
        refine_principal_point=False if kept else None,
        check_lens=False,
        max_iterations=options.max_iterations,
        threads=options.threads,
    )
    if kept and not _is_unknown(options):
        return scene
    one = adjust(scene, alone)
    wider = {SIMPLE_LENS: WIDER_LENS} if _is_unknown(options) else {}
    if not wider or one.problem is None or unmodelled_distortion(one.problem, options.threads, wider=wider) is None:
        return scene if kept else one.scene
    return adjust(one.scene.replace(cameras=one.scene.cameras.with_model(WIDER_LENS)), alone).scene


def _is_unknown(options: MapOptions) -> bool:
    """Whether no option describes the cameras."""
    return options.camera_model is None and not options.point_model().is_calibrated


@stage(
    "registered",
    REGISTERED,
    lambda o: (o.point_model(threads=False), o.refine_poses, o.refine_intrinsics, o.max_iterations),
)
def register_at_poses(
    folder: Path, given: Scene, folder_of: Callable[[str], Path], options: MapOptions, say: StageProgress
) -> RegisteredPhotographs:
    """Points at given poses, and what these are worth."""
    how = (options.refine_poses, bool(options.refine_intrinsics), options.max_iterations)
    return register_photographs(folder, folder_of("sfm"), given, options.point_model(), *how, say)
