# SPDX-License-Identifier: BSD-3-Clause
"""LIMAP 2 on a holistic scene: ``limap_holistic.py FOLDER KIND RESULT.npz [--threads N]``; KIND as in ``holistic.py``.

Two cameras fix the gauge, intrinsics are held, losses and weights are LIMAP's defaults. Runs in an environment that has
``pylimap``.
"""

from __future__ import annotations

import argparse
from importlib.metadata import version

import limap.estimators.bundle_adjustment as adjusters
import numpy as np
import pycolmap
from _common import Clock, report
from limap.scene import HolisticReconstruction

#: Options, configuration and maker of the adjuster, by kind.
MAKERS = {
    "points": ("PointLineBundleAdjustmentOptions", "PointLineBundleAdjustmentConfig", "point_line"),
    "lines": ("PointLineBundleAdjustmentOptions", "PointLineBundleAdjustmentConfig", "point_line"),
    "planes": ("GroupBundleAdjustmentOptions", "GroupBundleAdjustmentConfig", "group"),
    "wireframe": ("StructureBundleAdjustmentOptions", "GroupBundleAdjustmentConfig", "structure"),
}


def adjuster_for(kind: str, scene: HolisticReconstruction, threads: int):
    """Return LIMAP's adjuster of one kind."""
    options_name, config_name, maker = MAKERS[kind]
    options, config = getattr(adjusters, options_name)(), getattr(adjusters, config_name)()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.print_summary = False
    options.ceres.solver_options.num_threads = threads
    options.ceres.min_num_residuals_for_cpu_multi_threading = 0
    options.ceres.solver_options.max_num_iterations = 100
    for image in scene.point_recon.images:
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    if kind != "points":
        for line in scene.structure_recon.line3D_ids():
            config.add_variable_line(line)
    if kind in ("planes", "wireframe"):
        for group in scene.structure_recon.group3D_ids():
            config.add_variable_group(group)
        # Planes are tied to be orthogonal or parallel only if asked: groma does not either.
        options.enforce_plane_angular_constraints = options.enforce_vp_angular_constraints = False
    if kind == "wireframe":
        options.force_reconstruct_wireframe3d = False
    return getattr(adjusters, f"create_{maker}_bundle_adjuster")(options, config, scene)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder")
    parser.add_argument("kind", choices=MAKERS)
    parser.add_argument("result")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = 2

    scene = HolisticReconstruction(arguments.folder)
    clock = Clock()
    summary = adjuster_for(arguments.kind, scene, arguments.threads).solve().ceres_summary
    times = clock.read()
    images, points = scene.point_recon.images, scene.point_recon.points3D
    lines, planes = scene.structure_recon.lines3D, scene.structure_recon.groups3D
    order = sorted(images)
    np.savez(
        arguments.result,
        images=np.array([images[i].name for i in order]),
        poses=np.array([images[i].cam_from_world().matrix() for i in order]),
        points=np.array([points[i].xyz for i in sorted(points)]),
        lines=np.array([[lines[i].start, lines[i].end] for i in sorted(lines)]),
        planes=np.array([planes[i].params for i in sorted(planes)]),
    )
    # Ceres counts the evaluation of the start as a successful step.
    steps = max(1, summary.num_successful_steps + summary.num_unsuccessful_steps - 1)
    report(
        contestant="limap",
        version=version("pylimap"),
        **times,
        iterations=steps,
        initial_cost=summary.initial_cost,
        final_cost=summary.final_cost,
    )


if __name__ == "__main__":
    main()
