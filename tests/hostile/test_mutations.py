# SPDX-License-Identifier: BSD-3-Clause
"""Damaged files of every format: whatever is in them, a reader gives a result or one line; and bombs stay small.

``just hostile`` runs 100 000 cases; here are some hundred of them, and as a slow test some thousand. What is counted,
and in which processes, says ``_runner.py``; ``_targets.py`` lists the readers.
"""

import bz2
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
pytestmark = pytest.mark.skipif(os.name == "nt", reason="processes are forked, and bounded in memory")


@pytest.mark.parametrize("cases", [500, pytest.param(5000, marks=(pytest.mark.slow, pytest.mark.timeout(3600)))])
def test_mutations(cases):
    finished = subprocess.run(
        [sys.executable, str(HERE / "_runner.py"), "--cases", str(cases), "--seed", "1"],
        capture_output=True, text=True, timeout=3500,
    )  # fmt: skip
    assert finished.returncode == 0, finished.stdout[-4000:] + finished.stderr[-2000:]
    assert f"{cases:,} mutated files" in finished.stdout


BROKEN = """
import os, signal, sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import _runner, _targets
_runner.SECONDS = 1  # of the processor

def broken(folder):
    number = int((folder / "n").read_bytes()[:1] or b"0")
    if number == 1:
        raise ValueError("two\\nlines")
    if number == 2:
        os.kill(os.getpid(), signal.SIGSEGV)
    if number == 3:
        while True:
            pass
    if number == 4:
        return bytes(3 << 30)
    if number == 5:
        from groma.errors import FileFormatError
        raise FileFormatError("refused")

def targets(home):
    made = []
    for number in range(6):
        (home / str(number)).mkdir()
        (home / str(number) / "n").write_bytes(b"%d" % number)
        made.append(_targets.Target(str(number), home / str(number), ("n",), broken))
    return made

# What a case imports is imported before the first fork: it is not the time of a case.
_targets.targets, _runner._warm_up = targets, lambda all_targets: _runner._use(None, None, None)
import _mutations
_mutations.mutated = lambda rng, content: content
counts, bad = _runner.run(0, 12, 0)
print(dict(counts))
"""


def test_the_harness_sees_what_is_bad():
    finished = subprocess.run(
        [sys.executable, "-c", BROKEN, str(HERE)], capture_output=True, text=True, timeout=300, check=True
    )
    # Memory that the bound refuses is a MemoryError in the reader, which is no error of groma here.
    counts = eval(finished.stdout)
    assert counts == {"ok": 2, "traceback": 4, "crash": 2, "too slow": 2, "refused": 2}


# ------------------------------------------------------------------------------------------------------------ Bombs

READ = """
import resource, sys
from pathlib import Path
from groma.errors import GromaError
from groma.features.external import read_matches
from groma.io import read_g2o, read_scene, read_trajectory
from groma.io.reference import read_reference
from groma.mapping.photographs import read_gray
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in sorted(Path(sys.argv[1]).iterdir()):
    read = {"scene": read_scene, "g2o": read_g2o, "trajectory": read_trajectory, "reference": read_reference,
            "matches": read_matches, "image": read_gray}[path.stem.split("-")[1]]
    try:
        read(path)
        outcome = "ok"
    except GromaError as error:
        outcome = "refused"
    print(path.name, outcome, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10)
"""


def _png_header(width: int, height: int) -> bytes:
    import struct
    import zlib

    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))


def _gzip_of(line: bytes, size: int) -> bytes:
    return subprocess.run(
        [sys.executable, "-c", "import gzip,sys; sys.stdout.buffer.write(gzip.compress(sys.stdin.buffer.read(), 9))"],
        input=line * (size // len(line)), capture_output=True, check=True,
    ).stdout  # fmt: skip


def _npz_of(folder: Path, files: dict[str, list[tuple[str, tuple[int, ...], str]]]) -> None:
    """Write archives of zeros, in a process of its own: the memory of this one is inherited by those it starts."""
    save = "np.savez_compressed(name, **{k: np.zeros(s, t) for k, s, t in arrays})"
    code = f"import numpy as np, sys\nfor name, arrays in eval(sys.argv[1]).items(): {save}"
    subprocess.run([sys.executable, "-c", code, repr(files)], check=True, cwd=folder)


@pytest.mark.timeout(300)
def test_small_files_stay_small(tmp_path):
    """Half a megabyte may take less than a gigabyte, whether it is read or refused."""
    texts = {
        "1-trajectory.gz": _gzip_of(b"0 0 0 0 0 0 0 1\n", 48 << 20),
        "2-trajectory.gz": _gzip_of(b"0 0 0 0 0 0 0 1\n", 4 << 20),
        "3-trajectory.gz": _gzip_of(b"a\n", 30 << 20),
        "4-g2o.gz": _gzip_of(b"VERTEX_SE2 1 1 1 1\n", 12 << 20),
        "5-g2o.gz": _gzip_of(b"FIX 1 1 1 1 1 1 1 1 1 1 1 1 1 1 1\n", 12 << 20),
        "6-scene.bz2": bz2.compress(b"1 1 1" + b" " * (48 << 20)),
        "7-image.png": _png_header(60000, 60000) + bytes(1000),
        "8-image.png": _png_header(8000, 8000) + bytes(1000),
    }
    for name, content in texts.items():
        (tmp_path / name).write_bytes(content)
    corners = ("vertices", (3, 3), "f8")
    archives = {
        "a-reference.npz": [("points", (3_000_000, 3), "f8")],
        "b-reference.npz": [corners, ("faces", (20_000_000, 3), "i1")],
        "c-reference.npz": [corners, ("faces", (1_300_000, 3), "i8")],
        "d-matches.npz": [("segments|a", (2_000_000, 4), "f8")],
    }
    _npz_of(tmp_path, archives)
    assert max(path.stat().st_size for path in tmp_path.iterdir()) < 600_000
    finished = subprocess.run(
        [sys.executable, "-c", READ, str(tmp_path)], stdout=subprocess.PIPE, text=True, timeout=280, check=True
    )
    rows = [line.split() for line in finished.stdout.splitlines()]
    assert [row[1] for row in rows] == [
        "refused", "ok", "refused", "refused", "refused", "refused", "refused", "refused",
        "refused", "refused", "ok", "refused",
    ]  # fmt: skip
    assert int(rows[-1][2]) < 1000, finished.stdout
