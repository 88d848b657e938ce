# SPDX-License-Identifier: BSD-3-Clause
"""groma on a BAL file or a groma archive: ``groma_solve.py FILE [--warm] [--solver NAME]``.

``--warm`` makes two steps first, so that the timed solve finds its kernels in memory; without it the run is what a
user gets, and gives the peak memory. BAL files: calibration estimated; archives: calibration held.
"""

from __future__ import annotations

import argparse

from _common import Clock, report

import groma
from groma.io import read_scene
from groma.pipelines._assemble import AssemblyOptions, assemble
from groma.solver.options import SolverOptions
from groma.solver.solve import solve


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file")
    parser.add_argument("--warm", action="store_true")
    parser.add_argument("--solver", default="auto")
    arguments = parser.parse_args()

    scene = read_scene(arguments.file)
    is_bal = not arguments.file.endswith(".npz")
    problem = assemble(scene, AssemblyOptions(refine_intrinsics=is_bal, drop_behind=False, planes=False)).problem
    # One rule for all contestants: a relative change of the cost of 1e-6, or 50 steps.
    rule = {"function_tolerance": 1e-6, "gradient_tolerance": 0.0, "step_tolerance": 0.0, "threads": 1}
    if arguments.warm:
        solve(problem, SolverOptions(max_iterations=2, linear_solver=arguments.solver, **rule))
    clock = Clock()
    solved = solve(problem, SolverOptions(max_iterations=50, linear_solver=arguments.solver, **rule)).report
    times = clock.read()
    report(
        contestant="groma",
        version=groma.__version__,
        solver=solved.linear_solver,
        **times,
        iterations=solved.iterations,
        initial_cost=solved.initial_cost,
        final_cost=solved.final_cost,
        stages={name: round(seconds, 4) for name, seconds in solved.seconds.items()},
    )


if __name__ == "__main__":
    main()
