# SPDX-License-Identifier: BSD-3-Clause
"""How much of ``groma map`` goes on in one thread, by stage, and how much faster two threads are.

    python benchmarks/map_threads.py IMAGES --model MODEL --rounds 2

Runs with one thread and with two alternate, each in a process of its own; the first, which compiles, is not counted.
Medians over the rounds. While a run with two threads goes on, this process looks 200 times a second how many of its
threads can run. What is done while only one can is its *serial* work. A thread that could run but has to wait for a
core counts as running: the serial share holds on a busy machine too, where the ratio of wall times does not. It reads
the state of threads under ``/proc``, so it needs Linux.

Columns: seconds of processor time and of wall time with one thread and the largest memory until then, the same with
two, serial work in seconds of the processor time with two, and its share of all work.
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
from bisect import bisect_right
from itertools import pairwise
from pathlib import Path

INTERVAL = 0.005


def run(images, model, threads):
    """Map, diagnose and write as the command does; return when each stage began, with the processor time until then."""
    marks = []
    gc.set_threshold(10_000)  # as the command does

    def mark(stage, *_):
        if not marks or marks[-1][2] != stage:
            marks.append((time.monotonic(), time.process_time(), stage, peak()))

    mark("imports")
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


def peak():
    """Largest memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def watched(command, bytecode):
    """Run a command; return what it printed, and how many of its threads could run: times and numbers.

    Bytecode, which an installation brings along, is kept in a folder.
    """
    times, numbers = [], []
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    kept = {"PYTHONPYCACHEPREFIX": bytecode, "PYTHONDONTWRITEBYTECODE": ""}
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(command, stdout=said, env=os.environ | limits | kept)
        tasks = Path(f"/proc/{process.pid}/task")
        while process.poll() is None:
            times.append(time.monotonic())
            numbers.append(sum(can_run(task) for task in os.listdir(tasks)) if tasks.is_dir() else 0)
            time.sleep(INTERVAL)
        if process.returncode:
            sys.exit(process.returncode)
        said.seek(0)
        return json.loads(said.read().splitlines()[-1]), times, numbers


def can_run(task, root=Path("/proc")):
    """Whether a thread, by its number, runs or waits for a core."""
    try:
        return (root / task / "stat").read_text().rpartition(")")[2].split()[0] in ("R", "D")
    except OSError:  # it has ended
        return False


def stages_of(found, times, numbers):
    """Processor time, wall time and serial share of each stage of a run."""
    marks, stages = found["marks"], {}
    begins = [mark[0] for mark in marks]
    for (begin, cpu, stage, _), (end, until, _, peak) in pairwise(marks):
        entry = stages.setdefault(stage, {"cpu": 0.0, "wall": 0.0, "one": 0, "many": 0})
        entry["peak"] = peak
        entry["cpu"] += until - cpu
        entry["wall"] += end - begin
    stages[marks[0][2]]["cpu"] += marks[0][1]
    for moment, number in zip(times, numbers, strict=True):
        place = bisect_right(begins, moment) - 1
        if place < len(marks) - 1:
            entry = stages[marks[max(place, 0)][2]]
            entry["one"] += number == 1
            entry["many"] += number if number > 1 else 0
    for entry in stages.values():
        entry["serial"] = entry["cpu"] * entry["one"] / max(entry["one"] + entry["many"], 1)
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
        watched([*command, "2"], bytecode)
        for _ in range(arguments.rounds):
            for threads, runs in rounds.items():
                found, times, numbers = watched([*command, str(threads)], bytecode)
                runs.append((stages_of(found, times, numbers), found))
    names = ("CPU 1", "wall 1", "MB 1", "CPU 2", "wall 2", "MB 2", "serial", "share")
    print(f"{'stage':28s} " + " ".join(f"{name:>7s}" for name in names))
    columns = [(1, "cpu"), (1, "wall"), (1, "peak"), (2, "cpu"), (2, "wall"), (2, "peak"), (2, "serial")]
    table = {
        stage: [median([run[0].get(stage, {}).get(key, 0.0) for run in rounds[threads]]) for threads, key in columns]
        for stage in rounds[2][0][0]
    }
    several = [max if key == "peak" else sum for _, key in columns]
    table["all"] = [of(row[k] for row in table.values()) for k, of in enumerate(several)]
    for stage, row in table.items():
        print(f"{stage:28s} " + " ".join(f"{value:7.2f}" for value in row) + f" {row[6] / max(row[3], 1e-9):6.0%}")
    one, two = (median([run[1]["peak"] for run in rounds[threads]]) for threads in (1, 2))
    scenes = {run[1]["scene"] for runs in rounds.values() for run in runs}
    print(f"\npeak memory {one:.0f} and {two:.0f} MB, ratio {two / one:.2f}; lines {rounds[2][0][1]['lines']}")
    print(
        f"ratio of wall times {table['all'][1] / table['all'][4]:.2f}; the scenes are "
        + ("the same bit by bit" if len(scenes) == 1 else "NOT the same")
    )


if __name__ == "__main__":
    main()
