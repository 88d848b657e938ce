# SPDX-License-Identifier: BSD-3-Clause
"""Compiled functions on disk: found again, compiled again after a change, harmless where nothing can be written, whole
when several processes write at once. What counts as a change: ``test_kernel_digest.py``."""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import caching

import groma
from groma._kernels import cache as kernel_cache
from groma._kernels import digest as kernel_digest
from groma._kernels import folder as kernel_folder

pytestmark = [pytest.mark.kernels, pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")]

SOURCE = """
from groma._numba import kernel, loop

@kernel
def double(x):
    return x + x

@loop
def total(values):
    result = 0.0
    for i in range(values.shape[0]):
        result += double(values[i])
    return result
"""

TOTAL = """
def total(values):
    return total_of(double, values)
"""

#: What a process that compiles something real prints: the numbers as bits, and what was compiled.
PROGRAM = """
import numpy as np
from groma import cameras
from groma._kernels.cache import counts
rng = np.random.default_rng(0)
points = rng.uniform([-1, -1, 2], [1, 1, 5], (100, 3))
parts = []
for name, params in (("PINHOLE", [500, 480, 320, 240]), ("RADIAL", [500, 320, 240, -0.1, 0.02])):
    pixels, by_point, by_params = cameras.model(name).project_jacobian(np.array(params, dtype=float), points)
    parts += [pixels.tobytes(), by_point.tobytes(), by_params.tobytes()]
print("NUMBERS", b"".join(parts).hex())
print("COUNTS", counts.compiled, counts.loaded, counts.unsaved)
"""


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """A function that loads the module as a new process would, and returns what ``total`` gives and the counts."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")  # Numba reads it again when anything in the environment changes
    path = tmp_path / "cached_sample.py"
    path.write_text(SOURCE)

    def run(values=None):
        before = kernel_cache.counts.compiled, kernel_cache.counts.loaded, kernel_cache.counts.unsaved
        spec = importlib.util.spec_from_file_location("cached_sample", path)
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "cached_sample", module)
        spec.loader.exec_module(module)
        result = module.total(np.ones(3) if values is None else values)
        after = kernel_cache.counts.compiled, kernel_cache.counts.loaded, kernel_cache.counts.unsaved
        return result, *(b - a for a, b in zip(before, after, strict=True))

    run.path = path
    return run


def _files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.nbc"))


def test_what_was_compiled_is_found_again(fresh):
    result, compiled, loaded, _ = fresh()
    assert (result, loaded) == (6.0, 0)
    assert compiled > 0
    result, compiled, loaded, _ = fresh()
    assert (result, compiled) == (6.0, 0)
    assert loaded > 0


def test_functions_of_others_are_not_among_the_files_of_the_package(fresh):
    """Whether groma is ready must not hang on a file of somebody's own factor, which may go at any time."""
    fresh()
    mine = [path for path in kernel_cache.used_paths() if "cached_sample" in path.name]
    assert mine
    assert not {*mine} & {*kernel_cache.used_files()}


def test_other_argument_types_have_files_of_their_own(fresh):
    fresh()
    assert fresh(np.ones(3, dtype=np.int64))[1] > 0
    assert fresh()[1] == fresh(np.ones(3, dtype=np.int64))[1] == 0


def test_an_upgrade_compiles_again_and_leaves_nothing_behind(fresh, monkeypatch, tmp_path):
    fresh()
    files = _files(tmp_path)
    monkeypatch.setattr(kernel_digest, "environment", lambda: "another version")
    assert fresh()[1] > 0
    assert _files(tmp_path) == files
    assert fresh()[1] == 0


def test_a_changed_function_is_not_served_from_its_older_self(fresh):
    assert fresh()[0] == 6.0
    fresh.path.write_text(SOURCE.replace("result += double", "result += 2.0 * double"))
    assert fresh()[0] == 12.0


def test_a_function_that_is_given_functions_is_not_kept(fresh, tmp_path):
    """The address of an argument would name it, and hold for one process only."""
    fresh.path.write_text(SOURCE.replace("total(values)", "total_of(f, values)").replace("double(v", "f(v") + TOTAL)
    assert fresh()[0] == fresh()[0] == 6.0
    assert not [path for path in _files(tmp_path) if "total_of" in path.name]


@pytest.mark.parametrize("damage", [lambda content: content[:-20], lambda content: b"", lambda content: b"x" * 500])
def test_a_damaged_file_is_compiled_again(fresh, tmp_path, damage):
    fresh()
    for path in _files(tmp_path):
        path.write_bytes(damage(path.read_bytes()))
    result, compiled, _, _ = fresh()
    assert result == 6.0
    assert compiled > 0
    assert fresh()[1] == 0


def test_a_read_only_installation_uses_the_folder_of_the_user(fresh, monkeypatch, tmp_path):
    home = tmp_path / "home"
    monkeypatch.setenv("XDG_CACHE_HOME", str(home))
    monkeypatch.setattr(caching.InTreeCacheLocator, "ensure_cache_path", _refuse)
    if sys.platform != "linux":
        pytest.skip("the user's folder is set by XDG_CACHE_HOME on Linux only")
    assert fresh()[1] > 0
    assert _files(home)
    assert fresh()[1] == 0
    assert home in kernel_cache.folder().parents


def test_without_a_folder_of_the_user_processes_that_belong_together_share_one(fresh, monkeypatch, tmp_path):
    """A service without a home: what is compiled is found again in this process, and removed when it ends."""
    for locator in (caching.InTreeCacheLocator, caching.UserWideCacheLocator):
        monkeypatch.setattr(locator, "ensure_cache_path", _refuse)
    ends: list = []
    monkeypatch.setattr(kernel_folder.atexit, "register", lambda *call, **options: ends.append((call, options)))
    monkeypatch.setattr(kernel_folder, "_own", None)
    monkeypatch.setattr(kernel_folder.tempfile, "tempdir", str(tmp_path))
    assert fresh()[1] > 0
    result, compiled, loaded, _ = fresh()
    assert (result, compiled) == (6.0, 0) and loaded > 0
    (own,) = tmp_path.glob("groma-*")
    assert os.environ["NUMBA_CACHE_DIR"] == str(own) and own.stat().st_mode & 0o077 == 0 and _files(own)
    ((call, options),) = ends
    call[0](*call[1:], **options)
    assert not own.exists()


def test_where_nothing_can_be_written_all_still_runs(fresh, monkeypatch):
    for locator in (caching.InTreeCacheLocator, caching.UserWideCacheLocator):
        monkeypatch.setattr(locator, "ensure_cache_path", _refuse)
    monkeypatch.setattr(kernel_folder, "_own", None)
    monkeypatch.setattr(kernel_folder.tempfile, "mkdtemp", _refuse)
    assert fresh() == (6.0, 0, 0, 0)
    assert kernel_cache.folder() is None


def test_a_full_disk_costs_time_only(fresh, monkeypatch, tmp_path):
    monkeypatch.setattr(kernel_cache.os, "replace", _refuse)
    result, compiled, _, unsaved = fresh()
    assert (result, compiled) == (6.0, 0)
    assert unsaved > 0
    assert not list(tmp_path.rglob("*.tmp"))


def _refuse(*_, **__):
    raise OSError("read-only file system")


def _start(cache: Path, **environment: str) -> subprocess.Popen:
    inherited = {**os.environ, "NUMBA_CACHE_DIR": str(cache), **environment}
    return subprocess.Popen([sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True, env=inherited)


def _finish(process: subprocess.Popen) -> tuple[str, int]:
    output = process.communicate(timeout=300)[0]
    assert process.returncode == 0
    numbers, counts = (line.split(maxsplit=1)[1] for line in output.splitlines() if line[:1] in "NC")
    return numbers, int(counts.split()[0])


def test_four_processes_at_once_then_another_processor(tmp_path):
    first = [_finish(process) for process in [_start(tmp_path) for _ in range(4)]]
    assert len({numbers for numbers, _ in first}) == 1
    assert any(compiled for _, compiled in first)
    assert not list(tmp_path.rglob("*.tmp"))
    # a fifth finds everything, and the same numbers
    assert _finish(_start(tmp_path)) == (first[0][0], 0)
    # another processor compiles for itself, and does not disturb the first
    assert _finish(_start(tmp_path, NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES=""))[1] > 0
    assert _finish(_start(tmp_path)) == (first[0][0], 0)


ONE_PIXEL_EACH = """
import numpy as np
from groma import cameras
from groma._kernels.cache import counts
for name, params in (("PINHOLE", [500, 480, 320, 240]), ("RADIAL", [500, 320, 240, -0.1, 0.02])):
    before = counts.compiled
    pixel = cameras.model(name).project(np.array(params, dtype=float), np.array([[1.0, 2.0, 4.0]]))
    print(name, *pixel[0], counts.compiled - before)
"""


def test_an_edited_camera_model_of_groma(tmp_path):
    """On a copy of the sources."""
    shutil.copytree(Path(groma.__file__).parent, tmp_path / "groma", ignore=shutil.ignore_patterns("__pycache__"))
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def run():
        output = subprocess.check_output(
            [sys.executable, "-c", ONE_PIXEL_EACH], text=True, env=environment, cwd=tmp_path
        )
        return [line.split() for line in output.splitlines()]

    first, again = run(), run()
    assert again == [[*line[:3], "0"] for line in first]
    path = tmp_path / "groma" / "cameras" / "radial.py"
    text = path.read_text()
    path.write_text(text.replace("scale * x + cx, ", "scale * x + cx + 7.0, "))
    edited = run()
    assert edited[0] == again[0]
    assert float(edited[1][1]) == pytest.approx(float(again[1][1]) + 7.0)
    assert int(edited[1][3]) > 0
