"""Starting commands by mpiexec, and comparing what they wrote."""

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path

import pytest

MPIEXEC = shutil.which("mpiexec", path=sysconfig.get_path("scripts")) or shutil.which("mpiexec")
needs_mpi = pytest.mark.skipif(
    MPIEXEC is None or importlib.util.find_spec("mpi4py") is None, reason='needs pip install "groma[mpi]"'
)


def mpiexec(*ranks: Sequence[object]) -> subprocess.CompletedProcess[str]:
    """Run one process of Python per list of arguments, all together."""
    command = [str(MPIEXEC)]
    for number, arguments in enumerate(ranks):
        command += [":"] if number else []
        command += ["-n", "1", sys.executable, *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=environment)


def commands(*ranks: Sequence[Sequence[object]]) -> list[tuple[int, str, str]]:
    """Run commands of groma in one start, a list of them per rank; return exit code and both streams of each."""
    said = mpiexec(*[[__file__, json.dumps(words, default=str)] for words in ranks])
    assert said.returncode == 0, said.stderr
    (*out, _), (*err, _) = (re.split(r"END (\d)\n", stream) for stream in (said.stdout, said.stderr))
    return [(int(code), *texts) for code, texts in zip(err[1::2], zip(out[::2], err[::2], strict=True), strict=True)]


def same_bytes(first: Path, second: Path) -> bool:
    """Whether two folders hold the same files."""
    names = sorted(path.name for path in first.iterdir())
    return names == sorted(path.name for path in second.iterdir()) and all(
        (first / name).read_bytes() == (second / name).read_bytes() for name in names
    )


if __name__ == "__main__":
    from groma.cli.main import run
    from groma.solver.reduce.mpi import Ranks

    together = Ranks()
    for words in json.loads(sys.argv[1]):
        code = run(words)
        sys.stdout.flush()
        together.gather("what the others say comes first")
        for stream in (sys.stdout, sys.stderr) if together.rank == 0 else ():
            print(f"END {code}", file=stream, flush=True)
