# SPDX-License-Identifier: BSD-3-Clause
"""How soon frames are answered: fed as fast as they are answered, and as a camera would feed them.

    python benchmarks/frame_times.py SEQUENCE [--rate 30] [--rounds 2] [--waits]

SEQUENCE is one with a reference. Its frames are read before the clock starts. Printed are, of every run, medians and
95th percentiles over the frames: milliseconds from when a frame was there to its pose (at the pace of a camera that
includes the time that it waits for the frame before), and CPU milliseconds of the thread that answers; then the mean
over the frames of the CPU time of all threads, and the position error. On a machine with other work CPU times tell.
With --waits (Linux) follow milliseconds, mean over all frames and over the four after each that was chosen as a
keyframe: the answering thread runs, waits for a core, for the map, for something else (interpreter, threads beside).
"""

import argparse
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np

from groma.evaluation.trajectory import score_trajectory
from groma.features.images import one_opencv_thread
from groma.io.sequences import open_sequence
from groma.tracking import Tracker


def scheduled() -> np.ndarray:
    """Seconds that this thread ran and waited for a core, as the scheduler of Linux counts, and the time."""
    numbers = Path(f"/proc/self/task/{threading.get_native_id()}/schedstat").read_text(encoding="ascii").split()
    return np.array([1e-9 * int(numbers[0]), 1e-9 * int(numbers[1]), time.perf_counter()])


def told(rows: list, chosen: list) -> str:
    """Return what the answering thread did, over all frames and those after each chosen one."""
    times = 1e3 * np.array(rows)
    after = sorted({k + n for k in np.flatnonzero(chosen[1:]) + 1 for n in range(1, 5) if k + n < len(rows)})
    means = np.stack([times.mean(axis=0), times[after].mean(axis=0)], axis=1)
    names = ("runs", "waits for a core", "waits for the map", "waits for something else")
    return "\n".join(f"{name}: {every:.1f}, {few:.1f}" for name, (every, few) in zip(names, means, strict=True))


def fed(sequence, frames: list, rate: float, waits: bool) -> str:
    """Track frames, at so many a second or, with 0, as fast as they are answered; return a row of the table."""
    tracker = Tracker(sequence.camera)
    answers, own, rows, chosen = [], [], [], []
    every, begin = time.process_time(), time.perf_counter()
    for k, frame in enumerate(frames):
        there = begin + k / rate if rate else time.perf_counter()
        time.sleep(max(0.0, there - time.perf_counter()))
        cpu, before = time.thread_time(), scheduled() if waits else None
        # The frame after this one is known only where frames wait.
        tracked = tracker.process(frame, None if rate or k + 1 == len(frames) else frames[k + 1])
        if before is not None:
            ran, queued, passed = scheduled() - before
            settled = tracked.timings.get("map", 0.0)
            rows.append((ran, queued, settled, max(passed - ran - queued - settled, 0.0)))
            chosen.append(tracked.keyframe)
        answers.append(time.perf_counter() - there)
        own.append(time.thread_time() - cpu)
    every = time.process_time() - every
    error = score_trajectory(tracker.finish().trajectory, sequence.reference, "se3", 0.02).ate.rmse
    numbers = [spread(times) for times in (answers, own) for spread in (np.median, partial(np.percentile, q=95))]
    cells = [f"{1e3 * number:.1f}" for number in numbers]
    cells += [f"{1e3 * every / len(frames):.1f}", f"{100 * error:.2f} cm"]
    row = f"| {f'{rate:g} a second' if rate else 'as fast as answered'} | {' | '.join(cells)} |"
    return f"{row}\n{told(rows, chosen)}" if waits else row


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--rate", type=float, default=30.0, help="frames a second")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--waits", action="store_true", help="also what the answering thread waits for (Linux)")
    arguments = parser.parse_args()
    sequence = open_sequence(arguments.sequence)
    if sequence.camera.baseline is None:  # as the command does
        one_opencv_thread()
    frames = list(sequence)
    print("| fed | answer, median | 95 % | CPU of that thread, median | 95 % | CPU of all, mean | position error |")
    print("|---|--:|--:|--:|--:|--:|--:|")
    for _ in range(arguments.rounds):
        for rate in (0.0, arguments.rate):
            print(fed(sequence, frames, rate, arguments.waits), flush=True)


if __name__ == "__main__":
    main()
