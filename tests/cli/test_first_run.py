# SPDX-License-Identifier: BSD-3-Clause
"""The first run of a command: what it needs is known, processes beside it compile that, and it says so once."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numba
import pytest

import groma
from groma._kernels import cache as kernel_cache
from groma._kernels.cache import Counts
from groma.cli.main import run
from groma.compilation import ahead, needed
from groma.scene import synthetic

RECORDER = Path(__file__).resolve().parents[2] / "packaging" / "needed_functions.py"
pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")


@pytest.mark.parametrize("work", needed.works())
def test_what_is_listed_exists(work):
    """After a function was renamed, or its arguments changed: python packaging/needed_functions.py."""
    entries = needed.needed(work)
    assert needed.imported(work) is not None
    assert len(entries) > 10
    for module, name, kinds in entries:
        compiled = needed.function(module, name)
        assert compiled is not None, f"{module}.{name}"
        assert compiled.py_func.__code__.co_argcount == len(kinds), f"{module}.{name}"


def test_the_list_is_what_an_adjustment_calls():
    """Most of it: what is not listed is compiled when it is called."""
    call = [sys.executable, "-W", "ignore", RECORDER, "adjust"]
    said = subprocess.run(call, capture_output=True, text=True)
    if said.returncode:  # it had to compile
        said = subprocess.run(call, capture_output=True, text=True, check=True)
    called = {(module, name, tuple(kinds)) for module, name, kinds in json.loads(said.stdout.splitlines()[-1])}
    listed = {(module, name, tuple(map(repr, kinds))) for module, name, kinds in needed.needed("adjust")}
    assert len(called & listed) >= 0.9 * len(listed)
    assert len(called & listed) >= 0.9 * len([entry for entry in called if "_all" in entry[1]])


@pytest.mark.parametrize("is_estimated", [False, True])
def test_points_alone_have_a_list_of_their_own(is_estimated):
    """It names what that camera model calls, and no more; what is mixed or not listed has the list of everything."""
    work = needed.adjusting(("PINHOLE", "PINHOLE"), is_estimated, True)
    assert work == needed.points_of("PINHOLE", is_estimated) and work in needed.works()
    modules = {module.rpartition(".")[2] for module, *_ in needed.needed(work)}
    assert "point_reprojection" in modules
    assert not modules & {"line_reprojection", "line_cartesian", "plane_normal_offset", "point_on_plane"}
    assert len(needed.needed(work)) < 0.85 * len(needed.needed("adjust"))
    assert needed.adjusting(("PINHOLE",), is_estimated, False) == "adjust"
    assert needed.adjusting(("PINHOLE", "OPENCV"), is_estimated, True) == "adjust"
    assert needed.adjusting(("A_MODEL_OF_A_PLUGIN",), is_estimated, True) == "adjust"


def test_the_command_expects_what_its_scene_needs(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(ahead, "expect", lambda work, *more: asked.append(work))
    scene = synthetic.holistic(4, seed=2).start
    for name, content in (("all", scene), ("points", scene.points_only())):
        groma.write_scene(content, tmp_path / f"{name}.npz")
        assert run(["adjust", str(tmp_path / f"{name}.npz"), "--max-iterations", "1", "--quiet"]) == 0
    call = ["adjust", str(tmp_path / "points.npz"), "--max-iterations", "1", "--quiet", "--refine-intrinsics"]
    assert run(call) == 0
    model = scene.cameras.models[0]
    assert asked == ["adjust", needed.points_of(model, False), needed.points_of(model, True)]


def test_types_are_read_as_numba_writes_them():
    kinds = [
        numba.float64[:, ::1],
        numba.types.UniTuple(numba.int64, 3),
        numba.boolean,
        numba.int32[:],
        numba.types.none,
    ]
    assert [needed.read_type(repr(kind)) for kind in kinds] == kinds


@pytest.fixture
def started(monkeypatch):
    """Processes that would be started."""
    calls = []
    monkeypatch.setattr(ahead.Ahead, "_start", lambda self, count: calls.append((self._work, count)))
    monkeypatch.setenv(ahead.VARIABLE, "3")
    return calls


@pytest.mark.parametrize("can_fork", [True, False])
def test_processes_start_once_more_is_missing_than_there(started, monkeypatch, can_fork):
    monkeypatch.setattr(ahead, "CAN_FORK", can_fork)
    said = []
    expected = ahead.Ahead("adjust", lambda: said.append("compiling"))
    expected(Counts(missed=1, loaded=5))
    assert not said and not started
    expected(Counts(missed=6, loaded=5))
    expected(Counts(missed=7, loaded=5))
    assert said == ["compiling"] and started == ([("adjust", 3)] if can_fork else [("adjust", 1)] * 3)


@pytest.mark.skipif(not ahead.CAN_FORK, reason="processes are not begun before something is missing")
@pytest.mark.parametrize("is_empty", [True, False])
def test_processes_begin_at_once_where_nothing_was_ever_compiled(started, monkeypatch, tmp_path, is_empty):
    monkeypatch.setattr(ahead, "_expected", [])
    monkeypatch.setattr(kernel_cache, "on_miss", [])
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.delenv("NUMBA_DISABLE_JIT", raising=False)
    if not is_empty:
        (tmp_path / "module").mkdir()
        (tmp_path / "module" / f"function{kernel_cache._SUFFIX}").touch()
    said = []
    ahead.begin("map", lambda: said.append("compiling"))
    assert len(said) == len(started) == is_empty
    ahead.expect("map", lambda: said.append("compiling"))
    for missed in (1, 2):
        kernel_cache.on_miss[0](Counts(missed=missed))
    assert said == ["compiling"] and started == [("map", 3)]
    ahead.expect("adjust", lambda: said.append("compiling"))
    assert [one._work for one in kernel_cache.on_miss] == ["adjust"]
    ahead.end()
    assert not kernel_cache.on_miss


@pytest.mark.parametrize(("threads", "count"), [(1, 0), (2, 2), (None, 2), (5, 2)])
def test_as_many_processes_as_cores(monkeypatch, threads, count):
    monkeypatch.delenv(ahead.VARIABLE, raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    assert ahead._count(threads) == count


def test_nothing_is_said_before_arguments_are_checked(tmp_path, capsys, started):
    assert run(["localize", str(tmp_path / "nowhere"), str(tmp_path), "-o", str(tmp_path / "out")]) == 1
    assert run(["adjust", str(tmp_path / "nowhere.npz")]) == 1
    assert "compiling" not in capsys.readouterr().out
    assert not started


COMPILE_AHEAD = """
import sys
import time
from pathlib import Path
from groma._kernels.cache import counts
from groma.compilation import needed
from groma.compilation.ahead import compile_ahead
needed.PLACE = Path(sys.argv[1])
compile_ahead("few")
print(counts.compiled)
"""


def test_what_is_listed_is_compiled_once(tmp_path):
    module, name, kinds = next(entry for entry in needed.needed("adjust") if entry[0] == "groma.problem.sorting")
    listed = {"modules": [module], "types": list(map(repr, kinds))}
    listed["work"] = {"few": [[0, "a_function_of_before", []], [0, name, list(range(len(kinds)))]]}
    (tmp_path / "needed.json").write_text(json.dumps(listed))
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    call = [sys.executable, "-c", COMPILE_AHEAD, str(tmp_path / "needed.json")]
    found = [subprocess.run(call, capture_output=True, text=True, check=True, env=environment) for _ in range(2)]
    assert int(found[0].stdout) >= 1
    assert int(found[1].stdout) == 0


@pytest.mark.skipif(not ahead.CAN_FORK, reason="processes are not forked")
@pytest.mark.parametrize("ends", ["after a moment", "at once"])
def test_all_processes_end_with_the_command(tmp_path, ends):
    """The one that was started and the one that it has forked: nothing of their group is left."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    call = [sys.executable, "-W", "ignore", "-m", "groma.compilation.ahead", "pose graph", "2"]
    with subprocess.Popen(call, stdin=subprocess.PIPE, env=environment, start_new_session=True) as process:
        assert process.stdin is not None
        while ends != "at once" and not list(tmp_path.rglob("*.nbc")):
            assert process.poll() is None
            time.sleep(0.05)
        process.stdin.close()
        assert process.wait() == 0
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
    assert not list(tmp_path.rglob("*.tmp"))


@pytest.mark.slow
def test_a_first_adjustment_is_compiled_by_several_processes(tmp_path):
    """The result is that of one process, and no unfinished file stays behind."""
    groma.write_scene(synthetic.holistic(4, seed=2).start.points_only(), tmp_path / "start.npz")
    results = []
    for count in ("0", "2"):
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / count), ahead.VARIABLE: count}
        call = [sys.executable, "-m", "groma", "adjust", "start.npz", "-o", f"{count}.npz", "--max-iterations", "3"]
        said = subprocess.run(call, capture_output=True, text=True, check=True, env=environment, cwd=tmp_path)
        assert said.stdout.count("First run: compiling") == 1
        results.append(groma.read_scene(tmp_path / f"{count}.npz"))
        assert not list((tmp_path / count).rglob("*.tmp"))
    assert results[0].cam_from_world.tobytes() == results[1].cam_from_world.tobytes()
