# SPDX-License-Identifier: BSD-3-Clause
"""How soon frames are answered: fed as fast as they are answered, and as a camera would feed them.

    python benchmarks/frame_times.py SEQUENCE [--rate 30] [--rounds 2]

SEQUENCE is one with a reference. Its frames are read before the clock starts. Printed are, of every run, medians and
95th percentiles over the frames: milliseconds from when a frame was there to its pose (at the pace of a camera that
includes the time that it waits for the frame before), and CPU milliseconds of the thread that answers; then the mean
over the frames of the CPU time of all threads, and the position error. On a machine with other work CPU times tell.
"""

import argparse
import time
from functools import partial
from pathlib import Path

import numpy as np

from groma.evaluation.trajectory import score_trajectory
from groma.io.sequences import open_sequence
from groma.tracking import Tracker


def fed(sequence, frames: list, rate: float) -> str:
    """Track frames, at so many a second or, with 0, as fast as they are answered; return a row of the table."""
    tracker = Tracker(sequence.camera)
    answers, own = [], []
    every, begin = time.process_time(), time.perf_counter()
    for k, frame in enumerate(frames):
        there = begin + k / rate if rate else time.perf_counter()
        time.sleep(max(0.0, there - time.perf_counter()))
        cpu = time.thread_time()
        # The frame after this one is known only where frames wait.
        tracker.process(frame, None if rate or k + 1 == len(frames) else frames[k + 1])
        answers.append(time.perf_counter() - there)
        own.append(time.thread_time() - cpu)
    every = time.process_time() - every
    error = score_trajectory(tracker.finish().trajectory, sequence.reference, "se3", 0.02).ate.rmse
    numbers = [spread(times) for times in (answers, own) for spread in (np.median, partial(np.percentile, q=95))]
    cells = [f"{1e3 * number:.1f}" for number in numbers]
    cells += [f"{1e3 * every / len(frames):.1f}", f"{100 * error:.2f} cm"]
    return f"| {f'{rate:g} a second' if rate else 'as fast as answered'} | {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--rate", type=float, default=30.0, help="frames a second")
    parser.add_argument("--rounds", type=int, default=2)
    arguments = parser.parse_args()
    sequence = open_sequence(arguments.sequence)
    frames = list(sequence)
    print("| fed | answer, median | 95 % | CPU of that thread, median | 95 % | CPU of all, mean | position error |")
    print("|---|--:|--:|--:|--:|--:|--:|")
    for _ in range(arguments.rounds):
        for rate in (0.0, arguments.rate):
            print(fed(sequence, frames, rate), flush=True)


if __name__ == "__main__":
    main()
