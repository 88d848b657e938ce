# SPDX-License-Identifier: BSD-3-Clause
"""What the first run of a command costs more than the second.

    python benchmarks/first_run.py [--command adjust|demo|selfcheck]... [--rounds N] [--python PYTHON]
    python benchmarks/first_run.py --bound

Each command runs twice from an empty cache of compiled functions, as a whole process: wall time, and the CPU time of it
and of the processes that compile for it. ``--python`` takes the groma of another environment, for example one into
which a wheel with compiled functions was installed. What the two runs write must be the same.

Medians; writes ``benchmarks/results/first_run.json`` and ``first_run.md``.

``--bound`` says what no shorter loop and no better order can change: for each list of functions that a command calls,
the CPU time of one process that compiles them, and that of as many functions with the same arguments and nothing in
them; and how long a first run takes at best, if no core ever waits: imports, compiling and a run that finds all, shared
out.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path

import numpy as np
from _workshop import environment, keep_results, machine
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


def bound(work: str) -> dict[str, float]:
    """Compile what some work calls, and functions with the same arguments and nothing in them; in a new process."""
    from groma._kernels.cache import counts
    from groma.compilation.ahead import make_ready
    from groma.compilation.needed import function, needed

    make_ready(work)
    imports = time.process_time()
    listed = [(function(module, name), kinds) for module, name, kinds in needed(work)]
    text = ["from groma._numba import loop"]
    for number, (_, kinds) in enumerate(listed):
        text.append(f"@loop\ndef f{number}({', '.join(f'a{k}' for k in range(len(kinds)))}):\n    pass")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "with_nothing_in_them.py").write_text("\n".join(text), encoding="utf-8")
        sys.path.insert(0, folder)
        empty = import_module("with_nothing_in_them")
        seconds = []
        for functions in ([getattr(empty, f"f{number}") for number in range(len(listed))], [one for one, _ in listed]):
            begin = time.process_time()
            for one, (_, kinds) in zip(functions, listed, strict=True):
                one.compile(kinds)
            seconds.append(time.process_time() - begin)
    inside = counts.compiled - 2 * len(listed)
    found = {"functions": len(listed), "inside them": inside, "imports_cpu_s": imports}
    return {**found, "empty_cpu_s": seconds[0], "cpu_s": seconds[1]}


def say_bound() -> None:
    """Print a table, each row from a process and a cache of its own, and a command that finds all in this cache."""
    print("| list | functions | inside them | imports | compiling | with nothing in them | second run | at best, s |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|")
    for work, name in (("adjust", "adjust"), ("map", "demo")):
        code = f"import json, first_run; print(json.dumps(first_run.bound({work!r})))"
        with tempfile.TemporaryDirectory() as cache, tempfile.TemporaryDirectory() as place:
            free = environment(None, NUMBA_CACHE_DIR=cache)
            done = subprocess.run(
                [sys.executable, "-c", code], cwd=Path(__file__).parent, env=free, check=True, capture_output=True
            )
            command, written = commands(Path(place), sys.executable)[name]
            second = whole_process([*command, os.fspath(Path(place) / ("out" if written else "out.npz"))], cache)
        found = json.loads(done.stdout.splitlines()[-1])
        parts = [found["imports_cpu_s"], found["cpu_s"], found["empty_cpu_s"], second["cpu_s"]]
        best = (parts[0] + parts[1] + parts[3]) / (os.cpu_count() or 1)
        said = " | ".join(f"{seconds:.1f}" for seconds in (*parts, best))
        print(f"| {work} | {found['functions']} | {found['inside them']} | {said} |", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--command", action="append", choices=("adjust", "demo", "selfcheck"))
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--bound", action="store_true")
    arguments = parser.parse_args()
    if arguments.bound:
        say_bound()
        return 0
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
    found = {"problem": "first run", "machine": machine(), "python": arguments.python, "rows": rows}
    lines = [
        "| command | first, wall s | CPU s | second, wall s | CPU s | first / second |",
        "|---|--:|--:|--:|--:|--:|",
    ]
    lines += [
        f"| `groma {row['command']}` | {row['first_wall_s']:.1f} | {row['first_cpu_s']:.1f} "
        f"| {row['second_wall_s']:.1f} | {row['second_cpu_s']:.1f} | {row['ratio']:.1f} |"
        for row in rows
    ]
    keep_results("first_run", found, "\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
