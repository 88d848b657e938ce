# SPDX-License-Identifier: BSD-3-Clause
"""groma on a BAL file or a groma archive: ``groma_solve.py FILE [--warm] [--threads N] [--solver NAME]``.

A BAL file is solved as it stands, calibration estimated. An archive of points and lines, calibration held, goes
through :func:`groma.adjust` as a user would call it: it triangulates lines that are stuck anew between two solves; its
whole time counts. ``--warm`` makes a short run first, so that kernels are in memory; without it the run is what a user
gets, and gives the peak memory.
"""

from __future__ import annotations

import argparse

from _common import MAX_STEPS, TOLERANCE, Curve, report

import groma
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.io import read_scene
from groma.solver.options import SolverOptions
from groma.solver.solve import solve


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file")
    parser.add_argument("--warm", action="store_true")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--solver", default="auto")
    arguments = parser.parse_args()

    scene = read_scene(arguments.file)
    run = _points(scene, arguments) if not arguments.file.endswith(".npz") else _points_and_lines(scene, arguments)
    if arguments.warm:
        run(2, Curve())
    curve = Curve()
    solved = run(MAX_STEPS, curve)
    report(
        contestant="groma",
        version=groma.__version__,
        solver=solved.linear_solver,
        threads=arguments.threads,
        **curve.finish(),
        iterations=solved.iterations,
        initial_cost=solved.initial_cost,
        final_cost=solved.final_cost,
        stages={name: round(seconds, 4) for name, seconds in solved.seconds.items()},
    )


def _points(scene: groma.Scene, arguments: argparse.Namespace):
    problem = assemble(scene, AssemblyOptions(refine_intrinsics=True, drop_behind=False)).problem
    rule = {"function_tolerance": TOLERANCE, "gradient_tolerance": 0.0, "step_tolerance": 0.0}
    given = {"threads": arguments.threads, "linear_solver": arguments.solver, **rule}

    def run(steps: int, curve: Curve):
        return solve(problem, SolverOptions(max_iterations=steps, **given), lambda step: curve.add(step.cost)).report

    return run


def _points_and_lines(scene: groma.Scene, arguments: argparse.Namespace):
    given = {"loss": "none", "planes": False, "threads": arguments.threads, "linear_solver": arguments.solver}

    def run(steps: int, curve: Curve):
        options = groma.AdjustOptions(max_iterations=steps, function_tolerance=TOLERANCE, **given)
        return groma.adjust(scene, options, lambda step: curve.add(step.cost)).report.solve

    return run


if __name__ == "__main__":
    main()
