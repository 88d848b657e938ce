# SPDX-License-Identifier: BSD-3-Clause
"""How much of ``groma map`` goes on in one thread, by stage, and how much faster two threads are.

    python benchmarks/map_threads.py IMAGES --model MODEL --rounds 3

Runs with one thread and with two alternate, each in a process of its own; the first, which compiles, is not counted.
Medians over the rounds. Nothing looks at a run while it goes on.

*Alone* is the processor time of a run with one thread outside of the pieces of work that several threads would share,
and of what they would begin early: work that nobody can do meanwhile. It holds on a busy machine. If two threads lost
nothing else they were C / (A + (C - A) / 2) times as fast; so many times is said as the bound.

*Serial* is what was lost with two, waiting included. At the beginning of each stage the run asks the system for the
processor time of the process and for how long each of its threads had to wait for a core. Of a stage of W seconds in
which threads ran or waited for R seconds in all, at most two at a time, only one could run for 2 W - R, of which the
share that was not waiting is processor time. Two idle cores are needed: on a busy machine a third thread that waits, or
one that has ended, makes it too low or too high. Waiting is read under ``/proc``; without it is taken as none.

Columns: seconds of processor time and of wall time with one thread, alone, and the largest memory until then, MB; the
same with two threads, with what was serial.
"""

import argparse
import gc
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from functools import partial
from itertools import pairwise
from pathlib import Path


def run(images, model, threads):
    """Map, diagnose and write as the command does; return what was used until the beginning of each stage."""
    marks, waiting, shared = [], {}, Shared()
    gc.set_threshold(50_000)  # as the command does

    def mark(stage, *_):
        if not marks or marks[-1]["stage"] != stage:
            waiting.update(waited())
            used = {"wall": time.monotonic(), "cpu": time.process_time(), "waited": sum(waiting.values())}
            marks.append({"stage": stage, "peak": peak(), "shared": shared.seconds, **used})

    mark("imports")
    if threads == 1:
        shared.count()
    from groma.cli.app import app  # noqa: F401 - the command line is part of every run
    from groma.compilation.loading import loading
    from groma.execution import share_memory, work_with
    from groma.features.images import one_opencv_thread
    from groma.io import read_scene
    from groma.mapping.map import map_images
    from groma.mapping.options import MapOptions

    mark("reading the model")
    share_memory()
    one_opencv_thread()
    scene = read_scene(model)
    with tempfile.TemporaryDirectory() as folder, work_with(threads):
        with loading("map", threads):
            result = map_images(images, Path(folder) / "work", scene, MapOptions(threads=threads), mark)
        mark("diagnosis and uncertainty")
        photographs = result.photographs(images)
        summary = result.summary(result.diagnose())
        mark("writing, report")
        result.write(Path(folder) / "map", images=images, summary=summary, photographs=photographs)
    mark("end")
    from groma.mapping.checkpoints import digest

    return {"marks": marks, "peak": peak(), "lines": result.scene.num_lines, "scene": digest(result.scene)}


class Shared:
    """The processor time of this thread that others would share, in a run that has one alone."""

    def __init__(self):
        self.seconds, self._inside = 0.0, False

    def count(self):
        """Count from now on; what imports these functions does so afterwards."""
        from groma import execution

        kinds = {"map_work": self._pieces, "map_in_threads": self._pieces, "begin": self._begun, "beside": self._begun}
        for name, counting in kinds.items():
            setattr(execution, name, partial(counting, getattr(execution, name)))
        from groma.problem.parallel import Workers

        share = Workers.map
        Workers.map = lambda workers, function, tasks, alone=False: share(
            workers, function if alone or tasks < 2 else partial(self._timed, function), tasks, alone
        )

    def _begun(self, begin, function):
        return begin(partial(self._timed, function))

    def _pieces(self, work, function, items, *more):
        return work(function if len(items) < 2 else partial(self._timed, function), items, *more)

    def _timed(self, function, *given):
        if self._inside:
            return function(*given)
        self._inside, begin = True, time.thread_time()
        try:
            return function(*given)
        finally:
            self._inside = False
            self.seconds += time.thread_time() - begin


def peak():
    """Largest memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def waited(tasks=Path("/proc/self/task")):
    """Return for how many seconds each thread of this process that lives has waited for a core."""
    found = {}
    for task in tasks.iterdir() if tasks.is_dir() else ():
        with suppress(OSError):  # it has ended
            found[task.name] = 1e-9 * int((task / "schedstat").read_text().split()[1])
    return found


def alone(command, bytecode):
    """Run a command; return what it printed. Bytecode, which an installation brings along, is kept in a folder."""
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    kept = {"PYTHONPYCACHEPREFIX": bytecode, "PYTHONDONTWRITEBYTECODE": ""}
    said = subprocess.run(command, stdout=subprocess.PIPE, env=os.environ | limits | kept, check=True).stdout
    return json.loads(said.splitlines()[-1])


def stages_of(marks):
    """Processor time, wall time, serial time and largest memory of each stage of a run."""
    stages = {}
    for before, after in pairwise(marks):
        entry = stages.setdefault(before["stage"], dict.fromkeys(("cpu", "wall", "waited", "shared", "peak"), 0.0))
        for name in ("cpu", "wall", "waited", "shared"):
            entry[name] += after[name] - before[name]
        entry["peak"] = after["peak"]
    stages[marks[0]["stage"]]["cpu"] += marks[0]["cpu"]
    stages[marks[0]["stage"]]["wall"] += marks[0]["cpu"]
    for entry in stages.values():
        entry["alone"] = entry["cpu"] - entry["shared"]
        able = entry["cpu"] + entry["waited"]
        entry["serial"] = min(max(2.0 * entry["wall"] - able, 0.0), entry["wall"]) * entry["cpu"] / max(able, 1e-9)
    return stages


def median(values):
    values = sorted(values)
    return 0.5 * (values[(len(values) - 1) // 2] + values[len(values) // 2])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images")
    parser.add_argument("--model", required=True)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--row", type=int, help="map with so many threads, print JSON; used by the benchmark itself")
    arguments = parser.parse_args()
    if arguments.row:
        print(json.dumps(run(arguments.images, arguments.model, arguments.row)))
        return
    command = [sys.executable, __file__, arguments.images, "--model", arguments.model, "--row"]
    rounds = {1: [], 2: []}
    with tempfile.TemporaryDirectory() as bytecode:
        alone([*command, "2"], bytecode)
        for _ in range(arguments.rounds):
            for threads, runs in rounds.items():
                found = alone([*command, str(threads)], bytecode)
                runs.append((stages_of(found["marks"]), found))
    names = ("CPU 1", "wall 1", "alone", "MB 1", "CPU 2", "wall 2", "serial", "MB 2")
    print(f"{'stage':28s} " + " ".join(f"{name:>7s}" for name in names))
    columns = [(1, "cpu"), (1, "wall"), (1, "alone"), (1, "peak"), (2, "cpu"), (2, "wall"), (2, "serial"), (2, "peak")]
    table = {
        stage: [median([run[0].get(stage, {}).get(key, 0.0) for run in rounds[threads]]) for threads, key in columns]
        for stage in rounds[2][0][0]
    }
    several = [max if key == "peak" else sum for _, key in columns]
    whole = table["all"] = [of(row[k] for row in table.values()) for k, of in enumerate(several)]
    for stage, row in table.items():
        print(f"{stage:28s} " + " ".join(f"{value:7.2f}" for value in row))
    share = whole[2] / whole[0]
    print(f"\nalone {share:.1%}, which allows {2.0 / (1.0 + share):.2f} times as fast; ", end="")
    print(f"serial {whole[6] / whole[4]:.1%}; ratio of wall times {whole[1] / whole[5]:.2f}")
    one, two = (median([run[1]["peak"] for run in rounds[threads]]) for threads in (1, 2))
    scenes = {run[1]["scene"] for runs in rounds.values() for run in runs}
    same = "the same bit by bit" if len(scenes) == 1 else "NOT the same"
    lines = rounds[2][0][1]["lines"]
    print(f"peak memory {one:.0f} and {two:.0f} MB, ratio {two / one:.2f}; lines {lines}; the scenes are {same}")


if __name__ == "__main__":
    main()
