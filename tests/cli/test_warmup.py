# SPDX-License-Identifier: BSD-3-Clause
"""``groma warmup``: it runs what is not there, says so when all is, and notices what was removed.

The runs themselves are replaced by one small loop; that they compile what the commands use is a slow test.
"""

import json
import os
import subprocess
import sys

import numba
import numpy as np
import pytest

from groma import cameras
from groma._kernels import cache as kernel_cache
from groma.cli.main import run
from groma.compilation import runs as _warmup_runs
from groma.compilation import warmup as _warmup
from groma.factors.contract import registered

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")


@pytest.fixture
def made(monkeypatch, tmp_path):
    """Names of the runs that were made, in a cache folder of their own."""
    names = []

    def steps(part):
        def work():
            names.append(part)
            cameras.model("PINHOLE").project(np.array([500.0, 500, 320, 240]), np.array([[0.0, 0, 1]]))

        yield "one", work

    monkeypatch.setattr(kernel_cache, "folder", lambda: tmp_path)
    monkeypatch.setattr(_warmup_runs, "RUNS", {part: lambda part=part: steps(part) for part in _warmup.PARTS})
    return names


def test_the_second_call_finds_everything(made, capsys):
    assert run(["warmup"]) == 0
    assert made == ["adjust", "map", "track"]
    assert "Compiled" in capsys.readouterr().out
    assert run(["warmup"]) == 0
    assert len(made) == 3
    assert "Everything is there" in capsys.readouterr().out
    assert run(["warmup", "--again", "map"]) == 0
    assert made[3:] == ["map"]


def test_one_part_is_made_alone(made, tmp_path):
    target = tmp_path / "report.json"
    assert run(["warmup", "track", "--json", str(target)]) == 0
    assert made == ["track"]
    report = json.loads(target.read_text())
    assert report["parts"] == ["track"]
    assert set(report) >= {"compiled", "loaded", "unsaved", "seconds", "folder"}


def test_a_removed_file_is_noticed(made, monkeypatch, tmp_path):
    kept = tmp_path / "compiled.nbc"
    kept.write_bytes(b"")
    monkeypatch.setattr(kernel_cache, "used_files", lambda: [kept])
    assert run(["warmup", "map"]) == 0
    assert run(["warmup", "map"]) == 0
    assert made == ["map"]
    kept.unlink()
    assert run(["warmup", "map"]) == 0
    assert made == ["map", "map"]


def test_another_version_is_not_ready(made, monkeypatch):
    assert run(["warmup", "map"]) == 0
    monkeypatch.setattr(kernel_cache, "source_stamp", lambda: "another version")
    assert not _warmup.is_ready("map")


def test_where_nothing_is_kept_it_says_so(made, monkeypatch, capsys):
    monkeypatch.setattr(kernel_cache, "folder", lambda: None)
    assert run(["warmup", "map"]) == 1
    assert "NUMBA_CACHE_DIR" in capsys.readouterr().err
    assert not made


def test_an_unknown_part_is_refused(made, capsys):
    assert run(["warmup", "everything"]) == 1
    assert "adjust, map, track" in capsys.readouterr().err


def test_the_models_and_factors_that_are_compiled_for_exist():
    assert set(_warmup_runs.HELD) | set(_warmup_runs.ESTIMATED) <= {model.name for model in cameras.models()}
    assert set(_warmup_runs.TRACK_FACTORS) <= set(registered())


COMMAND_AFTER = """
import sys
from groma.cli.main import run
from groma._kernels.cache import counts
assert run(sys.argv[1:]) == 0
print("COMPILED", counts.compiled)
"""


@pytest.mark.slow
def test_afterwards_commands_compile_nothing(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def start(*words):
        return subprocess.run(
            [sys.executable, "-W", "ignore", *words], capture_output=True, text=True, check=True, env=environment
        ).stdout

    start("-m", "groma.cli.main", "warmup")
    for command in (["synth", "-n", "12", "-o", "scene"], ["adjust", "scene/start.npz"], ["demo", "-o", "demo"]):
        words = [str(tmp_path / word) if word.startswith(("scene", "demo")) and word != command[0] else word
                 for word in command]  # fmt: skip
        assert start("-c", COMMAND_AFTER, *words).splitlines()[-1] == "COMPILED 0", command
