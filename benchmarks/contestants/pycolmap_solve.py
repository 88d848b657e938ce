# SPDX-License-Identifier: BSD-3-Clause
"""pycolmap's bundle adjuster on a BAL file: ``pycolmap_solve.py FILE SOLVER THREADS``.

A BAL camera is COLMAP's RADIAL with its principal point at the origin, which the adjuster holds there; the costs are
the same. Needs numpy and pycolmap, not groma.
"""

from __future__ import annotations

import sys

import numpy as np
import pycolmap
from _common import MAX_STEPS, TOLERANCE, Clock, read_bal, report
from pycolmap._core import pyceres


def rotation_of(vector: np.ndarray) -> np.ndarray:
    """Return diag(1, -1, -1) times the rotation of a rotation vector."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle if angle > 0 else vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.diag([1.0, -1, -1]) @ (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def build(path: str) -> pycolmap.Reconstruction:
    """Make the reconstruction: every camera an image of its own in a trivial rig."""
    camera_of, point_of, pixels, cameras, points = read_bal(path)
    pixels = pixels * [1, -1]  # y down
    model = pycolmap.Reconstruction()
    position = np.empty(len(camera_of), dtype=int)
    for index, camera in enumerate(cameras):
        rows = np.flatnonzero(camera_of == index)
        position[rows] = np.arange(len(rows))
        params = [camera[6], 0.0, 0.0, camera[7], camera[8]]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model="RADIAL", width=10000, height=10000, params=params, camera_id=index + 1)
        )
        image = pycolmap.Image(name=f"{index}", keypoints=pixels[rows], camera_id=index + 1, image_id=index + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation_of(camera[:3])), camera[3:6] * [1, -1, -1])
        model.add_image_with_trivial_frame(image, pose)
    order = np.argsort(point_of, kind="stable")
    first = np.searchsorted(point_of[order], np.arange(len(points) + 1))
    for index, point in enumerate(points):
        track = pycolmap.Track()
        for row in order[first[index] : first[index + 1]]:
            track.add_element(int(camera_of[row]) + 1, int(position[row]))
        model.add_point3D(point, track)
    return model


def options_for(solver: str, threads: int) -> pycolmap.BundleAdjustmentOptions:
    """Return the rule of all contestants, with squared residuals."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = True
    options.refine_principal_point = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.TRIVIAL
    options.ceres.auto_select_solver_type = False
    options.ceres.min_num_residuals_for_cpu_multi_threading = 0  # as many threads as asked for
    ceres = options.ceres.solver_options
    ceres.linear_solver_type = getattr(pyceres.LinearSolverType, solver.removesuffix("_explicit").upper())
    ceres.use_explicit_schur_complement = solver.endswith("_explicit")
    ceres.preconditioner_type = pyceres.PreconditionerType.SCHUR_JACOBI
    ceres.num_threads = threads
    ceres.max_num_iterations = MAX_STEPS
    ceres.function_tolerance = TOLERANCE
    ceres.gradient_tolerance = ceres.parameter_tolerance = 0.0
    return options


def main() -> None:
    path, solver, threads = sys.argv[1:]
    model = build(path)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.images:
        config.add_image(image_id)
    adjuster = pycolmap.create_default_bundle_adjuster(options_for(solver, int(threads)), config, model)
    clock = Clock()
    summary = adjuster.solve()
    times = clock.read()
    summary = getattr(summary, "ceres_summary", summary)
    report(
        contestant="pycolmap",
        version=pycolmap.__version__,
        solver=solver,
        threads=int(threads),
        **times,
        iterations=summary.num_successful_steps + summary.num_unsuccessful_steps - 1,
        initial_cost=summary.initial_cost,
        final_cost=summary.final_cost,
    )


if __name__ == "__main__":
    main()
