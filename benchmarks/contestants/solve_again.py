# SPDX-License-Identifier: BSD-3-Clause
"""groma on one file again and again: ``solve_again.py FILE``. A line on standard input, a solve, a line of JSON.

For ``against.py``, which has two of these with different sources on their path. BAL files are solved as they stand,
archives adjusted as a whole, both as in ``groma_solve.py``.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import resource
import sys
import time
from collections.abc import Callable, Iterable

import numpy as np
from _common import MAX_STEPS, TOLERANCE, peak_memory_mib

import groma
from groma.io import read_scene
from groma.solver.options import SolverOptions
from groma.solver.report import SolveReport
from groma.solver.solve import solve

#: Where problems are made from scenes, in sources of today and of before 23 November 2026.
ASSEMBLIES = ("groma.adjustment.assemble", "groma.pipelines._assemble")


def assembled(scene: groma.Scene):
    """Return the problem of a BAL scene."""
    for name in ASSEMBLIES:
        try:
            module = importlib.import_module(name)
        except ModuleNotFoundError:
            continue
        return module.assemble(scene, module.AssemblyOptions(refine_intrinsics=True, drop_behind=False)).problem
    raise SystemExit(f"groma of {groma.__file__} has none of {', '.join(ASSEMBLIES)}.")


def solver_of(path: str) -> Callable[[], tuple[SolveReport, Iterable[np.ndarray]]]:
    """Return what solves the problem of a file from its start: report, states."""
    scene = read_scene(path)
    rule = {"max_iterations": MAX_STEPS, "function_tolerance": TOLERANCE, "threads": 1}
    if path.endswith(".npz"):
        options = groma.AdjustOptions(loss="none", planes=False, **rule)

        def adjusted():
            result = groma.adjust(scene, options)
            return result.report.solve, (result.scene.cam_from_world, result.scene.points.xyz)

        return adjusted
    problem = assembled(scene)
    strict = SolverOptions(gradient_tolerance=0.0, step_tolerance=0.0, **rule)

    def solved():
        solution = solve(problem, strict)
        return solution.report, [group.state for group in solution.problem.variables.values()]

    return solved


def main() -> None:
    run = solver_of(sys.argv[1])
    run()
    print(groma.__file__, flush=True)
    for _ in sys.stdin:
        faults, begin = resource.getrusage(resource.RUSAGE_SELF).ru_minflt, time.process_time()
        report, states = run()
        cpu, faults = time.process_time() - begin, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults
        bits = hashlib.sha256(b"".join(np.ascontiguousarray(state).tobytes() for state in states)).hexdigest()[:10]
        found = {"cpu_s": cpu, "faults": faults, "steps": report.iterations, "cost": report.final_cost, "bits": bits}
        print(json.dumps({**found, "peak_memory_mib": peak_memory_mib()}), flush=True)


if __name__ == "__main__":
    main()
