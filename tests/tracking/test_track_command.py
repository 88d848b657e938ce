# SPDX-License-Identifier: BSD-3-Clause
"""``groma track`` on a small rendered sequence in the layout of TUM RGB-D: what it writes, and what it refuses."""

import errno
import json
import os
import re
import signal
import subprocess
import sys

import _room
import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import groma
from groma.cli.app import app
from groma.errors import OutputError
from groma.io import read_scene
from groma.io.trajectories import read_tum
from groma.tracking import Tracker, TrackOptions
from groma.tracking.journal import Journal
from groma.tracking.saved import FrameSource


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    (folder / "rgb").mkdir()
    (folder / "depth").mkdir()
    lists = {"rgb": [], "depth": []}
    for k, frame in enumerate(_room.frames("rgbd", _room.poses(16))):
        images = {"rgb": frame.gray, "depth": np.round(frame.depth * 5000).astype(np.uint16)}
        for kind, image in images.items():
            name = f"{kind}/{k:04d}.png"
            cv2.imwrite(str(folder / name), image)
            lists[kind].append(f"{frame.timestamp:.6f} {name}\n")
    for kind, rows in lists.items():
        (folder / f"{kind}.txt").write_text("# time file\n" + "".join(rows))
    return folder


# As OpenCV counts pixels, from the centre of the first one.
CAMERA = f"{_room.FOCAL} {_room.FOCAL} {_room.WIDTH / 2 - 0.5} {_room.HEIGHT / 2 - 0.5}"


def _run(*arguments):
    return CliRunner().invoke(app, ["track", *map(str, arguments)])


#: The same as COLMAP counts them, from the corner of the first one.
AS_COLMAP = ("SIMPLE_PINHOLE", f"{_room.FOCAL},{_room.WIDTH / 2},{_room.HEIGHT / 2}")


def test_what_it_writes(sequence, tmp_path):
    out = tmp_path / "out"
    result = _run(sequence, "-o", out, "--camera", CAMERA, "--json", tmp_path / "numbers.json")
    assert result.exit_code == 0, result.output
    assert "frames tracked      16" in result.output
    trajectory = read_tum(out / "trajectory.txt")
    assert len(trajectory) == 16
    assert _room.position_error(trajectory, _room.poses(16)) < 0.01
    for scene in (read_scene(out), read_scene(out / "scene.npz")):
        assert scene.num_images >= 2
        assert scene.num_lines > 0
    assert re.findall(r"^ *points +([\d,]+)", result.output, re.MULTILINE) == [f"{scene.num_points:,}"]
    page = (out / "report.html").read_text()
    assert "<html" in page.lower()
    assert "Path from above" in page
    for path in (out / "summary.json", tmp_path / "numbers.json"):
        numbers = json.loads(path.read_text())
        assert numbers["frames"] == {"tracked": 16}
        assert numbers["kind"] == "rgbd"
        written = [scene.num_points, scene.num_lines, scene.num_planes]
        assert [numbers[kind] for kind in ("points", "lines", "planes")] == written
    assert not (tmp_path / "out.work").exists()
    again = _run(sequence, "-o", out, "--camera", CAMERA)
    assert again.exit_code == 1
    assert "--force" in again.output


def test_less_of_it(sequence, tmp_path):
    result = _run(sequence, "-o", tmp_path / "few", "--camera", CAMERA, "--max-frames", 4, "--no-lines", "--no-planes")
    assert result.exit_code == 0, result.output
    numbers = json.loads((tmp_path / "few" / "summary.json").read_text())
    assert numbers["lines"] == numbers["planes"] == 0
    assert numbers["frames"] == {"tracked": 4}


@pytest.mark.parametrize(
    ("arguments", "word"),
    [(["--kind", "sonar"], "rgbd, stereo or mono"), (["--no-points", "--no-lines", "--no-planes"], "Nothing to track")],
)
def test_what_it_refuses(sequence, tmp_path, arguments, word):
    result = _run(sequence, "-o", tmp_path / "no", "--camera", CAMERA, *arguments)
    assert result.exit_code == 1
    assert word in result.output
    assert not (tmp_path / "no").exists()


def test_nothing_tracked_is_said_in_one_line(sequence, tmp_path):
    result = _run(sequence, "-o", tmp_path / "still", "--camera", CAMERA, "--kind", "mono", "--max-frames", 1)
    assert result.exit_code == 1
    assert "No frame of" in result.output
    assert "depth scale" not in result.output  # one camera has none
    assert not (tmp_path / "still").exists()


def test_finished_keyframes_are_on_disk_while_it_runs(tmp_path):
    tracker = Tracker(_room.camera(), TrackOptions(num_points=250, num_features=500))
    journal = Journal(tmp_path / "work")
    chosen = 0
    for frame in _room.frames("rgbd", _room.poses(14)):
        tracked = tracker.process(frame)
        if tracked.keyframe:
            chosen += 1
            journal.keyframe(tracker, tracked)
            assert len(read_tum(tmp_path / "work" / "keyframes.txt")) == chosen
    assert chosen >= 2
    assert read_scene(tmp_path / "work" / "scene.npz").num_images >= 1
    assert len(read_tum(tmp_path / "work" / "trajectory.txt")) >= 1
    journal.begin_anew()
    assert [path.name for path in (tmp_path / "work").iterdir()] == ["lock"]
    journal.close()
    tracker.finish()


def test_a_track_goes_on_where_nothing_can_be_kept(sequence, tmp_path, monkeypatch):
    def full(*_given, **_options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("groma.tracking.journal.write_tum", full)
    result = _run(sequence, "-o", tmp_path / "out", "--camera", CAMERA, "--max-frames", 4)
    assert result.exit_code == 0, result.output
    assert "nothing was kept in" in result.output and os.strerror(errno.ENOSPC) in result.output
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 4


def test_two_runs_with_one_output_are_refused(sequence, tmp_path):
    """Before any frame is read, and not only when the second would write."""
    journal = Journal(tmp_path / "out.work")
    refused = _run(sequence, "-o", tmp_path / "out", "--camera", CAMERA)
    assert refused.exit_code == 1 and isinstance(refused.exception, OutputError | SystemExit)
    with pytest.raises(OutputError, match=rf"Another run \(process {os.getpid()}\) works in"):
        groma.track(groma.open_sequence(sequence, camera=CAMERA), work=tmp_path / "out.work")
    journal.close()
    assert not (tmp_path / "out").exists() and (tmp_path / "out.work").is_dir()


def _same_files(first, second):
    """Names of the files in two folders, after a look whether those that hold no times are equal byte by byte."""
    names = [{path.relative_to(folder) for path in folder.rglob("*") if path.is_file()} for folder in (first, second)]
    assert names[0] == names[1]
    for name in names[0]:
        if name.suffix not in (".html", ".json"):
            assert (first / name).read_bytes() == (second / name).read_bytes(), name
    return {name.as_posix() for name in names[0]}


def test_the_command_is_one_call(sequence, tmp_path):
    opened = groma.open_sequence(sequence, camera=CAMERA)
    events = []
    source = FrameSource.of(sequence, CAMERA)
    result = groma.track(opened, progress=events.append, work=tmp_path / "work", name=str(sequence), source=source)
    result.write(tmp_path / "called")
    assert _run(sequence, "-o", tmp_path / "commanded", "--camera", CAMERA).exit_code == 0
    assert "trajectory.txt" in _same_files(tmp_path / "called", tmp_path / "commanded")
    ours, theirs = (json.loads((tmp_path / name / "summary.json").read_text()) for name in ("called", "commanded"))
    times = ("milliseconds", "final_adjustment")
    assert list(ours) == list(theirs)
    assert all(ours[name] == theirs[name] for name in ours if name not in times)
    assert [event.done for event in events if event.frame] == list(range(1, 17)) and events[0].total == 16
    assert [event.frame for event in events if event.frame] == list(result.frames)
    assert len(read_tum(tmp_path / "work" / "keyframes.txt")) >= 1
    pages = [(tmp_path / name / "report.html").read_text() for name in ("called", "commanded")]
    assert "data:image/jpeg" not in pages[0] and pages[1].count("data:image/jpeg") >= 1  # the files are known there
    result.write(tmp_path / "pictured", images=opened.pictures)
    assert "data:image/jpeg" in (tmp_path / "pictured" / "report.html").read_text()
    with pytest.raises(OutputError, match="exists already"):
        result.write(tmp_path / "called")


@pytest.mark.parametrize("how", ["the callback returns False", "Ctrl-C"])
def test_a_track_that_is_ended_early_has_what_there_is(sequence, how):
    def stop(event):
        if event.done == 6 and how == "Ctrl-C":
            raise KeyboardInterrupt
        return event.done < 6

    result = groma.track(groma.open_sequence(sequence, camera=CAMERA), TrackOptions(lines=False), stop)
    assert result.interrupted and result.summary()["interrupted"]
    assert len(result.frames) == len(result.trajectory) == 6


def test_a_track_interrupted_before_its_first_pose_is_interrupted(sequence, tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Tracker, "process", interrupted)
    with pytest.raises(KeyboardInterrupt):
        groma.track(groma.open_sequence(sequence, camera=CAMERA))
    said = _run(sequence, "-o", tmp_path / "out", "--camera", CAMERA)
    assert said.exit_code == 130 and "interrupted" in said.output
    assert not (tmp_path / "out").exists()


#: ``groma track`` that kills itself in the middle of a frame.
KILLED = """
import os, signal, sys
from groma.cli.main import run
from groma.tracking import Tracker

process, done = Tracker.process, []

def dying(self, frame, following=None):
    if len(done) == 12:
        os.kill(os.getpid(), signal.SIGKILL)
    done.append(frame)
    return process(self, frame, following)

Tracker.process = dying
run(sys.argv[1:])
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX systems")
def test_a_track_killed_in_the_middle_leaves_what_is_finished(sequence, tmp_path):
    out = tmp_path / "out"
    arguments = ["track", str(sequence), "-o", str(out), "--camera", CAMERA, "--quiet"]
    killed = subprocess.run([sys.executable, "-c", KILLED, *arguments], timeout=300, capture_output=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert not out.exists()
    work = tmp_path / "out.work"
    assert len((work / "frames.txt").read_text().splitlines()) == 12
    assert len(read_tum(work / "keyframes.txt")) >= 1
    assert read_scene(work / "scene.npz").num_images >= 1
    # Another run begins anew, and cleans up.
    result = _run(sequence, "-o", out, "--camera", CAMERA)
    assert result.exit_code == 0, result.output
    assert len(read_tum(out / "trajectory.txt")) == 16
    assert not work.exists()


def test_the_camera_as_all_commands_take_it(sequence, tmp_path):
    """--camera-model and --camera-params, as of groma map, are the same camera as the numbers of OpenCV."""
    few = ["--max-frames", 4, "--no-lines", "--no-planes"]
    model, params = AS_COLMAP
    for name, camera in (("a", ["--camera", CAMERA]), ("b", ["--camera-model", model, "--camera-params", params])):
        assert _run(sequence, "-o", tmp_path / name, *camera, *few).exit_code == 0
    ours, theirs = (read_tum(tmp_path / name / "trajectory.txt") for name in "ab")
    np.testing.assert_allclose(ours.world_from_cam, theirs.world_from_cam, atol=1e-9)
    wrong = _run(sequence, "-o", tmp_path / "c", "--camera-model", "PINHOLE", "--camera-params", "1,2,3", *few)
    assert wrong.exit_code == 1
