# SPDX-License-Identifier: BSD-3-Clause
"""Bundle adjustment by groma, Ceres and pycolmap, side by side.

    python benchmarks/run.py [--quick] [--peers ceres,pycolmap] [--rounds N] [--data DIR] [PROBLEM ...]

Same file, same start, same rule (relative change of the cost below 1e-6, or 50 steps), one thread, every run in a
process of its own, all contestants in turn within a round. The first round tries every linear solver of a peer; the
others go on with those that may be its best. Reported are medians; CPU time is that of the solve alone. Writes
``benchmarks/results/PROBLEM.json``, and ``table.md`` of all results there; ``check.py`` compares with the baseline.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from pathlib import Path

from _workshop import (
    CONTESTANTS,
    PROBLEMS,
    RESULTS,
    ROOT,
    BenchmarkProblem,
    build_ceres,
    calibrate,
    forget_kernels,
    machine,
    run_program,
)

SOLVERS = ("dense_schur", "sparse_schur", "iterative_schur", "iterative_schur_explicit")
#: A linear solver this much slower than the best of its peer in the first round is not tried again.
HOPELESS = 1.3
#: Two programs solve the same problem when their initial costs agree to this fraction.
SAME_PROBLEM = 1e-6


def commands_for(problem: BenchmarkProblem, peers: list[str], ceres: Path | None, python: str) -> dict:
    """Return {(contestant, linear solver): command}, groma first."""
    groma = [sys.executable, CONTESTANTS / "groma_solve.py", problem.file_for("groma"), "--warm"]
    commands = {("groma", "auto"): groma}
    if "ceres" in peers and ceres is not None:
        for solver in SOLVERS:
            commands["ceres", solver] = [ceres / f"ceres_{problem.kind}", problem.file_for("ceres"), solver]
    if "pycolmap" in peers and problem.kind == "points":  # it has no lines
        for solver in SOLVERS:
            script = CONTESTANTS / "pycolmap_solve.py"
            commands["pycolmap", solver] = [python, script, problem.file_for("pycolmap"), solver]
    return commands


def compete(problem: BenchmarkProblem, commands: dict, rounds: int) -> dict:
    """Run all contestants round by round and return the result of the problem."""
    runs: dict[tuple[str, str], list[dict]] = {}
    units = []
    # Kernels are compiled and cached; then one run as a user's would be, without a warm-up, for the peak memory.
    run_program(commands["groma", "auto"])
    plain = run_program([word for word in commands["groma", "auto"] if word != "--warm"])
    for turn in range(rounds):
        units.append(calibrate())
        for key, command in list(commands.items()):
            run = run_program(command)
            if run is None:
                del commands[key]
                continue
            runs.setdefault(key, []).append(run)
            print(
                f"  round {turn + 1}: {key[0]:9s} {key[1]:25s} {run['cpu_s']:8.3f} s CPU  cost {run['final_cost']:.7g}"
            )
        if turn == 0:
            for contestant in {name for name, _ in runs}:
                best = min(runs[key][0]["cpu_s"] for key in runs if key[0] == contestant)
                for key in [key for key in runs if key[0] == contestant and runs[key][0]["cpu_s"] > HOPELESS * best]:
                    commands.pop(key, None)
    rows = [summary(key, runs[key]) for key in runs]
    for row in rows:
        if row["contestant"] == "groma" and plain is not None:
            row["peak_memory_mib"] = plain["peak_memory_mib"]
    unit = statistics.median(units)
    return {
        "problem": problem.name,
        "title": problem.title,
        "machine": machine(),
        "rounds": rounds,
        "calibration_s": unit,
        "contestants": rows,
        "metrics": metrics_of(rows, unit),
    }


def summary(key: tuple[str, str], runs: list[dict]) -> dict:
    """Return medians over the rounds, and the range of the CPU time."""
    row = {"contestant": key[0], "solver": runs[0]["solver"], "version": runs[0]["version"], "rounds": len(runs)}
    for field in ("cpu_s", "wall_s", "iterations", "initial_cost", "final_cost", "peak_memory_mib"):
        row[field] = statistics.median(run[field] for run in runs)
    return {**row, "cpu_range_s": [min(run["cpu_s"] for run in runs), max(run["cpu_s"] for run in runs)]}


def best_peers(rows: list[dict]) -> dict[str, dict]:
    """Return the row of each peer's best linear solver: least CPU time.

    Peers that solve a slightly different problem (they leave out observations) are shown, but marked.
    """
    groma = next(row for row in rows if row["contestant"] == "groma")
    best: dict[str, dict] = {}
    for row in sorted(rows, key=lambda row: (row["rounds"] < groma["rounds"], row["cpu_s"])):
        if row["contestant"] != "groma":
            row["same_problem"] = abs(row["initial_cost"] / groma["initial_cost"] - 1) < SAME_PROBLEM
            best.setdefault(row["contestant"], row)
    return best


def metrics_of(rows: list[dict], unit: float) -> dict[str, float]:
    """Return the numbers that ``check.py`` compares."""
    groma = next((row for row in rows if row["contestant"] == "groma"), None)
    if groma is None:
        return {}
    metrics = {
        "final_cost": groma["final_cost"],
        "iterations": groma["iterations"],
        "peak_memory_mib": groma["peak_memory_mib"],
        "cpu_in_calibrations": groma["cpu_s"] / unit,
    }
    peers = [row for row in best_peers(rows).values() if row["same_problem"]]
    if peers:
        metrics["cpu_ratio"] = min(row["cpu_s"] for row in peers) / groma["cpu_s"]
        metrics["cost_ratio"] = groma["final_cost"] / min(row["final_cost"] for row in peers)
        metrics["memory_over_peer_mib"] = groma["peak_memory_mib"] - min(row["peak_memory_mib"] for row in peers)
    return metrics


def table(results: list[dict]) -> str:
    """Return the results as a Markdown table: groma and the best linear solver of each peer."""
    lines = [
        "| problem | program | linear solver | CPU s | wall s | steps | final cost | peak MiB | CPU, groma = 1 |",
        "|---|---|---|--:|--:|--:|--:|--:|--:|",
    ]
    for result in results:
        groma = next(row for row in result["contestants"] if row["contestant"] == "groma")
        for row in [groma, *best_peers(result["contestants"]).values()]:
            title = result["title"] if row is groma else ""
            mark = "" if row.get("same_problem", True) else " (1)"
            lines.append(
                f"| {title} | {row['contestant']} {row['version']}{mark} | {row['solver']} | {row['cpu_s']:.3f} "
                f"| {row['wall_s']:.3f} | {row['iterations']:.0f} | {row['final_cost']:.7g} "
                f"| {row['peak_memory_mib']:.0f} | {row['cpu_s'] / groma['cpu_s']:.1f} |"
            )
    text = "\n".join(lines) + "\n"
    if "(1)" in text:
        text += "\n(1) Leaves out observations of points behind their camera: a slightly different problem.\n"
    return text


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", metavar="PROBLEM", help=", ".join(problem.name for problem in PROBLEMS))
    parser.add_argument("--quick", action="store_true", help="small problems only, 2 rounds")
    parser.add_argument("--peers", default="ceres,pycolmap", help="ceres, pycolmap, both (default), or none")
    parser.add_argument("--rounds", type=int, help="default 5, with --quick 2")
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data" / "bal", help="folder of BAL files"
    )
    parser.add_argument("--python-pycolmap", default=sys.executable, help="Python that has pycolmap; default: this one")
    arguments = parser.parse_args()
    peers = [] if arguments.peers == "none" else arguments.peers.split(",")
    if unknown := {*peers} - {"ceres", "pycolmap"}:
        parser.error(f"no such peer: {', '.join(sorted(unknown))}")
    names = arguments.problems or [problem.name for problem in PROBLEMS if problem.quick or not arguments.quick]
    if unknown := {*names} - {problem.name for problem in PROBLEMS}:
        parser.error(f"no such problem: {', '.join(sorted(unknown))}")
    rounds = arguments.rounds or (2 if arguments.quick else 5)

    RESULTS.mkdir(exist_ok=True)
    forget_kernels()
    ceres = build_ceres() if "ceres" in peers else None
    results = []
    for problem in PROBLEMS:
        if problem.name not in names:
            continue
        if not problem.prepare(arguments.data):
            print(f"{problem.title} is left out: {problem.source}.txt.bz2 is not in {arguments.data}.")
            continue
        print(problem.title, flush=True)
        result = compete(problem, commands_for(problem, peers, ceres, arguments.python_pycolmap), rounds)
        if not result["metrics"]:
            print(f"{problem.title}: groma did not finish.")
            return 1
        (RESULTS / f"{problem.name}.json").write_text(json.dumps(result, indent=1) + "\n")
        results.append(result)
    print("\n" + table(results))
    paths = [RESULTS / f"{problem.name}.json" for problem in PROBLEMS]
    everything = [json.loads(path.read_text()) for path in paths if path.is_file()]
    (RESULTS / "table.md").write_text(table(everything))
    return 0


if __name__ == "__main__":
    sys.exit(main())
