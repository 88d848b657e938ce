# SPDX-License-Identifier: BSD-3-Clause
"""LIMAP 2's adjuster on points and lines, calibration held: ``limap_solve.py FOLDER SOLVER THREADS``.

Squared residuals as for all contestants, and lines not weighted by their length: its cost is that of the others. Two
cameras fix the gauge. Its Ceres has no callback in Python, so the curve is start and end. Needs pylimap 2.
"""

from __future__ import annotations

import sys
from importlib.metadata import version

import limap.estimators.bundle_adjustment as adjusters
import pycolmap
from _common import MAX_STEPS, TOLERANCE, Clock, report
from limap.scene import HolisticReconstruction
from pycolmap._core import pyceres


def main() -> None:
    folder, solver, threads = sys.argv[1:]
    pycolmap.logging.minloglevel = 2
    scene = HolisticReconstruction(folder)
    options, config = adjusters.PointLineBundleAdjustmentOptions(), adjusters.PointLineBundleAdjustmentConfig()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.print_summary = False
    options.loss_function_type_line = pycolmap.LossFunctionType.TRIVIAL
    options.line_weight_normalization_length = 0.0
    options.ceres.min_num_residuals_for_cpu_multi_threading = 0
    options.ceres.auto_select_solver_type = False
    ceres = options.ceres.solver_options
    ceres.linear_solver_type = getattr(pyceres.LinearSolverType, solver.removesuffix("_explicit").upper())
    ceres.use_explicit_schur_complement = solver.endswith("_explicit")
    ceres.preconditioner_type = pyceres.PreconditionerType.SCHUR_JACOBI
    ceres.num_threads, ceres.max_num_iterations = int(threads), MAX_STEPS
    ceres.function_tolerance, ceres.gradient_tolerance, ceres.parameter_tolerance = TOLERANCE, 0.0, 0.0
    for image in scene.point_recon.images:
        config.add_image(image)
    for line in scene.structure_recon.line3D_ids():
        config.add_variable_line(line)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = adjusters.create_point_line_bundle_adjuster(options, config, scene)
    clock = Clock()
    summary = adjuster.solve().ceres_summary
    times = clock.read()
    report(
        contestant="limap",
        version=version("pylimap"),
        solver=solver,
        threads=int(threads),
        **times,
        iterations=max(1, summary.num_successful_steps + summary.num_unsuccessful_steps - 1),
        initial_cost=summary.initial_cost,
        final_cost=summary.final_cost,
        curve=[[0.0, 0.0, summary.initial_cost], [times["cpu_s"], times["wall_s"], summary.final_cost]],
    )


if __name__ == "__main__":
    main()
