# SPDX-License-Identifier: BSD-3-Clause
"""Runs mutations in processes that may die, and counts what became of them.

The library is loaded once; every worker is forked from there and works through cases until something ends it: a
signal, the alarm clock of a case, or the bound on its memory. The next worker goes on with the case after.
"""

from __future__ import annotations

import argparse
import collections
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from random import Random

sys.path.insert(0, str(Path(__file__).parent))
# Threads do not survive a fork.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

#: A case may take so many seconds of the processor, so many of the clock, and so many bytes more than the library.
SECONDS, PATIENCE, MEMORY = 10, 60, 1 << 30
OUTCOMES = ("ok", "refused", "traceback", "crash", "too slow", "too large")
#: Of the scenes that are read, one in so many is adjusted, and written as a page.
ADJUST_EVERY = 25


def run(first: int, last: int, seed: int, only: str = "") -> tuple[collections.Counter, list[str]]:
    """Run the cases ``first`` to ``last - 1``; return the counts of outcomes and a line for each that is bad.

    With ``only`` on targets alone whose names begin so.
    """
    import cv2
    from _targets import targets

    cv2.setNumThreads(1)
    base = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    home = Path(tempfile.mkdtemp(prefix="groma-hostile-", dir=base))
    counts: collections.Counter = collections.Counter()
    bad: list[str] = []
    try:
        all_targets = [target for target in targets(home) if target.name.startswith(tuple(only.split(",")))]
        _warm_up(all_targets)
        at = first
        while at < last:
            for number, outcome, words in _worker(all_targets, at, last, seed):
                at = number
                counts[outcome] += 1
                if outcome not in ("ok", "refused"):
                    bad.append(f"case {at} of {all_targets[at % len(all_targets)].name}: {outcome} {words}")
                    print(bad[-1], file=sys.stderr, flush=True)
            at += 1
    finally:
        shutil.rmtree(home, ignore_errors=True)
    return counts, bad


def _worker(all_targets: list, first: int, last: int, seed: int) -> Iterator[tuple[int, str, str]]:
    """Yield what became of the cases from ``first`` on, until the worker dies or is done."""
    ours, theirs = os.pipe()
    _wait_for_threads()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.close(ours)
            _work(all_targets, first, last, seed, theirs)
            status = 0
        except BaseException:
            os.write(theirs, f"-1\t\t{traceback.format_exc()[-1500:]!r}\n".encode())
        finally:
            os._exit(status)
    os.close(theirs)
    done = first - 1
    with open(ours, encoding="utf-8", errors="replace") as lines:
        for line in lines:
            number, outcome, words = line.rstrip("\n").split("\t", 2)
            if not outcome:
                raise RuntimeError(f"The harness itself failed: {words}")
            done = int(number)
            yield done, outcome, words
    status = os.waitpid(child, 0)[1]
    if status and done + 1 < last:
        ended_by = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        outcome = "too slow" if ended_by in (signal.SIGALRM, signal.SIGPROF) else "crash"
        yield done + 1, outcome, f"ended by signal {ended_by}, status {status}"


def _wait_for_threads(seconds: float = 5.0) -> None:
    """Wait until the system has ended the threads that Python has: on its way out one holds a lock of OpenCV, which
    would stay locked in a process that is forked then."""
    end = time.monotonic() + seconds
    while len(os.listdir("/proc/self/task")) > 1 and time.monotonic() < end:
        time.sleep(0.001)


def _work(all_targets: list, first: int, last: int, seed: int, pipe: int) -> None:
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    os.dup2(sink, 2)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY + (256 << 20), resource.RLIM_INFINITY))
    for number in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(number, signal.SIG_DFL)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in range(first, last):
        signal.alarm(PATIENCE)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        outcome, words = _case(all_targets[number % len(all_targets)], Random(f"{seed} {number}"))
        signal.alarm(0)
        signal.setitimer(signal.ITIMER_PROF, 0)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10
        if grown > MEMORY:
            outcome, words = "too large", f"{grown >> 20} MB ({outcome})"
        os.write(pipe, f"{number}\t{outcome}\t{words[:1500]!r}\n".encode())
        if grown > MEMORY:
            os._exit(0)


def _case(target: object, rng: Random) -> tuple[str, str]:
    """Change a file of a target, read, and put the file back."""
    from _mutations import mutated

    path = target.folder / rng.choice(target.files)  # type: ignore[attr-defined]
    good = path.read_bytes()
    path.write_bytes(mutated(rng, good))
    try:
        return _outcome(target, rng)
    finally:
        path.write_bytes(good)


def _outcome(target: object, rng: Random) -> tuple[str, str]:
    from groma.errors import GromaError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = target.read(target.folder)  # type: ignore[attr-defined]
            _use(found, target.folder, rng)  # type: ignore[attr-defined]
        except GromaError as error:
            if isinstance(error.__cause__, MemoryError):
                return "too large", str(error)
            return ("refused", "") if str(error).strip() else ("traceback", "an error without words")
        except BaseException as error:
            return "traceback", f"{type(error).__name__}: {str(error)[:200]} at {_place(error)}"
    return "ok", ""


def _place(error: BaseException) -> str:
    """Return the innermost places in groma that an error went through."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "/groma/" in frame.filename]
    return " < ".join(f"{frame.filename.rsplit('/groma/')[-1]}:{frame.lineno}" for frame in reversed(frames[-3:]))


def _use(found: object, folder: Path, rng: Random) -> None:
    """Adjust what was read, and write it, now and then."""
    from groma.adjustment.adjust import AdjustOptions, adjust
    from groma.io import write_archive
    from groma.scene import Scene
    from groma.viz.report.page import write_report

    if isinstance(found, Scene) and rng.random() * ADJUST_EVERY < 1:
        write_archive(found, folder / "again.out", force=True)
        write_report(folder / "page.out", None, found)
        adjust(found, AdjustOptions(max_iterations=4))


def _warm_up(all_targets: list) -> None:
    """Load and compile everything that cases use, on files that are good."""
    from groma.scene import Scene

    class Always(Random):
        def random(self) -> float:
            return 0.0

    for target in all_targets:
        found = target.read(target.folder)
        if not isinstance(found, Scene) or len(found.point_observations):
            try:
                _use(found, target.folder, Always())
            except Exception as error:
                if type(error).__module__ != "groma.errors":
                    raise


def report(counts: collections.Counter, bad: list[str], seconds: float) -> str:
    """Return the counts as text."""
    total = sum(counts.values())
    rows = [f"{total:,} mutated files in {seconds:.0f} s"]
    rows += [f"  {name:<12}{counts[name]:>9,}" for name in OUTCOMES]
    return "\n".join([*rows, *bad])


def main() -> int:
    """``python tests/hostile/_runner.py --cases 100000``: exit code 1 if anything is bad."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=3000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="beginnings of the names of targets, separated by commas")
    arguments = parser.parse_args()
    start = time.perf_counter()
    counts, bad = run(arguments.first, arguments.first + arguments.cases, arguments.seed, arguments.only)
    print(report(counts, bad, time.perf_counter() - start))
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
