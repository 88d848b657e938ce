# SPDX-License-Identifier: BSD-3-Clause
"""What the Python contestants share: clocks, peak memory, the line of JSON they print.

They run on one thread when the environment says so before they start, as ``run.py`` does.
"""

from __future__ import annotations

import json
import resource
import time


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


def report(**fields) -> None:
    """Print the result as the last line of output, with the peak memory."""
    print(json.dumps({**fields, "peak_memory_mib": round(peak_memory_mib(), 1)}), flush=True)
