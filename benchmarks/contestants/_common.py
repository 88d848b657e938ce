# SPDX-License-Identifier: BSD-3-Clause
"""What the Python contestants share: one thread, clocks, peak memory, the line of JSON they print."""

from __future__ import annotations

import json
import os
import resource
import time

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"


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
