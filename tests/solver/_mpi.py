"""Starting commands by mpiexec, and comparing what they wrote."""

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

MPIEXEC = shutil.which("mpiexec", path=sysconfig.get_path("scripts")) or shutil.which("mpiexec")
needs_mpi = pytest.mark.skipif(
    MPIEXEC is None or importlib.util.find_spec("mpi4py") is None, reason='needs pip install "groma[mpi]"'
)


def mpiexec(*ranks: list[object]) -> subprocess.CompletedProcess[str]:
    """Run one process of Python per list of arguments, all together."""
    command = [str(MPIEXEC)]
    for number, arguments in enumerate(ranks):
        command += [":"] if number else []
        command += ["-n", "1", sys.executable, *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=environment)


def same_bytes(first: Path, second: Path) -> bool:
    """Whether two folders hold the same files."""
    names = sorted(path.name for path in first.iterdir())
    return names == sorted(path.name for path in second.iterdir()) and all(
        (first / name).read_bytes() == (second / name).read_bytes() for name in names
    )
