# SPDX-License-Identifier: BSD-3-Clause
"""A map whose run ends early goes on: stages, locks, full disks, kills at every kind of moment."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import _comparison as compare
import cv2
import numpy as np
import pytest

from groma.cli.main import run
from groma.errors import InputError, OutputError
from groma.execution import work_with
from groma.io import read_scene
from groma.io.colmap.sfm import PointModelOptions, reconstruct_points
from groma.mapping import map as mapping
from groma.mapping.checkpoint_files import SCENE, FileKind
from groma.mapping.checkpoints import Stages, digest, has_stages, remove_stages, stage
from groma.mapping.map import MapOptions
from groma.mapping.point_base import adjust_with_survey
from groma.mapping.read_rows import adjust_as_measured, adjust_read_rows

posix = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX systems")


def test_stages_are_made_once_and_again_when_something_before_them_changes(tmp_path, model):
    made = []

    def make(name, depends=lambda options: None):
        return stage(name, SCENE, depends)(lambda scene, options, say: made.append(name) or scene)

    for options in (1, 1, 2, 1):
        with Stages(tmp_path / "work", digest("input"), options) as stages:
            assert compare.equal(stages.run(make("a"), model), model)
            stages.run(make("b", lambda options: options), model)
            stages.run(make("c"), model)
    assert made == ["a", "b", "c", "b", "c", "b", "c"]
    with Stages(tmp_path / "work", digest("other input"), 1) as stages:
        stages.run(make("a"), model)
    assert made[7:] == ["a"]
    (damaged,) = (tmp_path / "work").glob("a-*.npz")
    damaged.write_bytes(b"PK")
    with Stages(tmp_path / "work", digest("other input"), 1) as stages:
        assert compare.equal(stages.run(make("a"), model), model)
    assert made[7:] == ["a", "a"]


@pytest.mark.parametrize(
    ("kept", "option"),
    [
        (adjust_read_rows, {"rolling_shutter": "columns"}),
        (adjust_read_rows, {"refine_poses": False}),
        (adjust_read_rows, {"refine_intrinsics": True}),
        (adjust_read_rows, {"refine_rigs": True}),
        (adjust_read_rows, {"max_iterations": 5}),
        (adjust_with_survey, {"keep_suspects": True}),
        (adjust_as_measured, {"min_confidence": 0.0}),
    ],
)
def test_a_stage_is_made_again_where_an_option_of_its_own_has_changed(kept, option):
    assert kept.depends(MapOptions()) != kept.depends(MapOptions(**option))


def test_objects_are_told_apart_by_what_they_hold():
    """A detector of another package need not be a dataclass; its address says nothing, and may come again."""

    class Detector:
        def __init__(self, length):
            self.length, self.network = length, object()

    assert digest(Detector(12.0)) == digest(Detector(12.0)) != digest(Detector(20.0))


@pytest.mark.parametrize("workers", [1, 2])
def test_two_stages_beside_each_other_are_kept_like_two_after_each_other(tmp_path, model, workers):
    """Whatever the number of threads; and where the one fails, the other is left at its next step."""
    made, steps = [], []

    def other(scene, options, say):
        made.append("other")
        while "fails" in options:
            steps.append(say("other", 0, 1))
        return scene

    def main(scene, options, say):
        made.append("main")
        if "fails" in options:
            raise InputError("as it was to be")
        return scene

    first, second = stage("other", SCENE)(other), stage("main", SCENE)(main)
    for _ in range(2):
        with work_with(workers), Stages(tmp_path / "work", "key", "usual") as stages:
            assert all(
                compare.equal(found, model) for found in stages.run_beside("other", (first, model), second, model)
            )
    with Stages(tmp_path / "work", "key", "usual") as stages:
        stages.run(first, model)
        stages.run(second, model)
    assert sorted(made) == ["main", "other"]
    if workers > 1:
        with (
            work_with(workers),
            Stages(tmp_path / "else", "key", "fails") as stages,
            pytest.raises(InputError, match="as it was to be"),
        ):
            stages.run_beside("other", (first, model), second, model)
        assert not has_stages(tmp_path / "else")


def test_two_runs_in_one_folder_are_refused(tmp_path):
    with Stages(tmp_path / "work", "key", None):
        with (
            pytest.raises(OutputError, match=rf"Another run \(process {os.getpid()}\) works in"),
            Stages(tmp_path / "work", "key", None),
        ):
            pass
        remove_stages(tmp_path / "work")
        assert (tmp_path / "work").exists()
    with Stages(tmp_path / "work", "key", None):
        pass
    assert not has_stages(tmp_path / "work")
    remove_stages(tmp_path / "work")
    assert not (tmp_path / "work").exists()


def test_the_lock_is_found_before_anything_is_said(tmp_path, corner, monkeypatch, capsys):
    images, _ = corner
    monkeypatch.chdir(tmp_path)
    command = ["map", str(images), "-o", "out", "--model", str(images.parent / "model.npz")]
    with Stages(tmp_path / "out.work", "key", None):
        (tmp_path / "out.work" / "points-0123456789ab.npz").write_text("of the other run")
        assert run(command) == 1
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    assert said.err.startswith(f"groma: Another run (process {os.getpid()}) works in out.work. Wait")


def test_a_place_that_cannot_be_written_is_said(tmp_path, model):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="Cannot keep finished stages in"), Stages(tmp_path / "file", "key", None):
        pass

    def full(scene, path):
        raise OSError(28, "No space left on device")

    with (
        Stages(tmp_path / "work", "key", None) as stages,
        pytest.raises(OutputError, match=r"No space left.*Make room"),
    ):
        stages.run(stage("points", FileKind(full, SCENE.read))(lambda *_: model))


def test_a_full_disk_ends_the_command_in_one_line_and_loses_nothing(tmp_path, corner, monkeypatch, capsys):
    images, _ = corner
    monkeypatch.chdir(tmp_path)
    command = ["map", str(images), "-o", "out", "--threads", "1"]
    usage = shutil.disk_usage(tmp_path)
    with monkeypatch.context() as patch:  # before points are looked for
        patch.setattr(shutil, "disk_usage", lambda folder: usage._replace(free=9 << 20))
        assert run(command) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "9 MiB left; the points of the images need 16 MiB. Make room" in error

    def full(*_, **__):
        raise OSError(28, "No space left on device", "a draft")

    command += ["--model", str(images.parent / "model.npz"), "--no-planes"]
    with monkeypatch.context() as patch:  # while the results are written
        patch.setattr("groma.mapping.result.write_report", full)
        assert run(command) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "Cannot write out: No space left on device. Finished stages are kept in out.work: the same" in error
    assert not Path("out").exists() and has_stages(Path("out.work"))
    monkeypatch.setattr(mapping, "detect_segments", lambda *arguments: pytest.fail("segments were searched again"))
    assert run(command) == 0
    assert capsys.readouterr().out.startswith("Resuming from the finished stages in out.work")
    assert os.listdir(tmp_path) == ["out"]


def test_a_damaged_database_of_points_is_made_again(tmp_path, corner):
    """Here with images of which no two show the same: what is said is that of a fresh run."""
    _, scene = corner
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "database.db").write_bytes(b"no database" * 999)
    rng = np.random.default_rng(0)
    for name in scene.images.names:
        cv2.imwrite(str(tmp_path / name), cv2.GaussianBlur(rng.integers(0, 255, (90, 120), dtype=np.uint8), None, 2.0))
    with pytest.raises(InputError, match=r"[1-9]\d* points were found in them and 0 matches.*overlap too little"):
        reconstruct_points(tmp_path, tmp_path / "work", scene.images.names, PointModelOptions(threads=1))


#: Maps, and kills itself at an event: a stage of the progress, with how much of it is done, or a finished file of a
#: stage just before or just after it gets its name. Says which.
KILLED = """
import os, signal, sys
from groma.io import read_scene, write_scene
from groma.mapping.map import map_images
from groma.mapping.options import MapOptions

def mapped(images, model, work, out, when):
    def event(*what):
        if " ".join(map(str, what)) == when:
            os.kill(os.getpid(), signal.SIGKILL)

    def renamed(source, target):
        name = os.path.basename(str(target)).rpartition("-")[0] if str(target).startswith(work) else ""
        event("before", name)
        replace(source, target)
        event("after", name)

    replace, os.replace = os.replace, renamed
    scene = None if model == "none" else read_scene(model)
    result = map_images(images, work, scene, MapOptions(threads=1), lambda s, n, m: event(s, n))
    os.replace = replace
    write_scene(result.scene, out)

if len(sys.argv) == 6:
    mapped(*sys.argv[1:])
    sys.exit()
for line in sys.stdin:  # what is told, each in a process of its own that has everything imported
    child = os.fork()
    if not child:
        mapped(*sys.argv[1:], *line.rstrip().split(","))
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@posix
def test_a_run_killed_at_every_kind_of_moment_ends_like_an_undisturbed_one(tmp_path, corner):
    images, _ = corner
    work = tmp_path / "work"
    moments = {
        "before points": {"model"},
        "finding segments 2": {"model", "points"},
        "after lines": {"model", "points", "segments", "lines"},
        "before structure": {"model", "points", "segments", "lines", "joint", "final-lines"},
        "after adjusted": {"model", "points", "segments", "lines", "joint", "final-lines", "structure", "adjusted"},
    }
    command = [sys.executable, "-c", KILLED, str(images), str(images.parent / "model.npz")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1) as process:
        assert process.stdin is not None and process.stdout is not None

        def ended(folder, when):
            process.stdin.write(f"{folder},{folder}.npz,{when}\n")
            return int(process.stdout.readline())

        assert ended(tmp_path / "calm", "never") == 0
        for when, kept in moments.items():
            assert ended(work, when) == -signal.SIGKILL, when
            assert {path.name.rpartition("-")[0] for path in work.glob("[!.]*.npz")} == kept, when
        assert ended(work, "never") == 0
        process.stdin.close()
    assert not list(work.glob(".*"))  # what killed runs left half written
    assert (tmp_path / "work.npz").read_bytes() == (tmp_path / "calm.npz").read_bytes()
    assert read_scene(tmp_path / "work.npz").num_lines > 20


@posix
@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("given", [True, False], ids=["model", "no model"])
def test_a_run_killed_again_and_again_ends_like_an_undisturbed_one(tmp_path, corner, given):
    """Killed at any time, while pycolmap works and while functions are compiled, whose cache begins empty."""
    images, _ = corner
    model = str(images.parent / "model.npz") if given else "none"
    arguments = [sys.executable, "-c", KILLED, str(images), model]
    subprocess.run([*arguments, str(tmp_path / "calm"), str(tmp_path / "calm.npz"), "never"], check=True)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    rng, patience, kills = np.random.default_rng(3), 4.0, 0
    while True:
        process = subprocess.Popen(
            [*arguments, str(tmp_path / "work"), str(tmp_path / "out.npz"), "never"], env=environment
        )
        try:
            assert process.wait(rng.uniform(1.0, patience)) == 0
            break
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        kills += 1
        patience *= 1.1  # one function may take long to compile
    assert kills >= 3
    assert (tmp_path / "out.npz").read_bytes() == (tmp_path / "calm.npz").read_bytes()
    assert read_scene(tmp_path / "out.npz").num_lines > 20
