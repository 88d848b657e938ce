# SPDX-License-Identifier: BSD-3-Clause
"""What the Python contestants share: clocks, peak memory, the line of JSON they print.

Numerical libraries run on as many threads as the environment says before they start, which ``run.py`` sets.
"""

from __future__ import annotations

import json
import resource
import time

#: The rule of all contestants: stop when a step lowers the cost by less than this fraction, or after so many steps.
TOLERANCE, MAX_STEPS = 1e-6, 50


def peak_memory_mib() -> float:
    """Return the peak resident memory of this program.

    VmHWM belongs to this program alone; ru_maxrss may still hold that of the one that started it.
    """
    try:
        with open("/proc/self/status") as file:
            return next(int(line.split()[1]) for line in file if line.startswith("VmHWM:")) / 1024
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


class Clock:
    """CPU time of all threads and wall time since it was made."""

    def __init__(self) -> None:
        self._cpu, self._wall = time.process_time(), time.perf_counter()

    def read(self) -> dict[str, float]:
        """Return the two times so far, seconds."""
        return {"cpu_s": time.process_time() - self._cpu, "wall_s": time.perf_counter() - self._wall}


class Curve:
    """CPU time, wall time and the best cost so far, after every step."""

    def __init__(self) -> None:
        self._clock, self._best = Clock(), float("inf")
        self.entries: list[list[float]] = []

    def add(self, cost: float) -> None:
        """Note the cost after a step."""
        times = self._clock.read()
        self._best = min(self._best, float(cost))
        self.entries.append([round(times["cpu_s"], 6), round(times["wall_s"], 6), self._best])

    def finish(self) -> dict:
        """Return the times of the whole solve, and the curve."""
        return {**self._clock.read(), "curve": self.entries}


def read_bal(path: str):
    """Return (camera_of, point_of, pixels, cameras (C, 9), points (P, 3)) of a BAL file, as they stand there."""
    import numpy as np

    with open(path) as file:
        num_cameras, num_points, num_observations = map(int, file.readline().split())
        numbers = np.array(file.read().split(), dtype=float)
    rows, cameras, points = np.split(numbers, [4 * num_observations, 4 * num_observations + 9 * num_cameras])
    rows = rows.reshape(-1, 4)
    index = rows[:, :2].astype(np.int32)
    return index[:, 0], index[:, 1], rows[:, 2:].copy(), cameras.reshape(-1, 9), points.reshape(num_points, 3)


def report(**fields) -> None:
    """Print the result as the last line of output, with the peak memory."""
    print(json.dumps({**fields, "peak_memory_mib": round(peak_memory_mib(), 1)}), flush=True)
