# SPDX-License-Identifier: BSD-3-Clause
"""``groma view --live``: what the page says and draws before, while and after a track runs."""

import os
import shutil
import time
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from _scene import exact_scene
from typer.testing import CliRunner

from groma.cli.app import app
from groma.errors import FileFormatError
from groma.io import write_scene
from groma.io.trajectories import Trajectory, write_tum
from groma.viz.viewer import glance, live

ROW = "{} 0.1 0 {} 0 0 0 1 {}\n"


@pytest.fixture(scope="module")
def scene():
    return exact_scene()


def test_rows_of_frames(tmp_path):
    path = tmp_path / "frames.txt"
    # The last row is not complete; the map was begun anew after the first row.
    path.write_text(ROW.format(0.0, 0.0, 0) + ROW.format(0.1, 0.5, 1) + ROW.format(0.2, 0.7, 1) + "0.3 0.1")
    np.testing.assert_array_equal(live.read_frames(path), [[0, 0, 0, 1, 0.1, 0, 0.5], [0, 0, 0, 1, 0.1, 0, 0.7]])
    path.write_text("")
    assert live.read_frames(path).shape == (0, 7)


def test_a_track_from_waiting_to_finished(tmp_path, scene):
    output, work = tmp_path / "out", tmp_path / "out.work"
    with live.following(output, port=0) as view:
        view.refresh()
        assert view.state == live.WAITING
        work.mkdir()
        view.refresh()
        assert view.state == live.RUNNING
        assert view.scene is None
        (work / "statuses.txt").write_text("")
        then = time.time() - 7500.0
        os.utime(work / "statuses.txt", (then, then))
        view.refresh()
        assert "Nothing new for 2 h 5 min." in view._words.content
        (work / "frames.txt").write_text(ROW.format(0.0, 0.0, 0) + ROW.format(0.1, 0.5, 0))
        write_scene(scene, work / "scene.npz")
        assert view.refresh()
        assert view.num_frames == 2
        assert view.scene is not None
        assert view.scene.num_lines == scene.num_lines
        assert len(np.unique(view._nodes["lines"][0].colors.reshape(-1, 3), axis=0)) == 1
        assert not view.refresh()
        (work / "scene.npz").write_bytes(b"being replaced")
        view.refresh()
        assert view.scene is not None
        assert view.scene.num_lines == scene.num_lines
        output.mkdir()
        write_scene(scene, output / "scene.npz")
        write_tum(Trajectory(np.arange(3.0), np.tile([0, 0, 0, 1.0, 0, 0, 0], (3, 1))), output / "trajectory.txt")
        shutil.rmtree(work)
        assert view.refresh()
        assert view.state == live.FINISHED
        assert view.num_frames == 3
        assert len(np.unique(view._nodes["lines"][0].colors.reshape(-1, 3), axis=0)) > 1  # by direction


STATUSES = "0.0 starting 0 0 0 0\n0.1 tracked 210 31 2 1\n0.2 lost 0 0 0 0\n0.3 weak 9 1 0 0\n0.4 tra"


def test_what_became_of_frames(tmp_path):
    (tmp_path / "statuses.txt").write_text(STATUSES)  # the last row is not complete
    found = glance.read_statuses(tmp_path / "statuses.txt")
    assert found.status == ("starting", "tracked", "lost", "weak")
    assert found.sentence(1) == "Frame 2: **tracked**, keyframe; 210 points, 31 lines, 2 planes agree"
    assert found.sentence() == "Frame 4: **weak**; 9 points, 1 line, 0 planes agree"
    drawing = ElementTree.fromstring(glance.timeline(found).replace("&", "&amp;"))
    bars = [bar for bar in drawing.iter("rect") if bar.get("fill") != "#555"]
    assert [bar.get("fill") for bar in bars] == ["#9aa1aa", "#1f6fb5", "#d64b36", "#e8a33a"]
    heights = [float(bar.get("height")) for bar in bars]
    assert heights[1] == max(heights) and heights[3] / heights[1] == pytest.approx(10 / 241, abs=0.02)
    assert len([bar for bar in drawing.iter("rect") if bar.get("fill") == "#555"]) == 1


def test_a_long_timeline_shows_the_worst_of_its_columns(tmp_path):
    rows = [f"{k} {'lost' if k == 1234 else 'tracked'} 100 10 0 0\n" for k in range(5000)]
    (tmp_path / "statuses.txt").write_text("".join(rows))
    text = glance.timeline(glance.read_statuses(tmp_path / "statuses.txt"))
    assert text.count("<rect") == 200 and text.count('fill="#d64b36"') == 1


def test_the_picture_of_the_moment_shows_what_is_followed(tmp_path):
    grey = np.full((60, 80), 100, np.uint8)
    np.savez(tmp_path / "now.npz", picture=grey, points=[[20.0, 30.0]], segments=[[50.0, 10.0, 50.0, 50.0]])
    drawn = glance.read_now(tmp_path / "now.npz")
    assert drawn.shape == (60, 80, 3) and drawn[5, 5].tolist() == [100] * 3
    assert np.argmax(drawn[30, 20]) == 2 and np.argmax(drawn[30, 50]) == 1  # blue points, green segments
    np.savez(tmp_path / "bad.npz", picture=grey, points=[[20.0]], segments=np.zeros((0, 4)))
    with pytest.raises(FileFormatError):
        glance.read_now(tmp_path / "bad.npz")


def test_the_panel_of_a_running_track(tmp_path, scene):
    """Picture, status, timeline; the slider moves the camera back; switches hide what they name."""
    work = tmp_path / "out.work"
    work.mkdir()
    (work / "frames.txt").write_text("".join(ROW.format(0.1 * k, float(k), 0) for k in range(5)))
    (work / "statuses.txt").write_text(STATUSES)
    np.savez(work / "now.npz", picture=np.zeros((6, 8), np.uint8), points=np.zeros((0, 2)), segments=np.zeros((0, 4)))
    write_scene(scene, work / "scene.npz")
    with live.following(tmp_path / "out", port=0) as view:
        assert not view.picture.visible and not view.timeline.visible
        view.refresh()
        assert view.picture.visible and view.timeline.visible and view.statuses is not None
        assert "**weak**" in view._words.content
        assert view._now.position.tolist() == [0.1, 0, 4]  # the last frame
        assert view._now.scale == pytest.approx(1.5 * view._nodes["keyframes"][0].scale)
        view.frame_shown.value = 2
        assert view._now.position.tolist() == [0.1, 0, 1]
        (work / "frames.txt").write_text("".join(ROW.format(0.1 * k, float(k), 0) for k in range(6)))
        view.refresh()
        assert view.frame_shown.max == 6 and view.frame_shown.value == 2  # stays where it was put
        view.frame_shown.value = 6
        assert view._now.position.tolist() == [0.1, 0, 5]
        for name, box in view.shown.items():
            box.value = False
            assert not any(node.visible for node in view._nodes[name]) and view._nodes[name]
        write_scene(scene.keep(points=np.arange(6)), work / "scene.npz", force=True)
        view.refresh()
        assert not view._nodes["points"][0].visible  # what is drawn anew stays hidden


def test_a_track_writes_what_the_page_shows(tmp_path):
    """Files of a real track: a status for every frame, and the picture with points inside it."""
    from groma.tracking.journal import Journal

    frame = SimpleNamespace(gray=np.zeros((100, 1280), np.uint8))
    tracked = SimpleNamespace(
        timestamp=0.5, pose=np.array([0, 0, 0, 1.0, 0, 0, 0]), status="tracked", counts={"points": 3}, keyframe=True,
        submap=0,
    )  # fmt: skip
    points = SimpleNamespace(pixel=np.array([[640.0, 50.0]]))
    lines = SimpleNamespace(ends=np.array([[100.0, 10.0, 200.0, 20.0]]))
    tracker = SimpleNamespace(_present=SimpleNamespace(followed=SimpleNamespace(points=points, lines=lines)))
    journal = Journal(tmp_path / "out.work")
    journal.frame(tracked, frame, tracker)  # type: ignore[arg-type]
    journal.close()
    found = glance.read_statuses(tmp_path / "out.work" / "statuses.txt")
    assert found.counts.tolist() == [[3, 0, 0]] and found.keyframe.tolist() == [True]
    with np.load(tmp_path / "out.work" / "now.npz") as now:  # reduced by two
        assert now["picture"].shape == (50, 640) and now["points"].tolist() == [[320.0, 25.0]]
        assert now["segments"].tolist() == [[50.0, 5.0, 100.0, 10.0]]
    assert len(live.read_frames(tmp_path / "out.work" / "frames.txt")) == 1


def test_a_file_is_no_track(tmp_path):
    (tmp_path / "model.npz").write_bytes(b"")
    result = CliRunner().invoke(app, ["view", "--live", str(tmp_path / "model.npz"), "--no-browser"])
    assert result.exit_code == 1
    assert "groma track -o" in " ".join(result.output.split())
