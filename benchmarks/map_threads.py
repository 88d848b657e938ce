# SPDX-License-Identifier: BSD-3-Clause
"""How much of ``groma map`` goes on in one thread, by stage, and how much faster two threads are.

    python benchmarks/map_threads.py IMAGES --model MODEL --rounds 3

Runs with one thread and with two alternate, each in a process of its own; the first, which compiles, is not counted.
Medians over the rounds. Nothing looks at a run while it goes on.

*Alone* is the processor time of a run with one thread outside of the pieces of work that several threads would share,
and of what they would begin early: work that nobody can do meanwhile. *Two* is when two threads would be through if
they lost nothing else, by the processor times of all pieces in the order in which they are given out. Both hold on a
busy machine.

*Serial* is what was lost with two, waiting included. At the beginning of each stage the run asks the system for the
processor time of the process and for how long each of its threads had to wait for a core. Of a stage of W seconds in
which threads ran or waited for R seconds in all, at most two at a time, only one could run for 2 W - R, of which the
share that was not waiting is processor time. Two idle cores are needed: on a busy machine a third thread that waits, or
one that has ended, makes it too low or too high. Waiting is read under ``/proc``; without it is taken as none.

Columns: seconds of processor time and of wall time with one thread, alone, with two threads that lose nothing, and the
largest memory until then, MB; the same with two threads, with what was serial, and how often a thread slept because it
had to wait for another, or for the interpreter: waking one takes some hundredth of a millisecond of either.
"""

import argparse
import gc
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager, suppress
from functools import cache, partial
from itertools import pairwise
from pathlib import Path


def run(images, model, threads):
    """Map, diagnose and write as the command does; return what was used until the beginning of each stage."""
    marks, waiting, schedule = [], {}, Schedule()
    gc.set_threshold(200_000)  # as the command does

    def mark(stage, *_):
        if not marks or marks[-1]["stage"] != stage:
            waiting.update(waited())
            used = {"wall": time.monotonic(), "cpu": time.process_time(), "waited": sum(waiting.values())}
            used["slept"] = resource.getrusage(resource.RUSAGE_SELF).ru_nvcsw
            marks.append({"stage": stage, "peak": peak(), **schedule.until_now(), **used})

    mark("imports")
    from groma.cli.app import app  # noqa: F401 - the command line is part of every run
    from groma.compilation import loading
    from groma.execution import share_memory, work_with
    from groma.features.images import one_opencv_thread

    if threads == 1:
        schedule.follow()
    from groma.io import read_scene
    from groma.mapping.map import map_images
    from groma.mapping.options import MapOptions

    mark("reading the model")
    share_memory()
    one_opencv_thread()
    scene = read_scene(model)
    with tempfile.TemporaryDirectory() as folder, work_with(threads):
        if threads == 1:
            schedule.begun(partial(loading.load, "map", threading.Event()))
        with loading.loading("map", threads):
            result = map_images(images, Path(folder) / "work", scene, MapOptions(threads=threads), mark)
        mark("diagnosis and uncertainty")
        photographs = result.photographs(images)
        summary = result.summary(result.diagnose())
        mark("writing, report")
        result.write(Path(folder) / "map", images=images, summary=summary, photographs=photographs)
    mark("end")
    from groma.mapping.checkpoints import digest

    return {"marks": marks, "peak": peak(), "lines": result.scene.num_lines, "scene": digest(result.scene)}


class Schedule:
    """When a run with one thread would end with two that lose nothing, by the processor time of what it does.

    Pieces of work go to whichever of the two is free first. What is begun early goes to the second one, after what it
    has to do already, and is waited for where its result is asked for; what it has not begun by then is done by the
    first.
    """

    def __init__(self):
        #: Seconds at which the first is now, and at which the second is free.
        self.now = self.free = 0.0
        #: Seconds of what the second could do, and, within what is begun, of what threads share.
        self.shared = self._divided = 0.0
        self._clock, self._inside = time.thread_time(), False

    def until_now(self):
        """Return how much time both have taken until now."""
        self._go_on()
        return {"two": self.now, "shared": self.shared}

    def follow(self):
        """Follow what is done from now on; what imports these functions does so afterwards."""
        from groma import execution

        execution.begin, execution.beside = self.begun, self.beside
        for name in ("map_work", "map_in_threads"):
            setattr(execution, name, partial(self._pieces, getattr(execution, name)))
        from groma.mapping import checkpoints
        from groma.problem.parallel import Workers

        checkpoints.num_threads = lambda: 2  # what would go on beside a stage is done beside it
        share = Workers.map

        def of_workers(workers, function, tasks, alone=False):
            def work(piece, items):
                return share(workers, piece, len(items), alone)

            return work(function, range(tasks)) if alone else self._pieces(work, function, range(tasks))

        setattr(Workers, "map", of_workers)  # noqa: B010 - another signature

    def begun(self, function):
        """Do now what is begun now; return what waits for it."""
        divided, self._divided = self._divided, 0.0
        result, begin, seconds = self._done_beside(function)
        share, self._divided = 1.0 - 0.5 * self._divided / max(seconds, 1e-9), divided

        def ask():
            self._go_on()
            if not self._inside:
                if begin > self.now:  # the first one does it; the second helps as soon as it is free
                    self.now, self.free = self.now + seconds, self.free - seconds
                    saved = min(max(self.now - self.free, 0.0), 2.0 * seconds * (1.0 - share)) / 2.0
                    self.now, self.free = self.now - saved, max(self.free, self.now - 2.0 * saved) + saved
                else:  # the first one helps where it is divided
                    left = max(begin + seconds - self.now, 0.0)
                    self.now, self.free = self.now + left * share, self.free - left * (1.0 - share)
            return result

        return cache(ask)

    @contextmanager
    def beside(self, function):
        """Do something before the block that two threads would do beside it."""
        _, begin, seconds = self._done_beside(function)
        yield
        self._go_on()
        self.now = max(self.now, begin + seconds)

    def _done_beside(self, function):
        """What a function returns, and when the second one would begin it and how long it takes."""
        result, seconds = self._timed(function)
        begin = max(self.now, self.free)
        self.free = begin + seconds
        return result, begin, seconds

    def _pieces(self, work, function, items, *more):
        """Do pieces of work that two would share."""
        if len(items) < 2:
            return work(function, items, *more)
        if self._inside:
            begin, divided = time.thread_time(), self._divided
            result = work(function, items, *more)
            self._divided = divided + time.thread_time() - begin  # pieces of pieces are in it
            return result
        self._go_on()
        begin, second = self.now, max(self.now, self.free)
        ends = [begin, second]

        def piece(item):
            result, seconds = self._timed(partial(function, item))
            ends[ends.index(min(ends))] += seconds
            return result

        found = work(piece, items, *more)
        self._go_on()
        between = self.now - begin
        if ends[1] > second:  # it has had some of them
            self.free = ends[1]
        self.now = between + (max(ends) if ends[1] > second else ends[0])
        return found

    def _timed(self, function):
        """What a function returns, and its processor time, zero within what is timed already."""
        if self._inside:
            return function(), 0.0
        self._go_on()
        self._inside, begin = True, self._clock
        try:
            result = function()
        finally:
            self._inside, self._clock = False, time.thread_time()
        self.shared += self._clock - begin
        return result, self._clock - begin

    def _go_on(self):
        """Let the first one's clock go on until now."""
        if not self._inside:
            before, self._clock = self._clock, time.thread_time()
            self.now += self._clock - before


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
        entry = stages.setdefault(
            before["stage"], dict.fromkeys(("cpu", "wall", "waited", "slept", "shared", "two", "peak"), 0.0)
        )
        for name in ("cpu", "wall", "waited", "slept", "shared", "two"):
            entry[name] += after[name] - before[name]
        entry["peak"] = after["peak"]
    stages[marks[0]["stage"]]["cpu"] += marks[0]["cpu"]
    stages[marks[0]["stage"]]["wall"] += marks[0]["cpu"]
    stages[marks[0]["stage"]]["two"] += marks[0]["cpu"]
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
    names = ("CPU 1", "wall 1", "alone", "two", "MB 1", "CPU 2", "wall 2", "serial", "slept", "MB 2")
    print(f"{'stage':28s} " + " ".join(f"{name:>7s}" for name in names))
    columns = [(1, key) for key in ("cpu", "wall", "alone", "two", "peak")]
    columns += [(2, key) for key in ("cpu", "wall", "serial", "slept", "peak")]
    table = {
        stage: [median([run[0].get(stage, {}).get(key, 0.0) for run in rounds[threads]]) for threads, key in columns]
        for stage in rounds[2][0][0]
    }
    several = [max if key == "peak" else sum for _, key in columns]
    whole = table["all"] = [of(row[k] for row in table.values()) for k, of in enumerate(several)]
    for stage, row in table.items():
        print(f"{stage:28s} " + " ".join(f"{value:7.2f}" for value in row))
    of = dict(zip(names, whole, strict=True))
    print(
        f"\nalone {of['alone'] / of['CPU 1']:.1%}; two threads can be {of['CPU 1'] / of['two']:.2f} times as fast; ",
        end="",
    )
    print(f"serial {of['serial'] / of['CPU 2']:.1%}; ratio of wall times {of['wall 1'] / of['wall 2']:.2f}")
    one, two = (median([run[1]["peak"] for run in rounds[threads]]) for threads in (1, 2))
    scenes = {run[1]["scene"] for runs in rounds.values() for run in runs}
    same = "the same bit by bit" if len(scenes) == 1 else "NOT the same"
    lines = rounds[2][0][1]["lines"]
    print(f"peak memory {one:.0f} and {two:.0f} MB, ratio {two / one:.2f}; lines {lines}; the scenes are {same}")


if __name__ == "__main__":
    main()
