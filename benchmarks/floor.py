# SPDX-License-Identifier: BSD-3-Clause
"""Where the time of a solve goes, and how near each stage is to what the machine can do at all.

    python benchmarks/floor.py [PROBLEM ...] [--rounds N] [--data DIR]

For each problem (as in ``run.py``; default the small BAL ones and ``lines-50``) one line per stage: calls, CPU time on
one thread, floating point operations and bytes that must be read and written at least, and the *floor*: the larger of
operations over the machine's best rate (a product of two large matrices) and bytes over its memory bandwidth (a sum of
two arrays larger than the caches). Operations are counted from the layout of the problem: block products exactly,
residuals and derivatives by their formulas, roughly. Bytes count every stored block once per call, as if the caches
kept nothing between calls and everything within one.

The setup is not a stage of a step and has no floor here. Writes ``benchmarks/results/floor.md`` and ``floor.json``.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

from _workshop import CACHE, PROBLEMS, ROOT, THREAD_VARIABLES, keep_results, machine

for _variable in THREAD_VARIABLES:
    os.environ[_variable] = "1"
os.environ.setdefault("NUMBA_CACHE_DIR", str(CACHE / "numba"))

import numpy as np  # noqa: E402

from groma import _stopwatch  # noqa: E402
from groma.adjustment.assemble import assemble  # noqa: E402
from groma.adjustment.assembly_options import AssemblyOptions  # noqa: E402
from groma.io import read_scene  # noqa: E402
from groma.problem.lay_out import lay_out  # noqa: E402
from groma.problem.layout import Layout  # noqa: E402
from groma.solver.options import SolverOptions  # noqa: E402
from groma.solver.report import SolveReport  # noqa: E402
from groma.solver.solve import solve  # noqa: E402

#: Operations of one residual, and of one residual with its derivatives, without the sums: by the formulas.
EVALUATION = {"point_reprojection": (45, 140), "line_reprojection": (70, 230), "line_bearing": (70, 230)}
DOUBLE, INDEX = 8, 4
DEFAULT = ("ladybug-49", "trafalgar-21", "dubrovnik-16", "lines-50")


@dataclass
class Work:
    """Operations and bytes of one call of a stage."""

    flops: float = 0.0
    bytes: float = 0.0

    def add(self, flops: float, doubles: float = 0.0, indices: float = 0.0) -> None:
        """Add work."""
        self.flops += flops
        self.bytes += DOUBLE * doubles + INDEX * indices


def work_of(layout: Layout, report: SolveReport) -> dict[str, Work]:
    """Return the work of one call of each stage."""
    stages = {name: Work() for name in ("linearize", "schur", "solve", "backsubstitute", "cost")}
    kept = [c.width for c in layout.kept]
    for f in layout.factors:
        count, rows = len(f.factor), f.factor.residual_size
        residual, derivative = EVALUATION.get(f.factor.type_name, (60, 200))
        measured = sum(size or 1 for _, size in getattr(f.factor, "measured", ()))
        references = len(f.factor.references())
        stages["cost"].add(count * residual, count * measured, count * references)
        line = stages["linearize"]
        line.add(count * derivative, count * measured, count * (references + 2))
        line.add(count * 2 * rows * f.width)  # noise and loss
        for chain in f.chains:
            line.add(count * 2 * rows * chain.raw_size * chain.dof)
        dl = 0 if f.eliminated is None else layout.eliminated[f.eliminated].dof
        line.add(count * 2 * rows * dl * (dl + 1))
        for entry in f.kept:
            dc = kept[entry.kept_class]
            line.add(count * 2 * rows * dc * (dl + dc + 1))
        for i, j, _ in f.crosses:
            line.add(count * 2 * rows * kept[f.kept[i].kept_class] * kept[f.kept[j].kept_class])
    for e in layout.eliminated:
        d = e.dof
        stages["linearize"].add(0, 2 * e.count * d * (d + 1))
        stages["schur"].add(e.count * 2 * d**3, 2 * e.count * d * (d + 1))
        stages["backsubstitute"].add(e.count * 2 * d * d, e.count * (d * d + 2 * d))
        for c, incidences in e.incidences.items():
            number, pairs, dc = len(incidences.block), len(incidences.pair_slots), kept[c]
            stages["linearize"].add(0, number * d * dc)
            # W is still in cache when it is eliminated
            stages["schur"].add(2 * number * d * dc * (d + 1) + 2 * pairs * d * dc * dc, 0, number + pairs)
            stages["backsubstitute"].add(2 * number * d * dc, number * d * dc, number)
        for (a, b), (slots, _) in e.cross.items():
            stages["schur"].add(2 * len(slots) * d * kept[a] * kept[b], 0, len(slots))
    stored = 0
    for (a, b), (block_rows, _) in layout.blocks.items():
        stored += len(block_rows) * kept[a] * kept[b]
    stages["schur"].add(2 * stored, 3 * stored)
    n = layout.num_kept_unknowns
    if report.linear_solver == "pcg":
        iterations = sum(step.linear_iterations for step in report.history) / max(1, len(report.history))
        stages["solve"].add(iterations * (4 * stored + 12 * n), iterations * (stored + 10 * n))
    elif report.linear_solver == "dense":
        stages["solve"].add(n**3 / 3 + 4 * n * n, n * n)
    return stages


def calls_of(report: SolveReport) -> dict[str, int]:
    """Return how often each stage ran: per step, but only accepted steps are followed by a linearisation."""
    steps = report.iterations
    accepted = sum(step.accepted for step in report.history)
    ended = bool(report.history) and report.history[-1].accepted
    return {"linearize": 1 + accepted - ended, "schur": steps, "solve": steps, "backsubstitute": steps, "cost": steps}


def peak_rates() -> tuple[float, float]:
    """Return operations and bytes per CPU second of this machine, one thread."""
    matrix = np.random.default_rng(0).normal(size=(900, 900))
    first, second, total = (np.ones(6_000_000) for _ in range(3))

    def best(work) -> float:
        times = []
        for _ in range(5):
            begin = time.process_time()
            work()
            times.append(time.process_time() - begin)
        return min(times)

    matrix @ matrix
    return 2 * 900**3 / best(lambda: matrix @ matrix), 24 * 6e6 / best(lambda: np.add(first, second, out=total))


def measure(path: Path, rounds: int) -> tuple[SolveReport, dict[str, float], Layout]:
    """Solve a few times and return the last report, the median CPU time by stage, and the layout."""
    scene = read_scene(path)
    is_bal = path.suffix != ".npz"
    problem = assemble(scene, AssemblyOptions(refine_intrinsics=is_bal, drop_behind=False, planes=False)).problem
    rule = {"function_tolerance": 1e-6, "gradient_tolerance": 0.0, "step_tolerance": 0.0, "threads": 1}
    solve(problem, SolverOptions(max_iterations=2, **rule))
    reports = [solve(problem, SolverOptions(**rule)).report for _ in range(rounds)]
    seconds = {name: statistics.median(r.seconds[name] for r in reports) for name in reports[0].seconds}
    return reports[-1], seconds, lay_out(problem, "auto")


def main() -> int:
    names = [problem.name for problem in PROBLEMS]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", metavar="PROBLEM", help=", ".join(names))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data" / "bal", help="folder of BAL files"
    )
    arguments = parser.parse_args()
    wanted = arguments.problems or DEFAULT
    if unknown := {*wanted} - {*names}:
        parser.error(f"no such problem: {', '.join(sorted(unknown))}")
    # the stages of a report are timed by this clock: CPU time instead of wall time, so that other work does not count
    _stopwatch.time = SimpleNamespace(perf_counter=time.process_time)
    flops, bandwidth = peak_rates()
    lines = [
        f"One thread: {flops / 1e9:.1f} GFLOP/s (matrix product), {bandwidth / 1e9:.1f} GB/s (sum of arrays).",
        "",
        "| problem | stage | calls | CPU ms | MFLOP per call | MB per call | GFLOP/s | floor ms | CPU / floor |",
        "|---|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    results = []
    for problem in PROBLEMS:
        if problem.name not in wanted:
            continue
        if not problem.prepare(arguments.data):
            print(f"{problem.title} is left out: {problem.missing(arguments.data)}")
            continue
        report, seconds, layout = measure(problem.file_for("groma"), arguments.rounds)
        calls, entry = calls_of(report), {"problem": problem.name, "stages": {}}
        for number, (stage, work) in enumerate(work_of(layout, report).items()):
            cpu, floor = seconds[stage], calls[stage] * max(work.flops / flops, work.bytes / bandwidth)
            entry["stages"][stage] = {
                "calls": calls[stage], "cpu_s": cpu, "flops": work.flops, "bytes": work.bytes, "floor_s": floor
            }  # fmt: skip
            rate = calls[stage] * work.flops / max(cpu, 1e-9)
            lines.append(
                f"| {problem.title if number == 0 else ''} | {stage} | {calls[stage]} | {1e3 * cpu:.1f} "
                f"| {work.flops / 1e6:.2f} | {work.bytes / 1e6:.2f} | {rate / 1e9:.1f} | {1e3 * floor:.1f} "
                f"| {cpu / floor if floor else float('nan'):.1f} |"
            )
        total = seconds["total"]
        floor = sum(stage["floor_s"] for stage in entry["stages"].values())
        lines.append(
            f"| | *setup* | 1 | {1e3 * seconds['setup']:.1f} | | | | | |\n"
            f"| | **all, {report.linear_solver}** | {report.iterations} steps | {1e3 * total:.1f} | | | "
            f"| {1e3 * floor:.1f} | {total / floor:.1f} |"
        )
        results.append({**entry, "cpu_s": total, "setup_s": seconds["setup"], "floor_s": floor})
    content = {
        "problem": "floor",
        "machine": machine(),
        "flops_per_s": flops,
        "bytes_per_s": bandwidth,
        "results": results,
        "metrics": {f"{r['problem']}_over_floor": r["cpu_s"] / r["floor_s"] for r in results},
    }
    keep_results("floor", content, "\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
