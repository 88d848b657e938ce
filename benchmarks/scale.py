# SPDX-License-Identifier: BSD-3-Clause
"""How time and memory grow with the number of observations.

    python benchmarks/scale.py [--millions 0.5 1 2 4] [--steps 5] [--rounds N] [--threads 1] [--quick]

The scene is the corridor of :func:`groma.scene.synthetic.corridor`, longer and longer: the same number of points per
image and of images per point, calibration held. Every size runs in a process of its own, the same number of steps from
the same kind of start, all sizes in turn within a round. Reported are CPU time of the solve per step and of its setup,
the peak memory, the exponent of growth (the slope of a straight line through the logarithms), and what a problem of
``--project`` million observations (50) would need at the measured rates. Setup and first step touch most of the memory
for the first time, and on a virtual machine the system takes very different times to hand it out; so the time of a step
after the first, and the share of the system in the whole solve, are given too. A size whose memory, by the sizes before
it, would not fit is left out. Writes ``benchmarks/results/scale.json``, ``scale.md`` and ``scale.svg``.
"""

from __future__ import annotations

import argparse
import math
import statistics
import subprocess
import sys

import _plots
from _workshop import CACHE, CONTESTANTS, RESULTS, environment, keep_results, machine, run_program

#: Observations per image of the corridor.
PER_IMAGE = 900
#: Part of the memory that is free now which a run may take.
SHARE = 0.9


def exponent(x: list[float], y: list[float]) -> float:
    """Return the slope of the straight line through the logarithms."""
    log_x, log_y = [math.log(value) for value in x], [math.log(value) for value in y]
    middle_x, middle_y = statistics.fmean(log_x), statistics.fmean(log_y)
    above = sum((a - middle_x) * (b - middle_y) for a, b in zip(log_x, log_y, strict=True))
    return above / sum((a - middle_x) ** 2 for a in log_x)


def free_mib() -> float:
    """Return the memory that can be had without swapping."""
    try:
        with open("/proc/meminfo") as file:
            return next(int(line.split()[1]) for line in file if line.startswith("MemAvailable")) / 1024
    except (OSError, StopIteration):
        return math.inf


def straight_line(rows: list[dict]) -> tuple[float, float]:
    """Return memory at no observation and per observation, MiB, by least squares."""
    x, y = [row["observations"] for row in rows], [row["peak_memory_mib"] for row in rows]
    if len(rows) < 2:
        return rows[0]["process_mib"], (y[0] - rows[0]["process_mib"]) / x[0]
    slope = statistics.covariance(x, y) / statistics.variance(x)
    return statistics.fmean(y) - slope * statistics.fmean(x), slope


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--millions", type=float, nargs="+", default=[0.5, 1, 2, 4], help="observations")
    parser.add_argument("--steps", type=int, default=5, help="at least 2")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--project", type=float, default=50, metavar="MILLIONS", help="say what so many would need")
    parser.add_argument("--quick", action="store_true", help="0.05 to 0.4 million, one round")
    arguments = parser.parse_args()
    if arguments.steps < 2:
        parser.error("--steps must be at least 2")
    millions = [0.05, 0.1, 0.2, 0.4] if arguments.quick else sorted(arguments.millions)
    rounds = 1 if arguments.quick else arguments.rounds

    CACHE.mkdir(parents=True, exist_ok=True)
    runs: dict[int, list[dict]] = {}
    for turn in range(rounds):
        for million in millions:
            images = max(50, round(1e6 * million / PER_IMAGE))
            if turn and images not in runs:
                continue
            known = [rows[0] for rows in runs.values()]
            if turn == 0 and known:
                base, slope = straight_line(known)
                needed = base + slope * images * PER_IMAGE
                if needed > SHARE * free_mib():
                    print(f"{million:g} million observations are left out: about {needed / 1024:.1f} GiB are needed.")
                    continue
            path = CACHE / f"scale_{images}.npz"
            if not path.is_file():
                script = CONTESTANTS / "make_scale.py"
                subprocess.run([sys.executable, script, str(images), path], check=True, env=environment())
            command = [sys.executable, CONTESTANTS / "scale_solve.py", path, arguments.steps, arguments.threads]
            run = run_program(command, arguments.threads)
            if run is None:
                return 1
            runs.setdefault(images, []).append(run)
            print(
                f"  round {turn + 1}: {run['observations'] / 1e6:.2f} million, {run['cpu_s']:.2f} s CPU, "
                f"{run['peak_memory_mib']:.0f} MiB",
                flush=True,
            )
    rows = []
    for images, found in sorted(runs.items()):
        row = {**found[0], "images": images}
        for field in ("cpu_s", "wall_s", "system_s", "later_step_s", "read_s", "assemble_s", "peak_memory_mib"):
            row[field] = statistics.median(run[field] for run in found)
        row["setup_s"] = statistics.median(run["stages"]["setup"] * run["cpu_s"] for run in found)
        row["step_s"] = (row["cpu_s"] - row["setup_s"]) / max(1, row["iterations"])
        rows.append(row)
    result = summary(rows, arguments.project)
    text = table(rows) + "\n" + "\n".join(result["sentences"])
    keep_results("scale", {**result, "machine": machine(), "sizes": rows}, text)
    observations = [row["observations"] for row in rows]
    _plots.write(
        RESULTS / "scale.svg",
        f"Growth, exponent {result['metrics'].get('exponent', float('nan')):.2f}",
        "observations",
        "CPU seconds per step",
        [
            _plots.Line("all steps", observations, [row["step_s"] for row in rows]),
            _plots.Line("after the first", observations, [row["later_step_s"] for row in rows]),
        ],
    )
    return 0


def summary(rows: list[dict], project: float) -> dict:
    """Return exponents, memory per observation, and what a larger problem would need."""
    observations = [row["observations"] for row in rows]
    base, slope = straight_line(rows)
    metrics = {"bytes_per_observation": slope * 2**20}
    sentences = [f"Memory: {base:.0f} MiB and {slope * 2**20:.0f} bytes per observation."]
    if len(rows) > 1:
        metrics["exponent"] = exponent(observations, [row["step_s"] for row in rows])
        metrics["exponent_later"] = exponent(observations, [row["later_step_s"] for row in rows])
        metrics["exponent_setup"] = exponent(observations, [row["setup_s"] for row in rows])
        sentences.append(
            f"Growth of the CPU time: exponent {metrics['exponent']:.2f} per step, {metrics['exponent_later']:.2f} per "
            f"step after the first, {metrics['exponent_setup']:.2f} for the setup."
        )
        largest = rows[-1]
        factor = 1e6 * project / largest["observations"]
        memory = base + slope * 1e6 * project
        sentences.append(
            f"{project:g} million observations would need {memory / 1024:.1f} GiB and, at the rate of the largest, "
            f"{largest['later_step_s'] * factor ** max(1.0, metrics['exponent_later']):.0f} s of CPU time per step."
        )
    return {"problem": "scale", "metrics": metrics, "sentences": sentences}


def table(rows: list[dict]) -> str:
    """Return the sizes as a Markdown table."""
    lines = [
        "| observations | images | landmarks | linear solver | read s | assemble s | setup s | s per step "
        "| s per later step | system s | peak MiB |",
        "|--:|--:|--:|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for row in rows:
        lines.append(
            f"| {row['observations']:,} | {row['images']:,} | {row['landmarks']:,} | {row['solver']} "
            f"| {row['read_s']:.2f} | {row['assemble_s']:.2f} | {row['setup_s']:.2f} | {row['step_s']:.3f} "
            f"| {row['later_step_s']:.3f} | {row['system_s']:.2f} | {row['peak_memory_mib']:.0f} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
