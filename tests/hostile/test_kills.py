# SPDX-License-Identifier: BSD-3-Clause
"""Commands killed at random moments, and on a full disk: outputs are whole or absent, and the same command goes on.

A full disk is a bound on the size of files, which every library meets in the same way: a write that fails.
"""

import importlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from random import Random

import cv2
import numpy as np
import pytest
from _facade import facade

from groma.io import read_scene, write_scene
from groma.io.trajectories import read_tum
from groma.scene import synthetic

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX systems")

sys.path.insert(0, str(Path(__file__).parents[1] / "tracking"))
_room = importlib.import_module("_room")
CAMERA = f"{_room.FOCAL} {_room.FOCAL} {_room.WIDTH / 2 - 0.5} {_room.HEIGHT / 2 - 0.5}"


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> Callable[[str], list[str]]:
    """Return the inputs of a command, made when they are first asked for."""
    folder = tmp_path_factory.mktemp("inputs")

    @cache
    def inputs(command: str) -> list[str]:
        if command == "adjust":
            write_scene(synthetic.holistic(6, seed=0).start.points_only(), folder / "start.npz")
            return [str(folder / "start.npz")]
        if command == "map":
            write_scene(facade(folder / "photographs", 4), folder / "model.npz")
            return [str(folder / "photographs"), "--model", str(folder / "model.npz")]
        for kind in ("rgb", "depth"):
            (folder / "room" / kind).mkdir(parents=True)
        for k, frame in enumerate(_room.frames("rgbd", _room.poses(8))):
            for kind, image in (("rgb", frame.gray), ("depth", np.round(frame.depth * 5000).astype(np.uint16))):
                cv2.imwrite(str(folder / "room" / kind / f"{k:04d}.png"), image)
                with (folder / "room" / f"{kind}.txt").open("a") as file:
                    file.write(f"{frame.timestamp:.6f} {kind}/{k:04d}.png\n")
        return [str(folder / "room"), "--camera", CAMERA]

    return inputs


def arguments(command: str, given: Callable[[str], list[str]], output: Path) -> list[str]:
    return [sys.executable, "-m", "groma", command, *given(command), "-o", str(output)]


def check_whole(command: str, output: Path) -> None:
    """Read everything that the command writes; a track that is interrupted writes what there is."""
    assert read_scene(output).num_images >= 1
    if command in ("map", "track"):
        assert read_scene(output / "scene.npz").num_images >= 1
        json.loads((output / "summary.json").read_text())
        assert (output / "report.html").read_text().rstrip().endswith("</html>")
    if command == "track":
        assert len(read_tum(output / "trajectory.txt")) >= 1


def kill_and_go_on(command: str, given: Callable[[str], list[str]], home: Path, kills: int, seed: int) -> None:
    rng = Random(f"{command} {seed}")
    output = home / "out"
    for _ in range(kills):
        process = subprocess.Popen(
            arguments(command, given, output), cwd=home, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        with suppress(subprocess.TimeoutExpired):  # where it ends before, nobody waits
            process.wait(rng.uniform(0.3, 7.0))
        process.send_signal(rng.choice((signal.SIGKILL, signal.SIGTERM, signal.SIGINT)))
        said = process.communicate(timeout=120)[1]
        assert process.returncode in (0, 130, -signal.SIGKILL), said
        assert "Traceback" not in said and said.count("\n") <= 2, said
        if output.exists():
            check_whole(command, output)
            shutil.rmtree(output)
    finished = subprocess.run(arguments(command, given, output), cwd=home, capture_output=True, text=True, timeout=300)
    assert finished.returncode == 0, finished.stderr
    check_whole(command, output)
    assert not (home / "out.work").exists()


# Killed at chosen moments in tests/mapping and tests/tracking.
LONGER = [pytest.param(name, marks=pytest.mark.slow) for name in ("map", "track")]


@pytest.mark.parametrize("command", ["adjust", *LONGER])
def test_killed_at_random_moments(command, given, tmp_path):
    kill_and_go_on(command, given, tmp_path, kills=2, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("command", ["adjust", "map", "track"])
def test_killed_at_many_random_moments(command, given, tmp_path, seed):
    kill_and_go_on(command, given, tmp_path, kills=5, seed=seed + 1)


@pytest.mark.parametrize(
    ("command", "sizes"),
    [
        ("adjust", (900,)),
        pytest.param("adjust", (100, 4000), marks=pytest.mark.slow),
        pytest.param("map", (100, 20_000), marks=pytest.mark.slow),
        pytest.param("track", (100, 20_000), marks=pytest.mark.slow),
    ],
)
def test_a_full_disk(command, sizes, given, tmp_path):
    """One line, exit code 1, nothing published; then, with room, the command succeeds."""
    for size in sizes:
        finished = subprocess.run(
            arguments(command, given, tmp_path / "out"),
            cwd=tmp_path, capture_output=True, text=True, timeout=300,
            preexec_fn=lambda size=size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)),
        )  # fmt: skip
        assert finished.returncode == 1, finished.stderr
        # Before it come warnings and, on a slow machine, lines of progress.
        errors = [line for line in finished.stderr.splitlines() if line.startswith("groma: ")]
        assert len(errors) == 1 and finished.stderr.splitlines()[-1:] == errors, finished.stderr
        assert "Traceback" not in finished.stderr
        assert not (tmp_path / "out").exists()
    finished = subprocess.run(arguments(command, given, tmp_path / "out"), cwd=tmp_path, timeout=300)
    assert finished.returncode == 0
    check_whole(command, tmp_path / "out")
