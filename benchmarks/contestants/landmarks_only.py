# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks against cameras that are held: 5 000 points and 2 000 lines, each a problem of its own, warm."""

from __future__ import annotations

import time

import numpy as np
from _common import report

from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.scene import synthetic
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

REPEATS = 9


def main() -> None:
    made = synthetic.corridor("small")
    # landmarks as at the start, cameras as they are
    scene = made.start.with_poses(made.truth.cam_from_world)
    problem = assemble(scene, AssemblyOptions(refine_poses=False, planes=False)).problem
    options = SolverOptions(threads=1)
    times, solved = [], None
    for _ in range(REPEATS):
        begin = time.process_time()
        solved = solve(problem, options)
        times.append(time.process_time() - begin)
    after = solved.problem.variables["points"].ambient()
    report(
        solve_ms=1e3 * float(np.median(times)),
        landmarks=scene.num_points + scene.num_lines,
        observations=scene.num_observations,
        iterations=solved.report.iterations,
        solver=solved.report.linear_solver,
        point_error=float(np.median(np.linalg.norm(after - made.truth.points.xyz, axis=1))),
    )


if __name__ == "__main__":
    main()
