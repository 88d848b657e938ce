# SPDX-License-Identifier: BSD-3-Clause
"""Today's sources against those of another commit, solve by solve in turn.

    git worktree add ../before COMMIT
    python benchmarks/against.py ../before [--rounds N] [--data DIR] [PROBLEM ...]

Two processes hold a problem of ``run.py`` and solve it in turn on one thread, so that both meet the same machine. On a
busy one CPU time only grows, so the least of many rounds says most. ``faults`` are pages of memory that the system
provided anew; ``bits`` tell whether two results are the same to the last digit.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path

from _workshop import CACHE, CONTESTANTS, PROBLEMS, ROOT, BenchmarkProblem, environment


class Sources:
    """A process that solves one problem whenever it is asked, with the sources of one folder."""

    def __init__(self, name: str, folder: Path, problem: BenchmarkProblem) -> None:
        self.name, self.runs = name, []
        more = {"PYTHONPATH": str(folder / "src"), "NUMBA_CACHE_DIR": str(CACHE / f"numba_{name}")}
        self._process = subprocess.Popen(
            [sys.executable, CONTESTANTS / "solve_again.py", problem.file_for("groma")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment(1, **more, PYTHONPYCACHEPREFIX=str(CACHE / f"bytecode_{name}")),
        )
        place = self._line()
        if str(folder) not in place:
            raise SystemExit(f"{place} was imported instead of what is in {folder}.")

    def _line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"The process with the sources of {self.name} ended.")
        return line.strip()

    def solve(self) -> None:
        """Solve once and note what it took."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        self.runs.append(json.loads(self._line()))

    def close(self) -> None:
        """End the process."""
        self._process.communicate()

    def times(self) -> list[float]:
        """CPU times of all runs, milliseconds."""
        return [1e3 * run["cpu_s"] for run in self.runs]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="a folder with the sources of another commit")
    parser.add_argument("problems", nargs="*", metavar="PROBLEM")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data" / "bal", help="BAL files")
    arguments = parser.parse_intermixed_args()
    print("| problem | sources | least CPU ms | median | least, before = 1 | faults | steps | cost | bits | peak MiB |")
    print("|---|---|--:|--:|--:|--:|--:|--:|---|--:|")
    for problem in PROBLEMS:
        if (arguments.problems and problem.name not in arguments.problems) or problem.large:
            continue
        if not problem.prepare(arguments.data):
            print(f"{problem.title} is left out: {problem.missing(arguments.data)}", file=sys.stderr)
            continue
        both = [Sources("before", arguments.before.resolve(), problem), Sources("today", ROOT, problem)]
        for number in range(arguments.rounds):
            for sources in both[:: 1 if number % 2 == 0 else -1]:
                sources.solve()
        for sources in both:
            sources.close()
            times, last = sources.times(), sources.runs[-1]
            faults = statistics.median(run["faults"] for run in sources.runs)
            print(
                f"| {problem.name} | {sources.name} | {min(times):.1f} | {statistics.median(times):.1f} "
                f"| {min(times) / min(both[0].times()):.3f} | {faults:.0f} | {last['steps']} | {last['cost']:.8g} "
                f"| {last['bits']} | {last['peak_memory_mib']:.0f} |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
