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

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
#: Longest that one run may take, seconds.
TIMEOUT = 600


@dataclass(frozen=True)
class BenchmarkProblem:
    """A problem, and the file each contestant reads."""

    name: str
    title: str
    #: ``points``: BAL model, calibration estimated; ``points_lines``: pinhole images, calibration held.
    kind: str
    #: A BAL file looked for in the folder of data, a COLMAP model (a path, looked for beside it), or the size of a
    #: corridor.
    source: str
    quick: bool = False
    #: Runs only if it is named.
    large: bool = False

    @property
    def is_corridor(self) -> bool:
        """Whether the problem is generated."""
        return not self.source.startswith("problem-") and not self.is_model

    @property
    def is_model(self) -> bool:
        """Whether the problem is made from a COLMAP model."""
        return "/" in self.source

    def file_for(self, contestant: str) -> Path:
        """Return the prepared file."""
        stem = f"corridor_{self.source}_{self.kind}" if self.is_corridor else self.source.replace("/", "_")
        if self.kind == "points":
            return CACHE / f"{stem}.txt"
        return CACHE / {"groma": f"{stem}.npz", "limap": stem}.get(contestant, f"{stem}.txt")

    def prepare(self, data: Path) -> bool:
        """Unpack or generate the file; return False where its data is not at hand."""
        CACHE.mkdir(parents=True, exist_ok=True)
        if all(self.file_for(name).exists() for name in ("groma", "ceres", "limap")):
            return True
        if self.is_corridor:
            script = CONTESTANTS / "make_corridor.py"
            subprocess.run([sys.executable, script, self.kind, self.source, CACHE], check=True, env=environment())
            return True
        if self.is_model:
            model, script = data.parent / self.source, CONTESTANTS / "make_from_colmap.py"
            if model.is_dir():
                command = [sys.executable, script, model, self.file_for("ceres")]
                subprocess.run(command, check=True, env=environment())
            return model.is_dir()
        for packed in (data / f"{self.source}.txt.bz2", PACKAGED / f"{self.source}.txt.bz2"):
            if packed.is_file():
                draft = CACHE / f"{self.source}.draft"
                draft.write_bytes(bz2.decompress(packed.read_bytes()))
                draft.replace(self.file_for("ceres"))
                return True
        return False

    def missing(self, data: Path) -> str:
        """Say what data is not at hand."""
        return f"there is no {data.parent / self.source if self.is_model else data / f'{self.source}.txt.bz2'}."


PROBLEMS = (
    BenchmarkProblem("ladybug-49", "Ladybug-49", "points", "problem-49-7776-pre", quick=True),
    BenchmarkProblem("trafalgar-21", "Trafalgar-21", "points", "problem-21-11315-pre", quick=True),
    BenchmarkProblem("dubrovnik-16", "Dubrovnik-16", "points", "problem-16-22106-pre", quick=True),
    BenchmarkProblem("castle-30", "Castle-P30, a COLMAP model", "points", "strecha_castle_p30/sparse_inc"),
    BenchmarkProblem("south-building-26", "South Building, a COLMAP model", "points", "south_building/sparse_inc"),
    BenchmarkProblem("corridor-300", "Corridor, 300 cameras, 50 000 points", "points", "medium"),
    BenchmarkProblem("corridor-1500", "Corridor, 1 500 cameras, 400 000 points", "points", "large", large=True),
    BenchmarkProblem("lines-50", "Corridor, 50 cameras, points and 2 000 lines", "points_lines", "small", quick=True),
    BenchmarkProblem("lines-300", "Corridor, 300 cameras, points and 20 000 lines", "points_lines", "medium"),
    BenchmarkProblem(
        "lines-1000", "Corridor, 1 000 cameras, points and 40 000 lines", "points_lines", "1000", large=True
    ),
)


def environment(threads: int | None = 1, **more: str) -> dict[str, str]:
    """Return the environment of a measured program: so many threads, kernels and bytecode cached with our own things.

    Bytecode is always cached, as in an installed package; without it Python would compile its sources in every run.
    """
    limits = {} if threads is None else dict.fromkeys(THREAD_VARIABLES, str(threads))
    ours = {"NUMBA_CACHE_DIR": str(CACHE / "numba"), "PYTHONPYCACHEPREFIX": str(CACHE / "bytecode")}
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return {**inherited, **ours, **limits, **more}


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


def run_program(command: list, threads: int = 1) -> dict | None:
    """Run a program that prints a line of JSON at its end; return it, or None (and say why) if it failed."""
    words = [str(word) for word in command]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=TIMEOUT, env=environment(threads))
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


def keep_results(name: str, content: dict, text: str) -> None:
    """Write what was measured and its table, and print the table."""
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n")
    (RESULTS / f"{name}.md").write_text(text + "\n")
    print(text)


def machine() -> dict[str, object]:
    """Return what the reader of a result must know about the machine."""
    name = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as file:
            name = next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return {"processor": name, "cores": os.cpu_count(), "python": platform.python_version()}
