# SPDX-License-Identifier: BSD-3-Clause
"""Where the benchmarks keep their things, the problems they solve, and how a program is started and measured.

Only the standard library is imported here, so that the driver stays small beside what it measures.
"""

from __future__ import annotations

import bz2
import json
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
RESULTS = HERE / "results"
CONTESTANTS = HERE / "contestants"
#: Unpacked and generated problems, the Ceres programs, Numba's kernels.
CACHE = ROOT / ".cache" / "benchmarks"
PACKAGED = ROOT / "src" / "groma" / "data"

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
#: Longest that one run may take, seconds.
TIMEOUT = 600


@dataclass(frozen=True)
class BenchmarkProblem:
    """A problem, and the file each contestant reads."""

    name: str
    title: str
    #: ``points``: BAL model, calibration estimated; ``points_lines``: pinhole images, calibration held.
    kind: str
    #: A BAL file looked for in the folder of data, or the size of a corridor.
    source: str
    quick: bool = False

    @property
    def is_corridor(self) -> bool:
        """Whether the problem is generated."""
        return not self.source.startswith("problem-")

    def file_for(self, contestant: str) -> Path:
        """Return the prepared file."""
        stem = f"corridor_{self.source}_{self.kind}" if self.is_corridor else self.source
        return CACHE / f"{stem}{'.npz' if self.kind == 'points_lines' and contestant == 'groma' else '.txt'}"

    def prepare(self, data: Path) -> bool:
        """Unpack or generate the file; return False where its data is not at hand."""
        CACHE.mkdir(parents=True, exist_ok=True)
        if all(self.file_for(name).is_file() for name in ("groma", "ceres")):
            return True
        if self.is_corridor:
            script = CONTESTANTS / "make_corridor.py"
            subprocess.run([sys.executable, script, self.kind, self.source, CACHE], check=True, env=environment())
            return True
        for packed in (data / f"{self.source}.txt.bz2", PACKAGED / f"{self.source}.txt.bz2"):
            if packed.is_file():
                draft = CACHE / f"{self.source}.draft"
                draft.write_bytes(bz2.decompress(packed.read_bytes()))
                draft.replace(self.file_for("ceres"))
                return True
        return False


PROBLEMS = (
    BenchmarkProblem("ladybug-49", "Ladybug-49", "points", "problem-49-7776-pre", quick=True),
    BenchmarkProblem("trafalgar-21", "Trafalgar-21", "points", "problem-21-11315-pre", quick=True),
    BenchmarkProblem("dubrovnik-16", "Dubrovnik-16", "points", "problem-16-22106-pre", quick=True),
    BenchmarkProblem("corridor-300", "Corridor, 300 cameras, 50 000 points", "points", "medium"),
    BenchmarkProblem("lines-50", "Corridor, 50 cameras, points and 2 000 lines", "points_lines", "small", quick=True),
    BenchmarkProblem("lines-300", "Corridor, 300 cameras, points and 20 000 lines", "points_lines", "medium"),
)


def environment(**more: str) -> dict[str, str]:
    """Return the environment of a measured program: one thread, kernels and bytecode cached with our own things.

    Bytecode is always cached, as in an installed package; without it Python would compile its sources in every run.
    """
    ours = {"NUMBA_CACHE_DIR": str(CACHE / "numba"), "PYTHONPYCACHEPREFIX": str(CACHE / "bytecode")}
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return {**inherited, **ours, **ONE_THREAD, **more}


def forget_kernels() -> None:
    """Drop the cached kernels: Numba does not notice when a kernel in another file has changed."""
    shutil.rmtree(CACHE / "numba", ignore_errors=True)


def build_ceres() -> Path | None:
    """Build the Ceres programs; return their folder, or None (and say why) where that cannot be done."""
    folder = CACHE / "ceres"
    if shutil.which("cmake") is None:
        print("Ceres is left out: there is no cmake. On Debian: apt install libceres-dev libsuitesparse-dev cmake g++")
        return None
    for command in (["cmake", "-S", CONTESTANTS, "-B", folder], ["cmake", "--build", folder]):
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            reason = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
            print(f"Ceres is left out: its programs do not build ({' '.join(reason)}).")
            return None
    return folder


def run_program(command: list) -> dict | None:
    """Run a program that prints a line of JSON at its end; return it, or None (and say why) if it failed."""
    words = [str(word) for word in command]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=TIMEOUT, env=environment())
    except subprocess.TimeoutExpired:
        print(f"  gave up after {TIMEOUT} s: {' '.join(words)}")
        return None
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if done.returncode or not lines:
        print(f"  failed: {' '.join(words)}\n  {done.stderr.strip()[-400:]}")
        return None
    return json.loads(lines[-1])


def calibrate() -> float:
    """Return the CPU time of a fixed piece of numerical work, seconds: the unit of time on this machine."""
    result = run_program([sys.executable, CONTESTANTS / "calibration.py"])
    if result is None:
        raise SystemExit("The calibration did not run; is NumPy installed for this Python?")
    return result["cpu_s"]


def machine() -> dict[str, object]:
    """Return what the reader of a result must know about the machine."""
    name = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as file:
            name = next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return {"processor": name, "cores": os.cpu_count(), "python": platform.python_version()}
