# SPDX-License-Identifier: BSD-3-Clause
"""Bundle adjustment by groma and its peers, side by side.

    python benchmarks/run.py [--set-up] [--quick] [--peers ceres,pycolmap,...] [--rounds N] [--data DIR] [PROBLEM ...]

Same file, same start, same rule (relative change of the cost below 1e-6, or 50 steps), every run in a process of its
own, all contestants in turn within a round. The first round tries every linear solver of a peer on one thread; the
others go on with those that may be its best, on one and on two threads. A peer much slower than groma runs twice, on
one. Reported are medians; CPU time is that of the solve alone. ``--set-up`` first makes the peers' environments, as
``peers.py`` does; a peer that is not there is left out.

Writes into ``benchmarks/results``: ``PROBLEM.json``, ``PROBLEM.svg`` (cost against CPU time), and ``results.md`` of all
results there; ``check.py`` compares with the baseline.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from pathlib import Path

import _plots
import peers as peer_environments
from _workshop import (
    CONTESTANTS,
    PROBLEMS,
    RESULTS,
    ROOT,
    BenchmarkProblem,
    build_ceres,
    calibrate,
    machine,
    run_program,
)

CERES_SOLVERS = ("dense_schur", "sparse_schur", "iterative_schur", "iterative_schur_explicit")
#: Linear solvers of each contestant, by the kind of problem that it can solve.
SOLVERS: dict[str, dict[str, tuple[str, ...]]] = {
    "points": {
        "groma": ("auto",),
        "ceres": CERES_SOLVERS,
        "pycolmap": CERES_SOLVERS,
        "gtsam": ("schur", "full"),
        "jaxls": ("dense_cholesky", "conjugate_gradient"),
        "scipy": ("analytic", "numeric"),
    },
    "points_lines": {"groma": ("auto",), "ceres": CERES_SOLVERS, "limap": CERES_SOLVERS},
}
PEERS = ("ceres", "pycolmap", "limap", "gtsam", "jaxls", "scipy")
#: A linear solver this much slower than the best of its peer in the first round is not tried again.
HOPELESS = 1.3
#: A peer this much slower than groma runs in two rounds only.
SLOW = 15.0
#: Two programs solve the same problem when their initial costs agree to this fraction.
SAME_PROBLEM = 1e-6
#: Time to cost: until the cost is within this fraction of the lowest that any contestant ends at.
NEAR = 1e-3

#: A contestant, its linear solver, its threads.
Key = tuple[str, str, int]


def command_for(key: Key, problem: BenchmarkProblem, pythons: dict[str, Path]) -> list:
    """Return the command of a contestant."""
    name, solver, threads = key
    if name == "groma":
        return [sys.executable, CONTESTANTS / "groma_solve.py", problem.file_for(name), "--warm", "--threads", threads]
    program = [pythons[name] / f"ceres_{problem.kind}"]
    if name != "ceres":
        program = [pythons[name], CONTESTANTS / f"{name}_solve.py"]
    return [*program, problem.file_for(name), solver, threads]


def available(wanted: list[str], set_up: bool) -> dict[str, Path]:
    """Return the interpreter of each peer that is there (of Ceres, the folder of its programs); say what is not."""
    found = {}
    for name in wanted:
        if name == "ceres":
            place = build_ceres()
        else:
            peer = next(peer for peer in peer_environments.PEERS if peer.name == name)
            outcome = peer_environments.set_up(peer) if set_up else ""
            place = peer_environments.python_of(name)
            if place is None:
                print(f"{name} is left out: {outcome or f'run python benchmarks/peers.py {name}'}")
        if place is not None:
            found[name] = place
    return found


def compete(problem: BenchmarkProblem, pythons: dict[str, Path], rounds: int) -> dict:
    """Run all contestants round by round and return the result of the problem."""
    runs: dict[Key, list[dict]] = {}
    units = []
    contestants = {name: tries for name, tries in SOLVERS[problem.kind].items() if name == "groma" or name in pythons}
    keys = [(name, solver, 1) for name, tries in contestants.items() for solver in tries]
    # Kernels are compiled and cached; then one run as a user's would be, without a warm-up, for the peak memory.
    command = command_for(("groma", "auto", 1), problem, pythons)
    run_program(command)
    plain = run_program([word for word in command if word != "--warm"])
    for turn in range(rounds):
        units.append(calibrate())
        keys = [key for key in keys if one_run(key, problem, pythons, runs, turn)]
        if ("groma", "auto", 1) not in runs:
            return {"metrics": {}}
        if turn == 0:
            chosen = survivors(runs)
            # one more turn of the first round, on two threads, for the best solver of each
            limit = SLOW * runs["groma", "auto", 1][0]["cpu_s"]
            both = [(name, s, 2) for name, s in best_solvers(runs).items() if runs[name, s, 1][0]["cpu_s"] < limit]
            keys = [key for key in [*chosen, *both] if key in chosen or one_run(key, problem, pythons, runs, turn)]
        elif turn == 1:
            mine = statistics.median(run["cpu_s"] for run in runs[("groma", "auto", 1)])
            keys = [key for key in keys if runs[key][0]["cpu_s"] < SLOW * mine]
    rows = [summary(key, runs[key]) for key in runs]
    for row in rows:
        if row["contestant"] == "groma" and plain is not None:
            row["peak_memory_mib"] = plain["peak_memory_mib"]
    unit = statistics.median(units)
    add_times_to_cost(rows)
    return {
        "problem": problem.name,
        "title": problem.title,
        "machine": machine(),
        "rounds": rounds,
        "calibration_s": unit,
        "contestants": rows,
        "metrics": metrics_of(rows, unit),
    }


def one_run(key: Key, problem: BenchmarkProblem, pythons: dict[str, Path], runs: dict, turn: int) -> bool:
    """Run a contestant once and note it; return whether it finished."""
    run = run_program(command_for(key, problem, pythons), key[2])
    if run is None:
        return False
    runs.setdefault(key, []).append(run)
    print(
        f"  round {turn + 1}: {key[0]:9s} {key[1]:25s} {key[2]} thread(s) {run['cpu_s']:8.3f} s CPU "
        f"{run['wall_s']:8.3f} s  cost {run['final_cost']:.7g}",
        flush=True,
    )
    return True


def best_solvers(runs: dict[Key, list[dict]]) -> dict[str, str]:
    """Return by the first round the fastest linear solver of each contestant, of those that find its lowest cost."""
    singles = {key: rows[0] for key, rows in runs.items() if key[2] == 1}
    best: dict[str, str] = {}
    for name in {key[0] for key in singles}:
        mine = {key[1]: run for key, run in singles.items() if key[0] == name}
        target = (1 + NEAR) * min(run["final_cost"] for run in mine.values())
        best[name] = min(mine, key=lambda solver: (mine[solver]["final_cost"] > target, mine[solver]["cpu_s"]))
    return best


def survivors(runs: dict[Key, list[dict]]) -> list[Key]:
    """Return what is run again after the first round."""
    best = best_solvers(runs)
    return [
        key for key, rows in runs.items() if rows[0]["cpu_s"] <= HOPELESS * runs[key[0], best[key[0]], 1][0]["cpu_s"]
    ]


def summary(key: Key, runs: list[dict]) -> dict:
    """Return medians over the rounds, the range of the CPU time, and the curve of the median run."""
    row = {"contestant": key[0], "solver": runs[0]["solver"], "threads": key[2], "version": runs[0]["version"]}
    for field in ("cpu_s", "wall_s", "iterations", "initial_cost", "final_cost", "peak_memory_mib"):
        row[field] = statistics.median(run[field] for run in runs)
    middle = sorted(runs, key=lambda run: run["cpu_s"])[(len(runs) - 1) // 2]
    ends = [[0.0, 0.0, middle["initial_cost"]], [middle["cpu_s"], middle["wall_s"], middle["final_cost"]]]
    return {
        **row,
        "rounds": len(runs),
        "cpu_range_s": [min(run["cpu_s"] for run in runs), max(run["cpu_s"] for run in runs)],
        "curve": middle.get("curve") or ends,
    }


def add_times_to_cost(rows: list[dict]) -> None:
    """Add to each row the CPU time after which its cost is near the lowest of all; None where it never is."""
    mark_same_problem(rows)
    target = (1 + NEAR) * min(row["final_cost"] for row in rows if row["same_problem"])
    for row in rows:
        reached = [cpu for cpu, _, cost in row["curve"] if cost <= target]
        row["cpu_to_cost_s"] = min(reached) if reached else row["cpu_s"] if row["final_cost"] <= target else None


def mark_same_problem(rows: list[dict]) -> None:
    """Mark who solves groma's problem: a peer that leaves out observations is shown, but not compared."""
    groma = next(row for row in rows if row["contestant"] == "groma")
    for row in rows:
        row["same_problem"] = abs(row["initial_cost"] / groma["initial_cost"] - 1) < SAME_PROBLEM


def best_rows(rows: list[dict], threads: int) -> dict[str, dict]:
    """Return the row of each contestant's best linear solver, groma first: least CPU time, on so many threads."""
    best: dict[str, dict] = {}

    def rank(row: dict) -> tuple:
        far = 0.0 if row["cpu_to_cost_s"] is not None else row["final_cost"]
        return row["contestant"] != "groma", far, -row["rounds"], row["cpu_s"]

    for row in sorted(rows, key=rank):
        if row["threads"] == threads:
            best.setdefault(row["contestant"], row)
    return best


def metrics_of(rows: list[dict], unit: float) -> dict[str, float]:
    """Return the numbers that ``check.py`` compares."""
    singles = best_rows(rows, 1)
    groma = singles.pop("groma", None)
    if groma is None:
        return {}
    metrics = {
        "final_cost": groma["final_cost"],
        "iterations": groma["iterations"],
        "peak_memory_mib": groma["peak_memory_mib"],
        "cpu_in_calibrations": groma["cpu_s"] / unit,
    }
    peers = [row for row in singles.values() if row["same_problem"]]
    if not peers:
        return metrics
    metrics["cpu_ratio"] = min(row["cpu_s"] for row in peers) / groma["cpu_s"]
    metrics["cost_ratio"] = groma["final_cost"] / min(row["final_cost"] for row in peers)
    metrics["memory_over_peer_mib"] = groma["peak_memory_mib"] - min(row["peak_memory_mib"] for row in peers)
    for row in peers:
        metrics[f"cpu_ratio_{row['contestant']}"] = row["cpu_s"] / groma["cpu_s"]
        if row["cpu_to_cost_s"] and groma["cpu_to_cost_s"]:
            metrics[f"time_to_cost_ratio_{row['contestant']}"] = row["cpu_to_cost_s"] / groma["cpu_to_cost_s"]
    doubles = best_rows(rows, 2)
    mine = doubles.pop("groma", None)
    others = [row["wall_s"] for row in doubles.values() if row["same_problem"]]
    if mine and others:
        metrics["wall_ratio_two_threads"] = min(others) / mine["wall_s"]
    return metrics


def table(results: list[dict]) -> str:
    """Return the results as a Markdown table: groma and the best linear solver of each peer."""
    lines = [
        "| problem | program | linear solver | threads | CPU s | wall s | CPU s to 0.1 % | steps | final cost "
        "| peak MiB | CPU, groma = 1 | wall, groma = 1 |",
        "|---|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for result in results:
        for threads in (1, 2):
            rows = best_rows(result["contestants"], threads)
            groma = rows.get("groma")
            for row in rows.values():
                if groma is None:
                    continue
                title = result["title"] if row is groma and threads == 1 else ""
                mark = "" if row["same_problem"] else " (1)"
                near = "" if row["cpu_to_cost_s"] is None else f"{row['cpu_to_cost_s']:.3f}"
                lines.append(
                    f"| {title} | {row['contestant']} {row['version']}{mark} | {row['solver']} | {threads} "
                    f"| {row['cpu_s']:.3f} | {row['wall_s']:.3f} | {near} | {row['iterations']:.0f} "
                    f"| {row['final_cost']:.7g} | {row['peak_memory_mib']:.0f} | {row['cpu_s'] / groma['cpu_s']:.1f} "
                    f"| {row['wall_s'] / groma['wall_s']:.1f} |"
                )
    text = "\n".join(lines) + "\n"
    if "(1)" in text:
        text += "\n(1) Leaves out observations of points that start behind their camera: a slightly smaller problem.\n"
    return text


def plot(result: dict, path: Path) -> None:
    """Draw how far each contestant is above the lowest cost, against its CPU time on one thread."""
    rows = [row for row in best_rows(result["contestants"], 1).values() if row["same_problem"]]
    lowest = min(row["final_cost"] for row in rows)
    lines = []
    for row in rows:
        # the first entry may be the start, at time zero
        shown = [(max(cpu, 1e-3 * row["cpu_s"]), max(cost / lowest - 1, 1e-7)) for cpu, _, cost in row["curve"]]
        lines.append(_plots.Line(row["contestant"], *zip(*shown, strict=True), steps=True))
    _plots.write(path, result["title"], "CPU time on one thread, seconds", "cost over the lowest, minus 1", lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", metavar="PROBLEM", help=", ".join(problem.name for problem in PROBLEMS))
    parser.add_argument("--set-up", action="store_true", help="make the peers' environments first")
    parser.add_argument("--quick", action="store_true", help="small problems only, 2 rounds")
    parser.add_argument("--peers", default=",".join(PEERS), help=f"some of {', '.join(PEERS)} (default all), or none")
    parser.add_argument("--rounds", type=int, help="default 5, with --quick 2")
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data" / "bal", help="folder of BAL files"
    )
    arguments = parser.parse_args()
    wanted = [] if arguments.peers == "none" else arguments.peers.split(",")
    if unknown := {*wanted} - {*PEERS}:
        parser.error(f"no such peer: {', '.join(sorted(unknown))}")
    usual = [problem.name for problem in PROBLEMS if (problem.quick or not arguments.quick) and not problem.large]
    names = arguments.problems or usual
    if unknown := {*names} - {problem.name for problem in PROBLEMS}:
        parser.error(f"no such problem: {', '.join(sorted(unknown))}")
    rounds = arguments.rounds or (2 if arguments.quick else 5)

    RESULTS.mkdir(exist_ok=True)
    pythons = available(wanted, arguments.set_up)
    results = []
    for problem in PROBLEMS:
        if problem.name not in names:
            continue
        print(f"{problem.title} (from an empty cache some minutes pass before the first round)", flush=True)
        if not problem.prepare(arguments.data):
            print(f"{problem.title} is left out: {problem.missing(arguments.data)}")
            continue
        result = compete(problem, pythons, rounds)
        if not result["metrics"]:
            print(f"{problem.title}: groma did not finish.")
            return 1
        (RESULTS / f"{problem.name}.json").write_text(json.dumps(result, indent=1) + "\n")
        plot(result, RESULTS / f"{problem.name}.svg")
        results.append(result)
    print("\n" + table(results))
    everything = []
    for problem in PROBLEMS:
        path = RESULTS / f"{problem.name}.json"
        if path.is_file() and "cpu_to_cost_s" in (result := json.loads(path.read_text()))["contestants"][0]:
            everything.append(result)
    (RESULTS / "results.md").write_text(table(everything))
    return 0


if __name__ == "__main__":
    sys.exit(main())
