# SPDX-License-Identifier: BSD-3-Clause
"""How long a user waits for small things.

    python benchmarks/latency.py [--rounds N]

- *motion only*: one image, 500 points and 100 lines held, the pose estimated; warm, with and without making the
  problem. What a tracker calls for every frame.
- *landmarks only*: 5 000 points and 2 000 lines, cameras held; warm.
- ``import groma`` and ``groma --help``, whole process.
- ``groma adjust`` on Ladybug-49 (or the problem in the package), whole process: the first run with an empty cache,
  which compiles the kernels, and the next one.
- ``groma warmup``, whole process: with an empty cache, and again.

Medians; writes ``benchmarks/results/latency.json`` and ``latency.md``.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from _workshop import CONTESTANTS, PROBLEMS, ROOT, calibrate, environment, keep_results, machine, run_program


def whole_process(command: list[str], cache: str) -> dict[str, float]:
    """Run a command with as many threads as it likes and return its wall and CPU time."""
    free = environment(None, NUMBA_CACHE_DIR=cache)
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=free)
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    return {"wall_s": wall, "cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime}


def medians(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the median of each field."""
    return {field: statistics.median(row[field] for row in rows) for field in rows[0]}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data" / "bal", help="BAL files")
    arguments = parser.parse_args()
    problem = next(problem for problem in PROBLEMS if not problem.is_corridor and problem.prepare(arguments.data))
    groma = [sys.executable, "-m", "groma.cli.main"]
    adjust = [*groma, "adjust", os.fspath(problem.file_for("groma")), "--quiet"]

    with tempfile.TemporaryDirectory() as cache:
        whole_process([*groma, "adjust", "--help"], cache)  # bytecode, which an installation brings along
        whole_process([sys.executable, "-c", "import groma.io, groma.adjustment.adjust"], cache)
        first = whole_process(adjust, cache)  # compiles the kernels: once
        units, following, importing, helping, frames, landmarks = [], [], [], [], [], []
        for _ in range(arguments.rounds):
            units.append(calibrate())
            following.append(whole_process(adjust, cache))
            importing.append(whole_process([sys.executable, "-c", "import groma"], cache))
            helping.append(whole_process([*groma, "--help"], cache))
            frames.append(run_program([sys.executable, CONTESTANTS / "motion_only.py"]))
            landmarks.append(run_program([sys.executable, CONTESTANTS / "landmarks_only.py"]))
    if None in frames or None in landmarks:
        return 1
    with tempfile.TemporaryDirectory() as cache:
        warming = [whole_process([*groma, "warmup", "--quiet"], cache) for _ in range(2)]
    unit = statistics.median(units)
    result = {
        "problem": "latency",
        "adjusted": problem.title,
        "machine": machine(),
        "calibration_s": unit,
        "first_adjust": first,
        "next_adjust": medians(following),
        "import": medians(importing),
        "help": medians(helping),
        "motion_only_ms": medians([{k: v for k, v in f.items() if k.endswith("_ms")} for f in frames]),
    }
    result["landmarks_only_ms"] = statistics.median(run["solve_ms"] for run in landmarks)
    result["first_warmup"], result["next_warmup"] = warming
    result["metrics"] = {
        "landmarks_only_in_calibrations": result["landmarks_only_ms"] / 1e3 / unit,
        "first_warmup_in_calibrations": result["first_warmup"]["cpu_s"] / unit,
        "next_warmup_in_calibrations": result["next_warmup"]["cpu_s"] / unit,
        "motion_only_in_calibrations": result["motion_only_ms"]["solve_ms"] / 1e3 / unit,
        "first_adjust_in_calibrations": result["first_adjust"]["cpu_s"] / unit,
        "next_adjust_in_calibrations": result["next_adjust"]["cpu_s"] / unit,
        "import_in_calibrations": result["import"]["cpu_s"] / unit,
    }
    frame = result["motion_only_ms"]
    adjusting = f"`groma adjust` {problem.title}"
    rows = [
        ("motion only, 500 points and 100 lines: solve", None, frame["solve_ms"] / 1e3),
        ("the same with making the problem", None, frame["total_ms"] / 1e3),
        ("landmarks only, 5 000 points and 2 000 lines", None, result["landmarks_only_ms"] / 1e3),
        ("`import groma`", *result["import"].values()),
        ("`groma --help`", *result["help"].values()),
        (f"{adjusting}, first ever", *first.values()),
        (f"{adjusting}, next", *result["next_adjust"].values()),
        ("`groma warmup`, empty cache", *warming[0].values()),
        ("`groma warmup`, again", *warming[1].values()),
    ]
    lines = ["| what | wall s | CPU s |", "|---|--:|--:|"]
    for what, wall, cpu in rows:
        lines.append(f"| {what} | {'' if wall is None else f'{wall:.3f}'} | {cpu:.4f} |")
    keep_results("latency", result, "\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
