# SPDX-License-Identifier: BSD-3-Clause
"""groma on an archive, a few steps, with what it costs: ``scale_solve.py FILE STEPS THREADS``.

Compiled functions are loaded by small solves first, those that only large problems need too.
"""

from __future__ import annotations

import resource
import sys
import time
from pathlib import Path
from types import SimpleNamespace

from _common import Clock, peak_memory_mib, report

import groma.solver.joint as joint
from groma import _stopwatch
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.io import read_scene
from groma.scene import Scene, synthetic
from groma.solver.options import SolverOptions
from groma.solver.solve import solve


def problem_of(scene: Scene):
    """Return the problem of the points and lines of a scene, calibration held."""
    return assemble(scene, AssemblyOptions(refine_intrinsics=False, drop_behind=False, planes=False)).problem


def main() -> None:
    path, steps, threads = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    if threads == 1:  # the stages of a report are then timed by CPU time, so that other work does not count
        _stopwatch.time = SimpleNamespace(perf_counter=time.process_time)
    small = problem_of(synthetic.corridor(120).start.points_only())
    threshold = joint.COMPACT_FROM
    for bytes_ in (threshold, 0):
        joint.COMPACT_FROM = bytes_
        for solver in ("dense", "pcg"):
            solve(small, SolverOptions(max_iterations=2, threads=threads, linear_solver=solver))
    joint.COMPACT_FROM = threshold
    before = peak_memory_mib()
    reading = Clock()
    scene = read_scene(path)
    read = reading.read()
    making = Clock()
    problem = problem_of(scene)
    made = making.read()
    after_making = peak_memory_mib()
    rule: dict = {"function_tolerance": 0.0, "gradient_tolerance": 0.0, "step_tolerance": 0.0}
    ends: list[float] = []

    def note_end_of_step(_step) -> None:
        ends.append(time.process_time())

    system = resource.getrusage(resource.RUSAGE_SELF).ru_stime
    clock = Clock()
    solved = solve(problem, SolverOptions(max_iterations=steps, threads=threads, **rule), note_end_of_step).report
    times = clock.read()
    report(
        contestant="groma",
        observations=scene.num_observations,
        images=scene.num_images,
        landmarks=scene.num_points + scene.num_lines,
        solver=solved.linear_solver,
        threads=threads,
        read_s=read["cpu_s"],
        assemble_s=made["cpu_s"],
        **times,
        system_s=resource.getrusage(resource.RUSAGE_SELF).ru_stime - system,
        later_step_s=(ends[-1] - ends[0]) / (len(ends) - 1),
        iterations=solved.iterations,
        initial_cost=solved.initial_cost,
        final_cost=solved.final_cost,
        linear_iterations=sum(step.linear_iterations for step in solved.history),
        # share of each stage in the whole time
        stages={name: seconds / solved.seconds["total"] for name, seconds in solved.seconds.items()},
        process_mib=before,
        before_solve_mib=after_making,
    )


if __name__ == "__main__":
    main()
