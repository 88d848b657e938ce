# SPDX-License-Identifier: BSD-3-Clause
"""What is loaded by ``import groma`` and by ``groma --help``: nothing that is slow. No clock is read."""

import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = ("numba", "llvmlite", "scipy", "pycolmap", "cv2", "viser")


def _loaded_after(code: str) -> set[str]:
    finished = subprocess.run(
        [sys.executable, "-c", code + "\nimport sys\nprint('LOADED', *sorted(sys.modules))"],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    line = next(line for line in finished.stdout.splitlines() if line.startswith("LOADED"))
    return set(line.split()[1:])


@pytest.mark.parametrize(
    "code",
    [
        "import groma",
        "from groma.cli.main import run\nassert run(['--help']) == 0",
        "from groma.cli.main import run\nassert run(['adjust', '--help']) == 0",
        "from groma.cli.main import run\nassert run(['evaluate', 'poses', '--help']) == 0",
        "from groma.cli.main import run\nassert run(['--version']) == 0",
    ],
)
def test_nothing_heavy_is_loaded(code):
    assert not _loaded_after(code) & {*HEAVY, "numpy"}


def test_the_entry_point_loads_only_what_python_has_loaded():
    """Ctrl-C is answered once it is loaded; gc and zlib are parts of the interpreter."""
    mine = _loaded_after("import gc, zlib\nfrom groma.cli.main import main") - _loaded_after("import gc, zlib")
    assert mine == {"groma", "groma._version", "groma.cli", "groma.cli.main"}


def test_the_viewer_is_loaded_only_when_asked_for():
    assert "viser" not in _loaded_after("import groma\ngroma.adjust\ngroma.read_scene")


def test_special_functions_are_loaded_when_a_map_needs_them():
    """They bring a hundred modules along; by then other threads look for segments."""
    loaded = _loaded_after("from groma.cli.app import app\nimport groma.mapping.map")
    assert not loaded & {"scipy.special", "scipy.sparse", "scipy.spatial", "scipy.linalg", "numpy.f2py"}


def test_a_plain_adjustment_loads_the_solver_alone(tmp_path):
    """No photographs are looked at, no COLMAP model is read, and of SciPy nothing but LAPACK is needed."""
    source = Path(__file__).parent / "data" / "bal" / "dubrovnik-3-7-18-pre.txt"
    code = (
        "from groma.cli.main import run\n"
        f"assert run(['adjust', {str(source)!r}, '-o', {str(tmp_path / 'out.npz')!r}, '--force']) == 0"
    )
    _loaded_after(code)  # compiles: Numba then loads SciPy's linear algebra
    loaded = _loaded_after(code)
    assert not loaded & {"scipy.linalg", "scipy.sparse", "scipy.spatial", "scipy.stats", "cv2", "pycolmap"}
    assert (tmp_path / "out.npz").exists()
