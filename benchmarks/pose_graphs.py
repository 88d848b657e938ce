# SPDX-License-Identifier: BSD-3-Clause
"""Pose graphs by groma and by GTSAM: same graph, same start, same rule, one thread.

    python benchmarks/pose_graphs.py FILE.g2o[.gz] ... [--rounds N]

GTSAM's environment comes from ``peers.py gtsam``. It reads rotations for twice as certain as g2o means them, so it gets
a file in which that is made up for; then both have the same minimum. Prints a table of CPU times, medians.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from pathlib import Path

import peers
from _workshop import CACHE, CONTESTANTS, run_program


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    python = peers.python_of("gtsam")
    if python is None:
        print("GTSAM is left out: run python benchmarks/peers.py gtsam")
    CACHE.mkdir(parents=True, exist_ok=True)
    print("| graph | program | steps | CPU s | cost at the start | at the end |")
    print("|---|---|--:|--:|--:|--:|")
    for path in arguments.files:
        radians = CACHE / f"{path.name.split('.')[0]}_radians.g2o"
        commands = {"groma": [sys.executable, CONTESTANTS / "groma_pose_graph.py", path, radians]}
        if python is not None:
            commands["gtsam"] = [python, CONTESTANTS / "gtsam_pose_graph.py", radians]
        runs: dict[str, list[dict]] = {name: [] for name in commands}
        for _ in range(arguments.rounds):
            for name, command in commands.items():
                run = run_program(command)
                if run is None:
                    return 1
                runs[name].append(run)
        for name, found in runs.items():
            seconds = statistics.median(run["cpu_s"] for run in found)
            last = found[-1]
            print(
                f"| {path.name} | {name} {last['version']} | {last['iterations']} | {seconds:.2f} "
                f"| {last['initial_cost']:.6g} | {last['final_cost']:.8g} |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
