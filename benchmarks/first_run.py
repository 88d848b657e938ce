# SPDX-License-Identifier: BSD-3-Clause
"""What the first run of a command costs more than the second.

    python benchmarks/first_run.py [--command adjust|demo|selfcheck]... [--rounds N] [--python PYTHON]

Each command runs twice from an empty cache of compiled functions, as a whole process: wall time, and the CPU time of it
and of the processes that compile for it. ``--python`` takes the groma of another environment, for example one into
which a wheel with compiled functions was installed. What the two runs write must be the same.

Medians; writes ``benchmarks/results/first_run.json`` and ``first_run.md``.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from _workshop import RESULTS, machine
from latency import whole_process


def differing(first: Path, second: Path) -> list[str]:
    """Return the names of the arrays of two archives that are not the same."""
    with np.load(first) as one, np.load(second) as other:
        names = sorted({*one.files, *other.files})
        both = set(one.files) & set(other.files)
        return [name for name in names if name not in both or one[name].tobytes() != other[name].tobytes()]


def commands(folder: Path, python: str) -> dict[str, tuple[list[str], str]]:
    """Return each command without its output, and the archive that it writes there."""
    groma = [python, "-m", "groma.cli.main"]
    scene = folder / "scene"
    subprocess.run([*groma, "synth", "-n", "20", "-o", os.fspath(scene), "--quiet"], check=True)
    return {
        "adjust": ([*groma, "adjust", os.fspath(scene / "start.npz"), "--quiet", "-o"], ""),
        "demo": ([*groma, "demo", "--quiet", "-o"], "scene.npz"),
        "selfcheck": ([*groma, "selfcheck", "--quiet"], ""),
    }


def measure(command: list[str], written: str, folder: Path) -> dict[str, dict[str, float]]:
    """Run a command twice with an empty cache."""
    found, archives = {}, []
    with tempfile.TemporaryDirectory() as cache:
        for run in ("first", "second"):
            archive = folder / f"{run}.npz" if not written else folder / run / written
            place = [os.fspath(archive.parent if written else archive)] if command[-1] == "-o" else []
            found[run] = whole_process([*command, *place], cache)
            archives.append(archive)
    if command[-1] == "-o" and (names := differing(*archives)):
        print(f"warning: the two runs differ in {', '.join(names)}", file=sys.stderr)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--command", action="append", choices=("adjust", "demo", "selfcheck"))
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--python", default=sys.executable)
    arguments = parser.parse_args()
    rows = []
    for name in arguments.command or ("adjust", "demo"):
        runs = []
        for _ in range(arguments.rounds):
            with tempfile.TemporaryDirectory() as place:
                runs.append(measure(*commands(Path(place), arguments.python)[name], Path(place)))
        row = {
            f"{run}_{kind}": statistics.median(one[run][kind] for one in runs)
            for run in ("first", "second")
            for kind in ("wall_s", "cpu_s")
        }
        rows.append({"command": name, **row, "ratio": row["first_wall_s"] / row["second_wall_s"]})
    RESULTS.mkdir(exist_ok=True)
    found = {"problem": "first run", "machine": machine(), "python": arguments.python, "rows": rows}
    (RESULTS / "first_run.json").write_text(json.dumps(found, indent=1) + "\n")
    lines = [
        "| command | first, wall s | CPU s | second, wall s | CPU s | first / second |",
        "|---|--:|--:|--:|--:|--:|",
    ]
    lines += [
        f"| `groma {row['command']}` | {row['first_wall_s']:.1f} | {row['first_cpu_s']:.1f} "
        f"| {row['second_wall_s']:.1f} | {row['second_cpu_s']:.1f} | {row['ratio']:.1f} |"
        for row in rows
    ]
    (RESULTS / "first_run.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
